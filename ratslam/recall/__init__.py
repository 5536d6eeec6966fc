"""View cells: remembered keyframes, and how likely a view is at each."""
