"""Recall: what the view cells tell the pose cells, and what is read from them.

A single view seldom identifies a place, so no decision rests on one: odometry moves the belief of the pose
cells (`ratslam.network.pose_cells`), every view weighs it, and mass that no view cell explains is novelty. A
view similar to many keyframes carries little evidence, because the likelihood of novelty contains the mean
likelihood over all of them; a view that contradicts a keyframe removes its mass. Odometry aligns keyframes
but is never evidence. The map's pose enters as one more, weak, hypothesis.

The kernel is pure and of fixed shapes. Poses, bias, sector angle and the scale of view errors come from the
map as `MapFeedback`. No constant is in units of the sensor: errors count in scales, distances in pose cells.
Ancestors are Bayesian localisation (Fox et al. 1999) and the sequence matching of SeqSLAM (Milford & Wyeth
2012).
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from ratslam.network import pose_cells
from ratslam.network.config import Network
from ratslam.network.pose_cells import BASIN, SUPPORT, Belief, ViewCells
from ratslam.recall.config import RecallConfig, sector_shifts
from ratslam.recall.memory import Memory
from ratslam.recall.observation_model import SAMPLES, ObservationLikelihood
from tactile.base.se2 import wrap
from tactile.base.types import Array

FACING = float(np.cos(0.5))
"""Cosine of the largest heading difference at which a keyframe faces as the robot does."""


class RecallResult(NamedTuple):
    """Result of recall for one view.

    Attributes:
        keyframe: int32, the keyframe that the view became, -1 for none. match: int32, the most likely
            keyframe, -1 for none. shift: int32, sector shift of the view against it. posterior: of all
            keyframes within `BASIN` cells of it: of the heaviest packet. second: the same of the heaviest
            keyframe apart from it: of the packet that competes. log_ratio: log-likelihood ratio of the match
            against novelty. novelty: its posterior. view_fits: int32, 1 if the view fits a
            keyframe at the map's pose, 0 if it fits none there, -1 if none is there. background: [SAMPLES]
            errors against ruled-out keyframes, NaN for none.
    """

    keyframe: Array
    match: Array
    shift: Array
    posterior: Array
    second: Array
    log_ratio: Array
    novelty: Array
    view_fits: Array
    background: Array


def recognise(
    config: RecallConfig,
    network: Network,
    memory: Memory,
    belief: Belief,
    motion: Array,
    observation: ObservationLikelihood,
    local: Array | float,
) -> tuple[Belief, RecallResult]:
    """Updates the belief for a new keyframe, and finds the best candidate.

    One update of a hidden Markov model whose states are the view cells (k, s) and novelty, as the equations
    of `ratslam.network.pose_cells` have it: the prior moves with the odometry, each view cell is weighed by
    the likelihood of the view there, and the sum is normalised (Bayesian localisation, Fox et al. 1999).

    Args:
        network: the size of its cells is the unit of all lengths in `config`. memory: C keyframes with their
            poses in the map, m, m, rad.
        belief: after the last update. motion: [3] odometry since then, m, m, rad.
        observation: likelihood l_ks [S or 1, C] of the view at each shift and keyframe, and l_new.
        local: share of what enters anew that is put around the map's pose.

    Returns:
        the belief after the view, with mass [S, C] of the view cells; the candidate for a loop closure.
    """
    cell, shifts = network.cells.cell_size, sector_shifts(config)
    cells = view_cells(config, memory)
    known, certain, novelty = memory.recallable(config), observation.certain, observation.novelty
    likelihood = jnp.where(known[None], observation.likelihood, 0.0)

    # Prior: mass that odometry leads to each view cell, and mass e that enters anew from novelty.
    moved, lost = pose_cells.predict(network, belief, cells, motion)
    fresh = jnp.maximum(1 - jnp.sum(belief.activity), 0.0)
    entered = fresh * config.enter * _entry(config, cell, memory, cells, local)
    arrived, dtype = fresh + lost - jnp.sum(entered), memory.x.dtype
    # v_ks = l_ks [(1 - leak) (K'Y)_ks + e_ks] and n = l_new (novelty that stays + mass that found no view
    # cell), both divided by their sum; then A = K v.
    weighed = likelihood * (moved + entered).astype(dtype)
    mass, novel = pose_cells.inhibit(weighed, novelty * arrived.astype(dtype))
    belief = pose_cells.anchor(network, belief, cells, mass)

    # The heaviest packet, and the heaviest apart from it.
    match = _peak(jnp.max(mass, axis=0))
    shift = _peak(mass[:, match])
    basin = _basin(cell, memory, match)
    packet = jnp.sum(jnp.where(basin[None], mass, 0.0))
    others = jnp.where(basin, 0.0, jnp.sum(mass, axis=0))
    second = jnp.sum(jnp.where(_basin(cell, memory, _peak(others)), others, 0.0))
    gain = jnp.log(jnp.where(certain, jnp.broadcast_to(likelihood, mass.shape)[shift, match], 1.0) / novelty)
    # Does the view fit where the map says that the robot is: within a cell, facing alike?
    here = memory.current_pose()
    apart = (memory.x - here[0]) ** 2 + (memory.y - here[1]) ** 2
    facing = memory.cosine * jnp.cos(here[2]) + memory.sine * jnp.sin(here[2]) > FACING
    near = known & ((apart < cell**2) & facing)
    best = jnp.max(jnp.where(near, jnp.max(likelihood, axis=0), 0.0))
    is_informative = certain & observation.informative & jnp.any(near)
    found = certain & (packet > 0)
    return belief, RecallResult(
        keyframe=memory.count,
        match=jnp.where(found, match, -1),
        shift=jnp.where(found, jnp.asarray(shifts)[shift], 0),
        posterior=jnp.where(certain, packet, 0.0),
        second=jnp.where(certain, second, 0.0),
        log_ratio=jnp.where(found, gain, 0.0),
        novelty=jnp.where(certain, novel, 1.0),
        view_fits=jnp.where(is_informative, (best >= novelty).astype(jnp.int32), -1),
        background=observation.background,
    )


def view_cells(config: RecallConfig, memory: Memory) -> ViewCells:
    """The view cells [S, C] of a memory: one for each keyframe k and sector shift s, at the pose p_ks of a
    robot that sees the view of k shifted by s sectors; in single precision, as the pose cells are."""
    shifts, single = sector_shifts(config), jnp.float32
    angles = (-shifts.astype(memory.angle.dtype) * memory.angle).astype(single)  # of the robot
    rows = memory.x, memory.y, memory.heading, memory.cosine, memory.sine
    x, y, heading, own_cosine, own_sine = (values.astype(single)[None] for values in rows)
    cosine, sine = jnp.cos(angles)[:, None], jnp.sin(angles)[:, None]
    used = memory.allowed_shifts(shifts)[:, None] & memory.recallable(config)[None]
    return ViewCells(
        x=jnp.broadcast_to(x, used.shape),
        y=jnp.broadcast_to(y, used.shape),
        heading=heading + angles[:, None],
        cosine=own_cosine * cosine - own_sine * sine,
        sine=own_sine * cosine + own_cosine * sine,
        used=used.astype(single),
    )


def place_of(memory: Memory, result: RecallResult) -> Array:
    """[3] the pose, m, m, rad, of the view cell that a result names; any where there is none."""
    row = jnp.maximum(result.match, 0)
    turn = -result.shift.astype(memory.angle.dtype) * memory.angle
    return jnp.stack([memory.x[row], memory.y[row], wrap(memory.heading[row] + turn)])


def _entry(
    config: RecallConfig, cell: float, memory: Memory, cells: ViewCells, local: Array | float
) -> Array:
    """[S, C] shares of what enters anew, e_ks / sum e: over all view cells, and around the map's pose."""
    here = memory.current_pose().astype(cells.x.dtype)
    sd, sd_heading = (spread.astype(cells.x.dtype) for spread in memory.pose_spread(config, cell))
    apart = ((cells.x - here[0]) ** 2 + (cells.y - here[1]) ** 2) / sd**2
    facing = cells.cosine * jnp.cos(here[2]) + cells.sine * jnp.sin(here[2])
    inside = jnp.maximum(1 - (apart + (2 / sd_heading**2) * (1 - facing)) / SUPPORT, 0.0)
    near = cells.used * (inside**2 * inside**2)
    local = jnp.asarray(local, near.dtype)
    everywhere = (1 - local) / jnp.maximum(jnp.sum(cells.used), 1.0)
    around = local / jnp.maximum(jnp.sum(near), 1.0)
    return everywhere * cells.used + around * near


def _basin(cell: float, memory: Memory, row: Array) -> Array:
    """[C] whether each keyframe is in the packet of one."""
    return (memory.x - memory.x[row]) ** 2 + (memory.y - memory.y[row]) ** 2 < (BASIN * cell) ** 2


def empty_result(memory: Memory) -> RecallResult:
    """The result of a step without a keyframe."""
    zero = jnp.zeros_like(memory.length)
    return RecallResult(
        keyframe=jnp.int32(-1), match=jnp.int32(-1), shift=jnp.int32(0), posterior=zero, second=zero,
        log_ratio=zero, novelty=zero + 1, view_fits=jnp.int32(-1),
        background=jnp.full(SAMPLES, jnp.nan, zero.dtype),
    )  # fmt: skip


def _peak(values: Array) -> Array:
    """Index of the first largest value; an argmax that compiles to vector code."""
    row = jnp.arange(len(values), dtype=jnp.int32)
    return jnp.min(jnp.where(values >= jnp.max(values), row, len(values) - 1))
