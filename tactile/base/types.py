"""The seam between a robot, its sense of touch and an engine.

Everything here is a NamedTuple of arrays with fixed shapes and dtypes, so that it is a JAX pytree without
this package knowing JAX. A leading axis turns one into a chunk of many.
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import IntEnum
from typing import Any, NamedTuple

import numpy as np

Array = Any  # a NumPy or a JAX array


class MotionKind(IntEnum):
    """What the robot was doing during a step (the Create's state machine needs to know)."""

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
    """One whisk cycle as the head reports it; host NumPy, the number of samples T may vary.

    Attributes:
        time: [T] s. angle: [T, W] whisker angles, rad. deflection: [T, W, 2] base deflections.
        odometry: motion since the previous cycle.
    """

    time: np.ndarray
    angle: np.ndarray
    deflection: np.ndarray
    odometry: Odometry


class Whisk(NamedTuple):
    """One whisk cycle as each whisker felt it: what is kept of a `Cycle`, or simulated without one.

    Angles are protractions from rest. Values of whiskers that did not feel it are 0.

    Attributes:
        odometry: motion since the previous cycle.
        alive: [W] bool, the whisker reports at all. contact: [W] bool, it touched something on its way.
        touched: [W] angle at first contact, rad. held: [W] bool, it still touched at the end of the
            protraction. highest: [W] largest angle, rad. reach: [W] how far along the shaft it was touched,
            as a share of its length.
    """

    odometry: Odometry
    alive: np.ndarray
    contact: np.ndarray
    touched: np.ndarray
    held: np.ndarray
    highest: np.ndarray
    reach: np.ndarray


class StepEnd(IntEnum):
    """Where the Create's state machine stands at the end of a step (Fox et al. 2012, II-C)."""

    FREE = 0
    """The step ended as planned, and nothing was met."""
    HIT1 = 1
    """A whisker has met something: the drive on (FWD1) ended."""
    HIT2 = 2
    """A second one has: the slow drive on (FWD2) ended."""
    ABORT = 3
    """The strain of a whisker passed what is safe, and the step ended early."""


class Report(NamedTuple):
    """One step of the Create's state machine as its fixed whiskers felt it.

    Attributes:
        odometry: motion since the previous report. motion: a `MotionKind`. moment: a `StepEnd`, how it ended.
        alive: [W] bool, the whisker reports at all. contact: [W] bool, strained beyond the contact threshold
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
    """What an engine is given at one step. Absent things are masked, never NaN.

    Attributes:
        odometry: motion since the previous observation.
        motion: a `MotionKind`, int32.
        view: [R, C, K] view, values in 0..1 (3 x 6 whiskers x channels, 20 x 60 x 1 for a camera).
        view_seen: whether `view` holds a view, bool.
        label: place-recognition id given by the recording, int32; -1 when there is none.
        contact: [W] bool, whiskers that touched something. alive: [W] bool, whiskers that report at all; a
            pixel of the view that belongs to another one says nothing.
        point: [W, 2] m in base_link, where they touched.
        wall: bool, whether a wall orientation was measured; wall_point: [2] its nearest point, m in
            base_link; wall_sd: standard deviation of its direction, rad.
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
    """An observation of a view and / or a given label, without contacts.

    Args:
        view: [R, C, K], or None when nothing was seen; then `view_shape` gives its shape.
        whiskers: W, the number of whiskers of the (masked) contact fields.
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
    """A chunk: the observations stacked along a new leading axis."""
    first = observations[0]
    odometry = Odometry(
        *(np.stack(column) for column in zip(*(o.odometry for o in observations), strict=True))
    )
    columns = zip(*(o[1:] for o in observations), strict=True)
    return type(first)(odometry, *(np.stack(column) for column in columns))
