"""A whisker head on a wire: what it sends and takes, the link to it, and how it is driven."""
