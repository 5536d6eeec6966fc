"""From a source through a session into a run directory."""
