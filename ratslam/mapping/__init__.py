"""The map of keyframes: its state (`map_state`), loop closures, their selection, and the solver."""
