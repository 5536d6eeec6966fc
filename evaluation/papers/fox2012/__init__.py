"""The figures of Fox et al. 2012 on simulated sessions."""
