"""The rig from a record: wheels, whiskers and head, as settings with their uncertainties (see README.md)."""
