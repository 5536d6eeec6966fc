"""The configuration of a run: read from YAML, completed once for its source, written back."""

SCHEMA_START = rb'{\s+"\$schema": "[^"]*",\s+"title": "RunConfig",\s'
"""Pattern of the beginning of the schema of configurations."""
