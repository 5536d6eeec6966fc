"""Driver of a whisker head: wire format, link, whisking commands."""
