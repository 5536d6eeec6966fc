"""Pictures of runs, maps and studies."""
