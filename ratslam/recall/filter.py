"""Recall: a Bayes filter over remembered keyframes, the sector shift that aligns them, and novelty.

A single view seldom identifies a place, so the filter never decides on one: odometry moves the posterior,
every view weighs it, and mass that no keyframe explains goes to novelty. A view similar to many keyframes
carries little evidence, because the likelihood of novelty contains the mean likelihood over all of them; a
view that contradicts a keyframe removes its mass. Odometry aligns keyframes but is never evidence. The map's
pose enters as one more, weak, hypothesis.

The kernel is pure and of fixed shapes. Poses, bias, sector angle and the scale of view errors come from the
map as `MapFeedback`. No constant is in units of the sensor: errors count in scales, distances in pose cells.
The filter is ours; its ancestors are Bayesian localisation (Fox et al. 1999) and the sequence matching of
SeqSLAM (Milford & Wyeth 2012).

Transition of the recall filter: the modes of the posterior move with the odometry to other keyframes.

Whiskers: mass outside the modes moves along the sequence of keyframes. Mass that arrives at no keyframe goes
to novelty, and a share of novelty enters anew, in part around the map's pose.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax

from ratslam.recall.config import RecallConfig, sector_shifts
from ratslam.recall.memory import (
    Memory,
    allowed_shifts,
    corrected_motion,
    current_pose,
    pose_spread,
    recallable,
)
from ratslam.recall.observation_model import SAMPLES, ObservationLikelihood
from tactile.base.se2 import compose, wrap
from tactile.base.types import Array

BASIN = 2.0
"""Radius around the best keyframe, cells, whose mass counts as the candidate's."""
FACING = float(np.cos(0.5))
"""Cosine of the largest heading difference at which a keyframe faces as the robot does."""


class RecallResult(NamedTuple):
    """Result of recall for one view.

    Attributes:
        keyframe: int32, the keyframe that the view became, -1 for none. match: int32, the most likely
            keyframe, -1 for none. shift: int32, sector shift of the view against it. posterior: of all
            keyframes within `BASIN` cells of it. log_ratio: log-likelihood ratio of the match against
            novelty. novelty: its posterior. entropy: of modes and novelty, nats. second_mode: mass of the
            second heaviest mode over the heaviest. view_fits: int32, 1 if the view fits a keyframe at the
            map's pose, 0 if it fits none there, -1 if none is there. background: [SAMPLES] errors against
            ruled-out keyframes, NaN for none.
    """

    keyframe: Array
    match: Array
    shift: Array
    posterior: Array
    log_ratio: Array
    novelty: Array
    entropy: Array
    second_mode: Array
    view_fits: Array
    background: Array


def recognise(
    config: RecallConfig,
    cell: float,
    memory: Memory,
    observation: ObservationLikelihood,
    local: Array | float,
) -> tuple[Memory, RecallResult]:
    """Updates the posterior for a new keyframe: moves it, weighs it by the view, and finds the best
    candidate.

    Args:
        cell: m, the unit of all lengths in the configuration. local: share of new modes around the map's
            pose.
    """
    shifts = sector_shifts(config)
    angles = -shifts.astype(memory.angle.dtype) * memory.angle  # robot's heading minus the keyframe's
    known, certain, novelty = recallable(config, memory), observation.certain, observation.novelty
    likelihood = jnp.where(known[None], observation.likelihood, 0.0)
    here = current_pose(memory)

    belief, novel = predict(config, cell, memory, angles, known, here, local)
    belief, novel = belief * likelihood, novel * novelty
    total = jnp.maximum(jnp.sum(belief) + novel, jnp.finfo(novel.dtype).tiny)
    belief, novel = belief / total, novel / total

    match = _peak(jnp.max(belief, axis=0))
    shift = _peak(belief[:, match])
    basin = (memory.x - memory.x[match]) ** 2 + (memory.y - memory.y[match]) ** 2 < (BASIN * cell) ** 2
    mass = jnp.sum(jnp.where(basin[None], belief, 0.0))
    gain = jnp.log(jnp.where(certain, likelihood[shift, match], 1.0) / novelty)
    (anchor, offset, masses), rest = _modes(config, cell, memory, angles, belief)
    near = known & _is_here(cell, memory, here)
    best = jnp.max(jnp.where(near, jnp.max(likelihood, axis=0), 0.0))
    told = certain & observation.informative & jnp.any(near)

    result = RecallResult(
        keyframe=memory.count,
        match=jnp.where(certain & (mass > 0), match, -1),
        shift=jnp.where(certain & (mass > 0), jnp.asarray(shifts)[shift], 0),
        posterior=jnp.where(certain, mass, 0.0),
        log_ratio=jnp.where(certain & (mass > 0), gain, 0.0),
        novelty=jnp.where(certain, novel, 1.0),
        entropy=_entropy(masses),
        second_mode=_second_mode(masses),
        view_fits=jnp.where(told, (best >= novelty).astype(jnp.int32), -1),
        background=observation.background,
    )
    if config.sector_fov == "whiskers":
        memory = memory._replace(rest=jnp.where(rest[None] > 0, belief, 0.0))
    return memory._replace(anchor=anchor, offset=offset, mass=masses), result


def _entropy(masses: Array) -> Array:
    """Entropy of the modes' masses [K] and of novelty, nat."""
    shares = jnp.concatenate([masses, jnp.maximum(1 - jnp.sum(masses, keepdims=True), 0.0)])
    return -jnp.sum(jnp.where(shares > 0, shares * jnp.log(jnp.where(shares > 0, shares, 1.0)), 0.0))


def _is_here(cell: float, memory: Memory, here: Array) -> Array:
    """[C] whether each keyframe is within a cell of the pose `here` [3] and faces alike."""
    apart = (memory.x - here[0]) ** 2 + (memory.y - here[1]) ** 2
    facing = memory.cosine * jnp.cos(here[2]) + memory.sine * jnp.sin(here[2]) > FACING
    return (apart < cell**2) & facing


def empty_result(memory: Memory) -> RecallResult:
    """The result of a step without a keyframe."""
    zero = jnp.zeros_like(memory.length)
    return RecallResult(
        keyframe=jnp.int32(-1), match=jnp.int32(-1), shift=jnp.int32(0), posterior=zero, log_ratio=zero,
        novelty=zero + 1, entropy=zero, second_mode=zero, view_fits=jnp.int32(-1),
        background=jnp.full(SAMPLES, jnp.nan, zero.dtype),
    )  # fmt: skip


def _modes(
    config: RecallConfig, cell: float, memory: Memory, angles: Array, belief: Array
) -> tuple[tuple[Array, Array, Array], Array]:
    """The heaviest modes: keyframes [K], mean pose of each in its keyframe's frame [K, 3], mass [K]; and the
    remaining mass [C].

    Keyframes within a cell of a heavier one belong to its mode.
    """
    mass = jnp.sum(belief, axis=0)
    cosine, sine = jnp.cos(angles) @ belief, jnp.sin(angles) @ belief
    ahead = cosine * memory.cosine - sine * memory.sine  # summed headings of the robot at each keyframe
    aside = cosine * memory.sine + sine * memory.cosine

    row = jnp.arange(len(mass), dtype=jnp.int32)

    def peel(rest: Array, _: None) -> tuple[Array, tuple[Array, Array, Array]]:
        frame = _peak(rest)
        dx, dy = memory.x - memory.x[frame], memory.y - memory.y[frame]
        member = (dx**2 + dy**2 < cell**2) & (rest > 0)
        # A path driven out and back has keyframes of opposite headings: they are separate modes.
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
    """Index of the first largest value; an argmax that compiles to vector code."""
    row = jnp.arange(len(values), dtype=jnp.int32)
    return jnp.min(jnp.where(values >= jnp.max(values), row, len(values) - 1))


def _second_mode(masses: Array) -> Array:
    """The second largest mass [K] over the largest; 0 where there is none."""
    if len(masses) < 2:
        return jnp.zeros((), masses.dtype)
    ordered = jnp.sort(masses)
    return ordered[-2] / jnp.maximum(ordered[-1], 1e-9)


SUPPORT = 8.0
"""Squared deviation at which the alignment kernel (1 - d2 / 8)^4 ends: like exp(-d2 / 2), but compact."""
FOLLOWERS = 4
"""Number of keyframes that may follow a keyframe: itself, the next one, and two further."""


def predict(
    config: RecallConfig,
    cell: float,
    memory: Memory,
    angles: Array,
    known: Array,
    here: Array,
    local_share: Array | float,
) -> tuple[Array, Array]:
    """The prior: every mode moves with the robot to the keyframes near it, and novelty enters as new modes.

    Args:
        angles: [S] turn of each shift, rad. known: [C] bool, recallable keyframes. here: [3] current pose.
        local_share: share of new modes around the current pose.

    Returns:
        prior mass at each shift and keyframe [S, C], and of novelty.
    """
    dtype = memory.x.dtype
    cells = allowed_shifts(sector_shifts(config), memory)[:, None] & known[None]
    moved = corrected_motion(memory)
    at = memory.anchor
    heading = jnp.arctan2(memory.sine[at], memory.cosine[at])
    anchors = jnp.stack([memory.x[at], memory.y[at], heading], axis=1)
    poses = compose(compose(anchors, memory.offset), jnp.broadcast_to(moved, anchors.shape))

    reach = jnp.asarray(config.reach * cell, dtype), jnp.asarray(config.reach_heading, dtype)

    def carry(k: Array, sums: tuple[Array, Array]) -> tuple[Array, Array]:
        belief, novel = sums
        fall = _overlap(memory, poses[k], angles, cells, *reach)
        total = jnp.sum(fall) + config.miss_weight
        stay = memory.mass[k] * (1 - config.mode_decay)
        belief = belief + (stay / total) * fall
        return belief, novel + stay * config.miss_weight / total + memory.mass[k] * config.mode_decay

    fresh = 1 - jnp.sum(memory.mass) - jnp.sum(memory.rest)
    shut = jnp.zeros(cells.shape, dtype), jnp.zeros((), dtype)
    if config.sector_fov == "whiskers":
        shut = follow_keyframes(config, cell, memory, angles, cells.astype(dtype), moved)
    belief, novel = lax.fori_loop(0, config.modes, carry, shut)
    near = _overlap(memory, here, angles, cells, *pose_spread(config, cell, memory))
    total = jnp.sum(near)
    local, everywhere = fresh * config.enter * local_share, fresh * config.enter * (1 - local_share)
    belief = belief + jnp.where(cells, everywhere / jnp.maximum(jnp.sum(cells), 1).astype(dtype), 0.0)
    belief = belief + (local / jnp.maximum(total, 1.0)) * near
    entered = jnp.where(jnp.any(known), everywhere, 0.0) + local * total / jnp.maximum(total, 1.0)
    return belief, novel + fresh - entered


def _overlap(memory: Memory, pose: Array, angles: Array, cells: Array, sd: Array, sd_heading: Array) -> Array:
    """[S, C] alignment kernel between a pose [3] and every keyframe at every shift."""
    apart = ((memory.x - pose[0]) ** 2 + (memory.y - pose[1]) ** 2) / sd**2
    turned = pose[2] - angles
    facing = jnp.cos(turned)[:, None] * memory.cosine[None] + jnp.sin(turned)[:, None] * memory.sine[None]
    deviation = apart[None] + (2 / sd_heading**2) * (1 - facing)
    inside = jnp.maximum(1 - deviation / SUPPORT, 0.0)
    return jnp.where(cells, inside**2 * inside**2, 0.0)


def follow_keyframes(
    config: RecallConfig, cell: float, memory: Memory, angles: Array, cells: Array, moved: Array
) -> tuple[Array, Array]:
    """Moves the mass outside the modes along the order of the keyframes, from each to the few that follow it;
    backwards where the robot faces the other way.

    Args:
        cells: [S, C] 1 where a keyframe may be recalled, else 0. moved: [3] motion since the newest keyframe.

    Returns:
        as `predict`.
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
