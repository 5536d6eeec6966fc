"""The configuration of a run: read from YAML, completed once for its source, written back."""
