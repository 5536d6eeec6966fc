"""One step of the network at one window level, and whether its result is that of the whole torus."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from ratslam.classic import excitation_inhibition as window
from ratslam.classic.excitation_inhibition import Window
from ratslam.classic.levels import Block, Level, extent
from tactile.base.types import Array

SUM_TOLERANCE = 64
"""Tolerance on the sum of activity after a step, in units of rounding."""


class StepInput(NamedTuple):
    """Input of one step of the network.

    Attributes:
        pose: [3] of the packet, cells. injection: [3] where `energy` is injected, cells. substeps: int32.
            motion: [3] body-frame motion of each sub-step, cells. lag: [3] lag made up in each, cells.
            heading_lag: of the packet at the start, cells.
    """

    pose: Array
    injection: Array
    energy: Array
    substeps: Array
    motion: Array
    lag: Array
    heading_lag: Array


class StepResult(NamedTuple):
    """pose, spread: [3] of the strongest packet, cells. died: bool, activity died out and was reseeded.
    level: int32, at which the step was computed."""

    pose: Array
    spread: Array
    died: Array
    level: Array


def step_at(level: Level, block: Block, inputs: StepInput) -> tuple[Block, StepResult, Array]:
    """Injection, then attractor dynamics and path integration for each sub-step, then decoding.

    Returns:
        the new activity, the result, and bool: both equal those of the whole torus; if not, they are those of
        an unfinished step.
    """
    block, exact = _inject(level, block, inputs)

    def goes_on(carry: Any) -> Array:
        s, _, exact, _ = carry
        return (s < inputs.substeps) & exact  # the rest of an inexact step would be thrown away

    def substep(carry: Any) -> Any:
        s, block, exact, died = carry
        exact &= _packets_apart(level, block)
        cells, dead = _attract(level, block, inputs.pose)
        block, complete = _integrate(level, block._replace(activity=cells), inputs, s)
        return s + 1, block, exact & complete & (~dead | level.window.is_torus), died | dead

    carry = (jnp.int32(0), block, exact, jnp.bool_(False))
    _, block, exact, died = lax.while_loop(goes_on, substep, carry)
    block = _strongest_first(level, block)
    pose, spread = window.decode(level.window, block.activity[0], block.origin[0])
    return block, StepResult(pose, spread, died, jnp.int32(0)), exact


def equal_sums(a: Array, b: Array | float) -> Array:
    """bool: sums of activity that differ by rounding only."""
    return jnp.abs(a - b) <= SUM_TOLERANCE * jnp.finfo(a.dtype).eps


def _inject(level: Level, block: Block, inputs: StepInput) -> tuple[Block, Array]:
    """Energy goes into the window of the packet nearby, otherwise into a window of its own."""
    shape, given = level.window, inputs.energy > 0
    near = jax.vmap(lambda origin: window.holds_deposit(shape, origin, inputs.injection))(block.origin)
    if level.windows == 1:
        at, room, origin = jnp.int32(0), near[0], block.origin
    else:
        free = jnp.max(block.activity, axis=(1, 2, 3)) <= 0
        open_new = ~jnp.any(near & ~free)
        at = jnp.argmax(jnp.where(open_new, free, near & ~free)).astype(jnp.int32)
        room = ~open_new | jnp.any(free)
        centred = window.origin_centred_on(shape, inputs.injection)
        fresh = jnp.where(open_new & given & room, centred, block.origin[at])
        origin = block.origin.at[at].set(fresh)
    cells = window.deposit(shape, block.activity[at], origin[at], inputs.injection, inputs.energy)
    return Block(block.activity.at[at].set(cells), origin), room | ~given


def _attract(level: Level, block: Block, seed: Array) -> tuple[Array, Array]:
    """Activity after excitation and inhibition, normalised over all windows; and bool: it died out. Where it
    does, the torus gets unit activity at `seed` [3] instead; smaller windows leave that to the torus.

    Uniform activity always dies out: both kernels sum to 1, so excitation and inhibition cancel.
    """
    cells = _each_window(level, partial(window.excite_and_inhibit, level.window), block.activity)
    total = jnp.sum(cells)
    dead = ~(total > 0)

    def reseed() -> Array:
        one = window.deposit(
            level.window, jnp.zeros_like(cells[0]), block.origin[0], seed, jnp.ones_like(total)
        )
        return jnp.zeros_like(cells).at[0].set(one)

    normalised = cells / jnp.where(dead, 1.0, total)
    return lax.cond(dead, reseed, lambda: normalised) if level.window.is_torus else normalised, dead


def _integrate(level: Level, block: Block, inputs: StepInput, s: Array) -> tuple[Block, Array]:
    """Path integration of sub-step s, in which every window follows its packet; and bool: no activity was
    lost."""
    shape = level.window
    unit, done = shape.unit, s.astype(inputs.motion.dtype)
    # Odometry is given in the frame at the start of the step; the packet has turned since, and lags behind.
    angle = inputs.heading_lag - done * (inputs.motion[2] + inputs.lag[2])
    moved = jnp.stack([*window.rotate(inputs.motion[0], inputs.motion[1], angle * unit), inputs.motion[2]])
    origin = block.origin
    if not shape.is_torus:
        if level.follows_pose:
            middle = _predict(shape, inputs, done + 1, inputs.pose)[None]
        else:
            middle = jax.vmap(partial(_predict_middle, shape, inputs))(block)
        origin = jax.vmap(partial(window.origin_centred_on, shape))(middle)
    ring = window.ring_sizes(shape)[None]
    # A window that is behind its packet catches up by one cell per sub-step.
    shift = jnp.clip((origin - block.origin + ring // 2) % ring - ring // 2, -1, 1)
    origin = (block.origin + shift) % ring

    def translate(cells: Array, first: Array, by: Array) -> Array:
        return window.integrate(shape, cells, first, moved, inputs.lag, by)

    cells = _each_window(level, translate, block.activity, block.origin, shift)
    complete = jnp.all(jax.vmap(partial(window.margin_is_empty, shape))(cells))
    return Block(cells, origin), (complete & equal_sums(jnp.sum(cells), 1.0)) | shape.is_torus


def _predict(shape: Window, inputs: StepInput, substeps: Array, pose: Array) -> Array:
    """[3] approximate pose of a packet some sub-steps after it was at `pose` [3]."""
    x, y = window.rotate(inputs.motion[0], inputs.motion[1], pose[2] * shape.unit)
    return pose + substeps * (jnp.stack([x, y, inputs.motion[2]]) + inputs.lag)


def _predict_middle(shape: Window, inputs: StepInput, block: Block) -> Array:
    """[3] approximate middle of the activity of one window after this sub-step."""
    low, high, some = extent(shape, block)
    at = _predict(shape, inputs, jnp.ones_like(inputs.energy), (low + high) / 2)
    unmoved = (block.origin + window.cells_before_centre(shape)).astype(low.dtype)
    return jnp.where(some, at, unmoved)


def _packets_apart(level: Level, block: Block) -> Array:
    """bool: the packets are too far from each other to interact."""
    if level.windows == 1:
        return jnp.bool_(True)
    shape = level.window
    low, high, some = jax.vmap(partial(extent, shape))(block)
    ring = window.ring_sizes(shape).astype(low.dtype)
    middle, half = (low + high) / 2, (high - low) / 2
    between = jnp.abs(window.ring_difference(middle[0] - middle[1], ring)) - half[0] - half[1]
    return jnp.any(between > shape.gap) | ~jnp.all(some)


def _strongest_first(level: Level, block: Block) -> Block:
    """The windows in order of their strongest packets; of equals, the peak first in the torus."""
    if level.windows == 1:
        return block
    peak = jnp.max(block.activity, axis=(1, 2, 3))
    tied = peak >= jnp.max(peak) * (1 - window.TIE)
    place = jax.vmap(partial(window.peak_index, level.window))(block.activity, block.origin)
    front = jnp.argmin(jnp.where(tied, place, jnp.iinfo(jnp.int32).max))
    return jax.tree.map(lambda leaf: jnp.roll(leaf, -front, axis=0), block)


def _each_window(level: Level, function: Callable[..., Array], *blocks: Array) -> Array:
    """The function of every window; a single one is not batched, which is faster."""
    if level.windows == 1:
        return function(*(block[0] for block in blocks))[None]
    return jax.vmap(function)(*blocks)
