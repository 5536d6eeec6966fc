"""The files of a run directory. Readers raise an `InputError` for a file that is missing or malformed."""
