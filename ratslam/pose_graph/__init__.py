"""SE(2) pose graphs: exact linear start, damped and robust least squares, chains of odometry eliminated.

Node 0 is held where it is. Sources: Kuemmerle et al. 2011 (g2o: the plain error), Dellaert & Kaess 2017
(the logarithmic one), Carlone et al. 2014 (headings first, then positions).
"""

from ratslam.pose_graph.edges import Edges, Error, difference_error, logmap_error
from ratslam.pose_graph.least_squares import Ending, Solution, least_squares
from ratslam.pose_graph.linear_init import linear
from ratslam.pose_graph.robust_kernels import Kernel, geman_mcclure, huber, no_kernel

__all__ = [
    "Edges",
    "Ending",
    "Error",
    "Kernel",
    "Solution",
    "difference_error",
    "geman_mcclure",
    "huber",
    "least_squares",
    "linear",
    "logmap_error",
    "no_kernel",
]
