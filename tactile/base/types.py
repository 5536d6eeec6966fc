"""Types shared by robots, the tactile front end and SLAM backends: readings and observations.

Each type is a NamedTuple of arrays with fixed shapes and dtypes, hence a JAX pytree without an import of JAX.
With a leading axis it is a chunk of several.
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import IntEnum
from typing import Any, NamedTuple

import numpy as np

Array = Any  # a NumPy or a JAX array


class MotionKind(IntEnum):
    """The kind of motion of a step, from the Create's state machine."""

    OTHER = 0
    FORWARD = 1
    BACK = 2
    TURN = 3


class Odometry(NamedTuple):
    """Body-frame motion over one step: the robot's new pose in the frame of its old one.

    Attributes:
        dx: forward, m. dy: to the left, m. dtheta: counter-clockwise, rad. dt: duration, s.
    """

    dx: Array
    dy: Array
    dtheta: Array
    dt: Array


class Cycle(NamedTuple):
    """The raw samples of one whisk cycle (NumPy; the number of samples T varies).

    Attributes:
        time: [T] s. angle: [T, W] whisker angles, rad. deflection: [T, W, 2] base deflections.
        odometry: motion since the previous cycle.
    """

    time: np.ndarray
    angle: np.ndarray
    deflection: np.ndarray
    odometry: Odometry


class Whisk(NamedTuple):
    """The contact features of one whisk cycle, detected in a `Cycle` or simulated directly.

    Angles are protractions from rest. Values of whiskers without contact are 0.

    Attributes:
        odometry: motion since the previous cycle.
        alive: [W] bool, the whisker has a signal. contact: [W] bool, it touched something during protraction.
        touched: [W] angle at first contact, rad. held: [W] bool, still in contact at the end of the
            protraction. highest: [W] largest angle, rad. reach: [W] radial distance of the contact, as a
            share of the whisker's length.
    """

    odometry: Odometry
    alive: np.ndarray
    contact: np.ndarray
    touched: np.ndarray
    held: np.ndarray
    highest: np.ndarray
    reach: np.ndarray


class StepEnd(IntEnum):
    """Kind of end of a step of the Create's state machine (Fox et al. 2012, II-C)."""

    FREE = 0
    """As planned, without a contact."""
    HIT1 = 1
    """First contact of a whisker; ends the fast drive (FWD1)."""
    HIT2 = 2
    """Contact of a second whisker; ends the slow drive (FWD2)."""
    ABORT = 3
    """The strain of a whisker exceeded the safe limit."""


class Report(NamedTuple):
    """One step of the Create's state machine with the signals of its fixed whiskers.

    Attributes:
        odometry: motion since the previous report. motion: a `MotionKind`. moment: a `StepEnd`.
        alive: [W] bool, the whisker has a signal. contact: [W] bool, strained beyond the contact threshold
            at the end of the step.
        time: [T] s since the beginning of the step, evenly spaced. strain: [T, W, 2] horizontal and vertical,
            during the slow drive between HIT1 and HIT2 or ABORT; T is 0 for every other step.
    """

    odometry: Odometry
    motion: int
    moment: int
    alive: np.ndarray
    contact: np.ndarray
    time: np.ndarray
    strain: np.ndarray


class Observation(NamedTuple):
    """The input of a SLAM backend at one step. Absent values are masked, never NaN.

    Attributes:
        odometry: motion since the previous observation.
        motion: a `MotionKind`, int32.
        view: [R, C, K] view, values in 0..1 (3 x 6 whiskers x channels, 20 x 60 x 1 for a camera).
        view_seen: whether `view` holds a view, bool.
        label: place id given by the recording, int32; -1 for none.
        contact: [W] bool, whiskers in contact. alive: [W] bool, whiskers with a signal; pixels of other
            whiskers are to be ignored.
        point: [W, 2] contact points in base_link, m.
        wall: bool, whether a wall direction was measured; wall_point: [2] nearest point of that wall in
            base_link, m; wall_sd: standard deviation of its direction, rad.
    """

    odometry: Odometry
    motion: Array
    view: Array
    view_seen: Array
    label: Array
    contact: Array
    alive: Array
    point: Array
    wall: Array
    wall_point: Array
    wall_sd: Array


def observation(
    odometry: Odometry,
    view: np.ndarray | None = None,
    *,
    view_shape: tuple[int, int, int] = (3, 6, 1),
    label: int = -1,
    motion: MotionKind = MotionKind.OTHER,
    whiskers: int = 0,
) -> Observation:
    """An observation with a view, a place label or both, and without contacts.

    Args:
        view: [R, C, K], or None for a masked view of shape `view_shape`.
        whiskers: W, the length of the (masked) contact fields.
    """
    seen = view is not None
    return Observation(
        odometry=Odometry(*(np.float64(value) for value in odometry)),
        motion=np.int32(motion),
        view=np.asarray(view, np.float64) if seen else np.zeros(view_shape),
        view_seen=np.bool_(seen),
        label=np.int32(label),
        contact=np.zeros(whiskers, bool),
        alive=np.ones(whiskers, bool),
        point=np.zeros((whiskers, 2)),
        wall=np.bool_(False),
        wall_point=np.zeros(2),
        wall_sd=np.float64(0.0),
    )


def stack(observations: Sequence[Observation]) -> Observation:
    """A chunk: observations stacked along a new leading axis."""
    first = observations[0]
    motions = zip(*(o.odometry for o in observations), strict=True)
    odometry = Odometry(*(np.stack(column) for column in motions))
    columns = zip(*(o[1:] for o in observations), strict=True)
    return type(first)(odometry, *(np.stack(column) for column in columns))
