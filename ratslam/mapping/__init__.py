"""The map of keyframes: loop closures, their verification and selection, and its optimisation."""
