"""The colours of the charts, for the light and the dark theme of the page."""

from __future__ import annotations

_RUNS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#8a6d00", "#56b4e9")
_RUNS_DARK = ("#5cb3ff", "#ff8c5a", "#3ecf9f", "#e79ac2", "#e0c341", "#a5d8ff")
RUN_ROLES = len(_RUNS)
"""Number of the roles `run0`, `run1` ... of compared runs."""
PALETTE = {
    "light": {
        "text": "#4a4f57", "line": "#e3e5e8", "ground": "#ffffff", "ink": "#14171a",
        "wall": "#c9ccd1", "truth": "#e3b505", "odometry": "#8b9098", "final": "#0072b2",
        "doubted": "#8a5a9e", "place": "#0072b2", "link": "#7fb3d3", "accepted": "#00795a",
        "refused": "#c8500a", "online": "#8a5a9e", "limit": "#c8500a",
        **{f"run{number}": colour for number, colour in enumerate(_RUNS)},
    },
    "dark": {
        "text": "#b4bac3", "line": "#2d333b", "ground": "#15181c", "ink": "#ffffff",
        "wall": "#4a515b", "truth": "#d9b437", "odometry": "#8b939e", "final": "#5cb3ff",
        "doubted": "#c79be0", "place": "#5cb3ff", "link": "#33618a", "accepted": "#3ecf9f",
        "refused": "#ff8c5a", "online": "#c79be0", "limit": "#ff8c5a",
        **{f"run{number}": colour for number, colour in enumerate(_RUNS_DARK)},
    },
}  # fmt: skip
"""The colour of each role in each theme; those of runs are distinguishable with common colour blindness."""
GRID_SCALES = {
    "light": [[0, "#f7f7f5"], [0.5, "#b9bcc1"], [1, "#2a2d31"]],
    "dark": [[0, "#1d2127"], [0.5, "#454c56"], [1, "#eceff2"]],
}
"""The colours of a grid in each theme: free, unknown, occupied."""
