"""The rig of a whisker head from a record: noise, drift, faults and geometry (see README.md)."""
