"""Recall: a posterior over remembered frames, the sector shift that aligns them, and "this is new".

One view is seldom enough to know a place by. So nothing is decided on one: the posterior is carried along by
odometry, sharpened or weakened by every view, and what no frame explains goes to `novel`. A view that looks
like many frames says little, because novelty is judged by the mean likelihood over all of them; a view that
contradicts takes mass away. Odometry aligns, it is never evidence by itself. What the map believes of the
robot's place enters as one more hypothesis, always weak: it proposes, views dispose.

The kernel is pure and of fixed shapes. Poses, bias, sector angle and the scale of view errors come from the
map as a `MapFeedback`; no closure verdict comes back otherwise. No constant is in units of the sensor: errors
count in units of the scale, distances in pose cells. The filter is ours; its ancestors are Bayesian
localisation (Fox et al. 1999) and the sequence matching of SeqSLAM (Milford & Wyeth 2012).
"""

from __future__ import annotations

from typing import Annotated, Literal, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax
from pydantic import Field, NonNegativeFloat, NonNegativeInt, PositiveFloat, PositiveInt

from ratslam.recall.whisker_likelihood import LEVELS
from tactile.base.config import Settings
from tactile.base.se2 import compose, correct_heading_bias, wrap
from tactile.base.types import Array

Share = Annotated[float, Field(ge=0, le=1)]

SAMPLES = 20
"""Errors against ruled-out frames told to the map at each frame, to calibrate by."""
SUPPORT = 8.0
"""Squared deviations at which the alignment kernel (1 - d2 / 8)^4 ends: like exp(-d2 / 2), but compact."""
FOLLOWERS = 4
"""Frames from one on that may be the next: it may also stay, or pass one or two by."""
BASIN = 2.0
"""Cells around the best frame whose mass counts as that candidate's."""


FACING = float(np.cos(0.5))
"""Cosine of the heading difference up to which a frame looks where the robot does."""


class RecallConfig(Settings):
    """The filter. Lengths are in pose cells, so that one setting serves every robot."""

    sector_fov: Literal["auto", "none", "whiskers"] | float = "auto"
    """Whether a view is a fan of ordered sectors, so that a turned robot sees it shifted: its width in rad
    (counter-clockwise positive), `none`, `whiskers` (rows of whiskers all around the robot), or `auto` (also
    0): found out from the recording itself."""
    shifts: NonNegativeInt = 3
    """Sectors by which a fan may be shifted either way. Whiskers: not 0 where a head that has turned about
    feels with each whisker what the one opposite felt."""
    frame_distance: PositiveFloat = 0.3
    """Way after which a view becomes a frame, cells. Standing still remembers nothing."""
    frame_turn: PositiveFloat = 0.15
    """Turn after which it does, rad."""
    guard: PositiveInt = 20
    """The newest frames, this many, are not recalled: the robot has hardly left them."""
    sharpness: PositiveFloat = 0.2
    """Error that costs a factor e, in scales (see `MapFeedback`)."""
    floor: PositiveFloat = 1.27
    """Error that stands for a view never seen before, in scales."""
    common: NonNegativeFloat = 1.0
    """Weight of the mean likelihood over all frames in novelty's: at 1 a view that all places share tells
    nothing at all."""
    fresh: NonNegativeFloat = 0.3
    """Weight of a view at the floor in novelty's."""
    reach: PositiveFloat = 0.85
    """Standard deviation of a frame's place against odometry, cells."""
    reach_heading: PositiveFloat = 0.25
    """The same of its heading, rad."""
    miss_weight: PositiveFloat = 0.02
    """Weight of there being no frame where odometry leads, against one just there."""
    mode_decay: Share = 0.01
    """Share of a hypothesis that is lost at every frame."""
    enter: Share = 0.05
    """Share of novelty that becomes hypotheses at every frame."""
    local: Share = 0.3
    """How much of that lies around the map's pose; the rest goes to all frames alike."""
    local_sd: PositiveFloat = 1.0
    """Standard deviation of the map's pose after a closure, cells."""
    local_rate: NonNegativeFloat = 0.05
    """What each metre travelled since adds to it, m."""
    local_heading: PositiveFloat = 0.3
    """Standard deviation of the map's heading after a closure, rad."""
    local_heading_rate: NonNegativeFloat = 0.006
    """What each cell travelled since adds to it, rad."""
    temper: PositiveFloat = 0.25
    """Whiskers: share of the log-odds of an image that counts, because pixels are not independent."""
    familiar: Share = 0.8
    """Whiskers: weight in novelty of what places that looked alike before look like next, against `floor`."""
    energy: PositiveFloat = 3.0
    """Activity injected into the pose cells by a candidate, for each unit of its posterior; the packet's own
    is 1. Weaker ones leave two packets to compete for long, which costs time and tells nothing more."""
    modes: PositiveInt = 8
    """Hypotheses kept from frame to frame; the mass of the others goes to novelty."""


NO_LIKENESS = np.zeros((0, 0, 0))


class MapFeedback(NamedTuple):
    """What the map tells the filter.

    Attributes:
        poses: [N, 3] of all frames in the map. bias: of the heading, rad/m. since: m travelled since the last
            closure. angle: of a sector, rad, 0 while unknown; whiskers: a half turn. scale: of view errors,
            such as are still seen between different places; whiskers: the log-odds that stand for an image
            never seen before; 0 while unknown. likeness: [G, L, L] see `likeness.table`; empty but for
            whiskers.
    """

    poses: np.ndarray
    bias: float
    since: float
    angle: float
    scale: float
    likeness: np.ndarray = NO_LIKENESS


class Memory(NamedTuple):
    """All frames, rows in order of time, and what is believed now.

    Attributes:
        view: [D, C]; whiskers: levels, int32. label: [C] int32. packet: [C, 3] pose-cell packet when the
            frame was taken, cells.
        x, y, cosine, sine: [C] poses in the map. count, distinct: frames, and labels known, int32.
        anchor: [K] int32 frames that hypotheses stand at, offset: [K, 3] where in their frames (m, rad),
            mass: [K]. What they lack to 1 is novelty.
        pose: [3] of the newest frame. motion, length, turn: since then: [3], m, rad.
        bias, since, angle, scale, likeness: see `MapFeedback`.
        before: [S, C] likelihoods of the image before, rest: [S, C] what is believed beside the hypotheses;
            both for whiskers only, else of no size.
    """

    view: Array
    label: Array
    packet: Array
    x: Array
    y: Array
    cosine: Array
    sine: Array
    count: Array
    distinct: Array
    anchor: Array
    offset: Array
    mass: Array
    pose: Array
    motion: Array
    length: Array
    turn: Array
    bias: Array
    since: Array
    angle: Array
    scale: Array
    likeness: Array
    before: Array
    rest: Array


class RecallResult(NamedTuple):
    """What a view brought back.

    Attributes:
        frame: int32, the frame the view became, -1 for none. match: int32, the most likely frame, -1 for
            none. shift: int32, sectors by which the view is shifted against it. mass: posterior within
            `BASIN` cells of it. gain: log-likelihood ratio of the match against novelty. novel: posterior of
            novelty. entropy: of hypotheses and novelty, nats. second: mass of the second heaviest over
            the heaviest. agree: int32, 1 when the view fits a frame where the map says the robot is, 0 when
            it fits none there, -1 when none is there. background: [SAMPLES] errors against ruled-out frames,
            NaN for none.
    """

    frame: Array
    match: Array
    shift: Array
    mass: Array
    gain: Array
    novel: Array
    entropy: Array
    second: Array
    agree: Array
    background: Array


class ObservationLikelihood(NamedTuple):
    """What is seen, against what is remembered.

    Attributes:
        likelihood: [S or 1, C] of what is seen, at each shift and frame. novelty: the same where it is new.
        background: see `RecallResult`. certain: whether anything can be told yet. telling: whether what is
            seen speaks for or against a place (an id never given before does not).
    """

    likelihood: Array
    novelty: Array
    background: Array
    certain: Array
    telling: Array


def offsets(config: RecallConfig) -> np.ndarray:
    """[S] sectors by which views are shifted; whiskers: half turns."""
    if config.sector_fov == "whiskers":
        return np.arange(2 if config.shifts else 1, dtype=np.int32)
    reach = 0 if config.sector_fov == "none" else config.shifts
    return np.arange(-reach, reach + 1, dtype=np.int32)


def fan_width(config: RecallConfig) -> float | None:
    """Of the views, rad; 0: to be found out; None: they are no fan."""
    if isinstance(config.sector_fov, str):
        return 0.0 if config.sector_fov == "auto" else None
    return config.sector_fov


def start(config: RecallConfig, size: int, capacity: int, dtype: np.dtype, groups: int = 0) -> Memory:
    """No frames, everything new.

    Args:
        size: values of a view, D; 0 for recordings with given ids, which need no views. groups: of whiskers,
            G, see `likeness.table`.
    """

    def zeros(*shape: int) -> Array:  # one buffer each: the session donates them
        return jnp.zeros(shape, dtype)

    touch = config.sector_fov == "whiskers"
    return Memory(
        view=jnp.zeros((size, capacity), jnp.int32) if touch else zeros(size, capacity),
        label=jnp.full(capacity, -1, jnp.int32),
        packet=zeros(capacity, 3),
        x=zeros(capacity),
        y=zeros(capacity),
        cosine=zeros(capacity),
        sine=zeros(capacity),
        count=jnp.int32(0),
        distinct=jnp.int32(0),
        anchor=jnp.zeros(config.modes, jnp.int32),
        offset=zeros(config.modes, 3),
        mass=zeros(config.modes),
        pose=zeros(3),
        motion=zeros(3),
        length=zeros(),
        turn=zeros(),
        bias=zeros(),
        since=zeros(),
        angle=zeros(),
        scale=zeros(),
        likeness=zeros(groups, LEVELS, LEVELS) if touch else zeros(0, 0, 0),
        before=zeros(*(shape := (len(offsets(config)), capacity if touch else 0))),
        rest=zeros(*shape),
    )


def apply_map_feedback(memory: Memory, feedback: MapFeedback) -> Memory:
    """The memory with the map's present poses in the place of older ones."""
    dtype, count = memory.x.dtype, len(feedback.poses)
    if not count:
        return memory
    full = np.zeros((4, memory.x.shape[0]))
    x, y, heading = feedback.poses.T
    full[:, :count] = x, y, np.cos(heading), np.sin(heading)
    x, y, cosine, sine = (jnp.asarray(row, dtype) for row in full)
    told = (feedback.bias, feedback.since, feedback.angle, feedback.scale)
    bias, since, angle, scale = (jnp.asarray(value, dtype) for value in told)
    if feedback.likeness.size:
        memory = memory._replace(likeness=jnp.asarray(feedback.likeness, dtype))
    return memory._replace(
        x=x, y=y, cosine=cosine, sine=sine, pose=jnp.asarray(feedback.poses[-1], dtype),
        bias=bias, since=since, angle=angle, scale=scale,
    )  # fmt: skip


def travel(memory: Memory, odometry: Array) -> Memory:
    """Adds body-frame motion [3] (m, m, rad) to what has been travelled since the newest frame."""
    return memory._replace(
        motion=compose(memory.motion, odometry),
        length=memory.length + jnp.hypot(odometry[0], odometry[1]),
        turn=memory.turn + jnp.abs(odometry[2]),
    )


def due(config: RecallConfig, cell: float, memory: Memory) -> Array:
    """Whether a view seen now becomes a frame."""
    moved = (memory.length >= config.frame_distance * cell) | (memory.turn > config.frame_turn)
    return (memory.count < memory.label.shape[0]) & (moved | (memory.count == 0))


def present(memory: Memory) -> Array:
    """[3] the robot's pose in the map, as far as the kernel has been told."""
    return compose(memory.pose, correct_heading_bias(memory.motion, memory.length, memory.bias))


def spread(config: RecallConfig, cell: float, memory: Memory) -> tuple[Array, Array]:
    """How far off that pose may be, one standard deviation: m, rad."""
    since = memory.since + memory.length
    return (
        config.local_sd * cell + config.local_rate * since,
        config.local_heading + config.local_heading_rate / cell * since,
    )


def look(
    config: RecallConfig, cell: float, memory: Memory, weighing: ObservationLikelihood
) -> tuple[Memory, RecallResult]:
    """One frame: align what was believed, weigh it by what is seen, and name the best candidate.

    Args:
        cell: m, the unit of all lengths in the configuration.
    """
    shifts = offsets(config)
    angles = -shifts.astype(memory.angle.dtype) * memory.angle  # robot's heading less the frame's
    known, certain, novelty = old(config, memory), weighing.certain, weighing.novelty
    likelihood = jnp.where(known[None], weighing.likelihood, 0.0)
    here = present(memory)
    apart = (memory.x - here[0]) ** 2 + (memory.y - here[1]) ** 2

    belief, novel = _align(config, cell, memory, angles, known, here)
    belief, novel = belief * likelihood, novel * novelty
    total = jnp.maximum(jnp.sum(belief) + novel, jnp.finfo(novel.dtype).tiny)
    belief, novel = belief / total, novel / total

    match = _peak(jnp.max(belief, axis=0))
    shift = _peak(belief[:, match])
    basin = (memory.x - memory.x[match]) ** 2 + (memory.y - memory.y[match]) ** 2 < (BASIN * cell) ** 2
    mass = jnp.sum(jnp.where(basin[None], belief, 0.0))
    gain = jnp.log(jnp.where(certain, likelihood[shift, match], 1.0) / novelty)
    (anchor, offset, masses), rest = _modes(config, cell, memory, angles, belief)
    near = known & (apart < cell**2)
    facing = memory.cosine * jnp.cos(here[2]) + memory.sine * jnp.sin(here[2]) > FACING
    best = jnp.max(jnp.where(near & facing, jnp.max(likelihood, axis=0), 0.0))
    agree = jnp.where(
        certain & weighing.telling & jnp.any(near & facing), (best >= novelty).astype(jnp.int32), -1
    )

    shares = jnp.concatenate([masses, jnp.maximum(1 - jnp.sum(masses, keepdims=True), 0.0)])
    recollection = RecallResult(
        frame=memory.count,
        match=jnp.where(certain & (mass > 0), match, -1),
        shift=jnp.where(certain & (mass > 0), jnp.asarray(shifts)[shift], 0),
        mass=jnp.where(certain, mass, 0.0),
        gain=jnp.where(certain & (mass > 0), gain, 0.0),
        novel=jnp.where(certain, novel, 1.0),
        entropy=-jnp.sum(jnp.where(shares > 0, shares * jnp.log(jnp.where(shares > 0, shares, 1.0)), 0.0)),
        second=_second(masses),
        agree=agree,
        background=weighing.background,
    )
    if config.sector_fov == "whiskers":
        memory = memory._replace(rest=jnp.where(rest[None] > 0, belief, 0.0))
    return memory._replace(anchor=anchor, offset=offset, mass=masses), recollection


def remember(memory: Memory, view: Array, label: Array, packet: Array) -> Memory:
    """The newest view becomes a frame at the robot's present pose."""
    row, pose = memory.count, present(memory)
    zero = jnp.zeros_like(memory.length)
    known = jnp.any(memory.label == label) | (label < 0)
    return memory._replace(
        view=memory.view.at[:, row].set(view[: memory.view.shape[0]]),
        label=memory.label.at[row].set(label),
        packet=memory.packet.at[row].set(packet),
        x=memory.x.at[row].set(pose[0]),
        y=memory.y.at[row].set(pose[1]),
        cosine=memory.cosine.at[row].set(jnp.cos(pose[2])),
        sine=memory.sine.at[row].set(jnp.sin(pose[2])),
        count=memory.count + 1,
        distinct=memory.distinct + (~known).astype(jnp.int32),
        pose=pose,
        motion=jnp.zeros_like(memory.motion),
        since=memory.since + memory.length,
        length=zero,
        turn=zero,
    )


def nothing(memory: Memory) -> RecallResult:
    """When no view became a frame."""
    zero = jnp.zeros_like(memory.length)
    return RecallResult(
        frame=jnp.int32(-1), match=jnp.int32(-1), shift=jnp.int32(0), mass=zero, gain=zero, novel=zero + 1,
        entropy=zero, second=zero, agree=jnp.int32(-1), background=jnp.full(SAMPLES, jnp.nan, zero.dtype),
    )  # fmt: skip


def old(config: RecallConfig, memory: Memory) -> Array:
    """[C] the frames that may be recalled."""
    return jnp.arange(memory.label.shape[0], dtype=jnp.int32) < memory.count - config.guard


def allowed(shifts: np.ndarray, memory: Memory) -> Array:
    """[S] the shifts that mean something: all once sectors are known to be ordered."""
    return (shifts == 0) | (memory.angle != 0)


def _align(
    config: RecallConfig,
    cell: float,
    memory: Memory,
    angles: Array,
    known: Array,
    here: Array,
) -> tuple[Array, Array]:
    """Every hypothesis moves with the robot and falls on the frames it comes to; novelty proposes new ones.

    Returns:
        prior mass at each shift and frame [S, C], and of novelty.
    """
    dtype = memory.x.dtype
    cells = allowed(offsets(config), memory)[:, None] & known[None]
    moved = correct_heading_bias(memory.motion, memory.length, memory.bias)
    at = memory.anchor
    heading = jnp.arctan2(memory.sine[at], memory.cosine[at])
    anchors = jnp.stack([memory.x[at], memory.y[at], heading], axis=1)
    poses = compose(compose(anchors, memory.offset), jnp.broadcast_to(moved, anchors.shape))

    def landing(pose: Array, sd: Array, sd_heading: Array) -> Array:
        apart = ((memory.x - pose[0]) ** 2 + (memory.y - pose[1]) ** 2) / sd**2
        turned = pose[2] - angles
        facing = jnp.cos(turned)[:, None] * memory.cosine[None] + jnp.sin(turned)[:, None] * memory.sine[None]
        deviation = apart[None] + (2 / sd_heading**2) * (1 - facing)
        inside = jnp.maximum(1 - deviation / SUPPORT, 0.0)
        return jnp.where(cells, inside**2 * inside**2, 0.0)

    reach = jnp.asarray(config.reach * cell, dtype), jnp.asarray(config.reach_heading, dtype)

    def carry(k: Array, sums: tuple[Array, Array]) -> tuple[Array, Array]:
        belief, novel = sums
        fall = landing(poses[k], *reach)
        total = jnp.sum(fall) + config.miss_weight
        stay = memory.mass[k] * (1 - config.mode_decay)
        belief = belief + (stay / total) * fall
        return belief, novel + stay * config.miss_weight / total + memory.mass[k] * config.mode_decay

    fresh = 1 - jnp.sum(memory.mass) - jnp.sum(memory.rest)
    shut = jnp.zeros(cells.shape, dtype), jnp.zeros((), dtype)
    if config.sector_fov == "whiskers":
        shut = _followed(config, cell, memory, angles, cells.astype(dtype), moved)
    belief, novel = lax.fori_loop(0, config.modes, carry, shut)
    near = landing(here, *spread(config, cell, memory))
    total = jnp.sum(near)
    local, everywhere = fresh * config.enter * config.local, fresh * config.enter * (1 - config.local)
    belief = belief + jnp.where(cells, everywhere / jnp.maximum(jnp.sum(cells), 1).astype(dtype), 0.0)
    belief = belief + (local / jnp.maximum(total, 1.0)) * near
    entered = jnp.where(jnp.any(known), everywhere, 0.0) + local * total / jnp.maximum(total, 1.0)
    return belief, novel + fresh - entered


def _followed(
    config: RecallConfig, cell: float, memory: Memory, angles: Array, cells: Array, moved: Array
) -> tuple[Array, Array]:
    """What is believed beside the hypotheses goes on along the way the frames were taken, each to the few
    frames that follow it; backwards where the robot faces against them.

    Returns:
        as `_align`.
    """
    beliefs, novel = [], jnp.zeros((), memory.x.dtype)
    index = jnp.arange(len(memory.x), dtype=jnp.int32)
    for s, sign in enumerate((1, -1)[: len(cells)]):
        cosine = memory.cosine * jnp.cos(angles[s]) - memory.sine * jnp.sin(angles[s])
        sine = memory.sine * jnp.cos(angles[s]) + memory.cosine * jnp.sin(angles[s])
        x = memory.x + cosine * moved[0] - sine * moved[1]
        y = memory.y + sine * moved[0] + cosine * moved[1]
        ahead = cosine * jnp.cos(moved[2]) - sine * jnp.sin(moved[2])
        aside = sine * jnp.cos(moved[2]) + cosine * jnp.sin(moved[2])
        falls = []
        for step in range(FOLLOWERS):
            to = index + sign * step
            there = (to >= 0) & (to < len(index))
            near = jnp.roll(jnp.stack([memory.x, memory.y, cosine, sine, cells[s]]), -sign * step, axis=1)
            apart = ((x - near[0]) ** 2 + (y - near[1]) ** 2) / (config.reach * cell) ** 2
            facing = ahead * near[2] + aside * near[3]
            inside = jnp.maximum(1 - (apart + (2 / config.reach_heading**2) * (1 - facing)) / SUPPORT, 0.0)
            falls.append(jnp.where(there, near[4] * inside**2 * inside**2, 0.0))
        total = sum(falls, jnp.full_like(x, config.miss_weight))
        stay = memory.rest[s] * (1 - config.mode_decay)
        zero = jnp.zeros_like(x)
        beliefs.append(
            sum((jnp.roll(stay * fall / total, sign * step) for step, fall in enumerate(falls)), zero)
        )
        novel = (
            novel + jnp.sum(stay * config.miss_weight / total) + jnp.sum(memory.rest[s]) * config.mode_decay
        )
    return jnp.stack(beliefs), novel


def _modes(
    config: RecallConfig, cell: float, memory: Memory, angles: Array, belief: Array
) -> tuple[tuple[Array, Array, Array], Array]:
    """The heaviest hypotheses: frames [K], mean pose around each in its frame [K, 3], mass [K]; and what is
    left [C].

    Frames within a cell of a heavier one are part of it.
    """
    mass = jnp.sum(belief, axis=0)
    cosine, sine = jnp.cos(angles) @ belief, jnp.sin(angles) @ belief
    ahead = cosine * memory.cosine - sine * memory.sine  # summed headings of the robot at each frame
    aside = cosine * memory.sine + sine * memory.cosine

    row = jnp.arange(len(mass), dtype=jnp.int32)

    def peel(rest: Array, _: None) -> tuple[Array, tuple[Array, Array, Array]]:
        frame = _peak(rest)
        dx, dy = memory.x - memory.x[frame], memory.y - memory.y[frame]
        member = (dx**2 + dy**2 < cell**2) & (rest > 0)
        # A way driven out and back has frames that face against each other: they are hypotheses of their own.
        member = member & ((ahead * ahead[frame] + aside * aside[frame] > 0) | (row == frame))
        part = jnp.where(member, rest, 0.0)
        total = jnp.sum(part)
        kept = total > 0
        divisor = jnp.where(kept, total, 1.0)
        x, y = jnp.sum(part * dx) / divisor, jnp.sum(part * dy) / divisor
        heading = jnp.arctan2(jnp.sum(jnp.where(member, aside, 0.0)), jnp.sum(jnp.where(member, ahead, 0.0)))
        c, s = memory.cosine[frame], memory.sine[frame]
        offset = jnp.stack([c * x + s * y, c * y - s * x, wrap(heading - jnp.arctan2(s, c))])
        return jnp.where(member, 0.0, rest), (frame, offset, jnp.where(kept, total, 0.0))

    rest, modes = lax.scan(peel, mass, None, length=config.modes)
    return modes, rest


def _peak(values: Array) -> Array:
    """Index of the first largest value; an argmax that compilers turn into vector code."""
    row = jnp.arange(len(values), dtype=jnp.int32)
    return jnp.min(jnp.where(values >= jnp.max(values), row, len(values) - 1))


def _second(masses: Array) -> Array:
    """The second largest mass [K] over the largest; 0 where there is none."""
    if len(masses) < 2:
        return jnp.zeros((), masses.dtype)
    ordered = jnp.sort(masses)
    return ordered[-2] / jnp.maximum(ordered[-1], 1e-9)
