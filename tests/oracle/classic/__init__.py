"""OpenRatSLAM as it is, quirks included (sections 2 to 5, Q-numbers of section 7)."""
