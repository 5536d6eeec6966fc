"""The grid particle filter of Fox et al. 2012: particles, likelihoods, maps."""
