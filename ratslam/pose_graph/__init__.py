"""SE(2) pose graphs: robust nonlinear least squares.

Node 0 is fixed. Sources: Kuemmerle et al. 2011 (g2o: the error of an edge), Dellaert & Kaess 2017 (gtsam: the
logarithmic error), Triggs et al. 2000 (the curvature of robust kernels), Davis 2005 (the factorisation).
"""

from ratslam.pose_graph.edges import Edges, ErrorFunction, difference_error, logmap_error
from ratslam.pose_graph.least_squares import (
    GrowingGraph,
    Kernel,
    Solution,
    Termination,
    geman_mcclure,
    huber,
    least_squares,
    no_kernel,
)

__all__ = [
    "Edges",
    "ErrorFunction",
    "GrowingGraph",
    "Kernel",
    "Solution",
    "Termination",
    "difference_error",
    "geman_mcclure",
    "huber",
    "least_squares",
    "logmap_error",
    "no_kernel",
]
