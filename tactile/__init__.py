"""Whisker touch: from raw samples to observations, and the types shared by sources and backends."""

# `ratslam.__main__` checks this first: other distributions install packages of the same name (for example
# Robot Framework's `robot`), and the first one on the path would be imported silently.
RATSLAM_PACKAGE = "tactile"
