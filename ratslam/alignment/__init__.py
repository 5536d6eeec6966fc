"""Whether a session is where it is supposed to be in a map."""
