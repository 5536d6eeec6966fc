"""Wall direction from the contacts and strain of the Create's whiskers (Fox et al. 2012)."""
