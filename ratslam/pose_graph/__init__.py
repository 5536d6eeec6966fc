"""SE(2) pose graphs: linear initialization, robust nonlinear least squares, elimination of odometry chains.

Node 0 is fixed. Sources: Kuemmerle et al. 2011 (g2o: the error of an edge), Dellaert & Kaess 2017 (gtsam: the
logarithmic error), Carlone et al. 2014 (headings first, then positions).
"""

from ratslam.pose_graph.edges import Edges, ErrorFunction, difference_error, logmap_error
from ratslam.pose_graph.least_squares import (
    Kernel,
    Solution,
    Termination,
    geman_mcclure,
    huber,
    least_squares,
    no_kernel,
)
from ratslam.pose_graph.linear_init import linear_initialization

__all__ = [
    "Edges",
    "ErrorFunction",
    "Kernel",
    "Solution",
    "Termination",
    "difference_error",
    "geman_mcclure",
    "huber",
    "least_squares",
    "linear_initialization",
    "logmap_error",
    "no_kernel",
]
