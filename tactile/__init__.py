"""Touch: what a whisker array senses, and the types every source and engine share."""

# `ratslam.__main__` reads this before anything else: other distributions install packages of the same
# name (Robot Framework's `robot`), and whichever came first on the path would silently be imported.
RATSLAM_PACKAGE = "tactile"
