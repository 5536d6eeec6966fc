"""What recorded pose cells code for.

Functions raise an `InputError` for arrays or sizes that do not fit, a path without a known pose or without
time in a bin, and a file that is missing or broken.
"""
