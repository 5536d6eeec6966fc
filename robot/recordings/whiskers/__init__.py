"""Recordings of real whiskers and fingertips, each in the format in which its authors published it."""
