"""Window levels: a step of the published network, computed on the smallest window where it is exact.

A settled packet fills some 200 cells, however large the torus is. The levels are, from small to large: one
small window that moves with the packet; two small windows with one common normalisation, for a packet and a
distant injection; one larger window; the whole torus. Activity is held at one of them.

A step is tried at the smallest level that holds the activity; where the result would not be that of the whole
torus, it is computed again from the same activity one level up. Unused levels cost nothing: each is the body
of a loop that does not run.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from ratslam.classic.config import NetworkConfig
from ratslam.classic.excitation_inhibition import TIE, Window, make_window, ring_difference, rotate
from ratslam.core.estimates import PoseCellActivity
from tactile.base.types import Array

SETTLED = 10
"""Cells across a settled packet, inside the small window (16^3 cells with the default kernels)."""
WIDE = 26
"""Cells inside the larger window (32^3)."""
SUM_TOLERANCE = 64
"""Tolerance on the sum of activity after a step, in units of rounding."""
LARGEST_SHARE = 0.5
"""Levels with more than this share of the cells of the torus are omitted."""


class Level(NamedTuple):
    """A number of windows of one shape, one for each packet. follows_pose: the window follows the decoded
    pose of its packet; otherwise the middle of all activity in it."""

    window: Window
    windows: int
    follows_pose: bool = False


Levels = tuple[Level, ...]
"""From the smallest to the whole torus."""


class Block(NamedTuple):
    """The activity of one level: activity [C, H, Y, X] of its windows, and origin [C, 3], int32, the first
    cell of each window over x, y, heading."""

    activity: Array
    origin: Array


class Activity(NamedTuple):
    """One block for each level, of which only that of `level` (int32) is valid."""

    blocks: tuple[Block, ...]
    level: Array


def window_levels(config: NetworkConfig, dtype: np.dtype) -> Levels:
    """The levels from the smallest to the whole torus."""
    torus = Level(make_window(config, None, dtype), 1)
    if config.engine == "dense":
        return (torus,)
    small, wide = (make_window(config, inner, dtype) for inner in (SETTLED, WIDE))
    lower = [Level(small, 1, follows_pose=True), Level(small, 2), Level(wide, 1)]
    most = LARGEST_SHARE * np.prod(torus.window.shape)
    return (*(level for level in lower if level.windows * np.prod(level.window.shape) <= most), torus)


def point_activity(levels: Levels, pose: Array) -> Activity:
    """Unit activity at a pose [3], shared among its neighbour cells, at the smallest level."""
    smallest, dtype = levels[0].window, pose.dtype
    origin = smallest.origin_centred_on(pose)
    cells = smallest.deposit(jnp.zeros(smallest.shape, dtype), origin, pose, jnp.ones((), dtype))
    blocks = [Block(cells[None], origin[None])]
    for level in levels[1:]:
        empty = jnp.zeros((level.windows, *level.window.shape), dtype)
        blocks.append(Block(empty, jnp.zeros((level.windows, 3), jnp.int32)))
    return Activity(tuple(blocks), jnp.int32(0))


def to_full_torus(levels: Levels, activity: Activity) -> Array:
    """[K, N, N] the activity of the whole torus."""
    return _block_at(levels, len(levels) - 1, activity, jnp.zeros(3, jnp.int32)).activity[0]


def activity_sums(levels: Levels, activity: Activity) -> PoseCellActivity:
    """The activity summed over the headings, and over x and y; on the host, without compiling."""
    sizes = levels[-1].window.ring_sizes()
    xy, heading = np.zeros(sizes[1::-1]), np.zeros(sizes[2])
    block = activity.blocks[int(activity.level)]
    for cells, origin in zip(np.asarray(block.activity), np.asarray(block.origin), strict=True):
        ranges = zip(origin[::-1], cells.shape, sizes[::-1], strict=True)
        at = [(first + np.arange(size)) % ring for first, size, ring in ranges]
        np.add.at(xy, np.ix_(at[1], at[2]), cells.sum(axis=0))
        np.add.at(heading, at[0], cells.sum(axis=(1, 2)))
    return PoseCellActivity(xy, heading)


def _block_at(levels: Levels, k: int, activity: Activity, origin: Array) -> Block:
    """The activity at level k, from whichever level up to k holds it; a new window begins at `origin` [3]."""

    def transfer_from(j: int) -> Callable[[], Block]:
        if j == k:
            return lambda: activity.blocks[k]
        return lambda: _transfer(levels[j], activity.blocks[j], levels[k], origin)

    return lax.switch(jnp.minimum(activity.level, k), [transfer_from(j) for j in range(k + 1)])


def _transfer(source: Level, block: Block, target: Level, origin: Array) -> Block:
    """A block at another level: the same windows and empty ones, or one window from `origin` [3] on."""
    more = target.windows - source.windows
    if more > 0:
        return jax.tree.map(lambda leaf: jnp.pad(leaf, [(0, more)] + [(0, 0)] * (leaf.ndim - 1)), block)
    ring = source.window.ring_sizes()[::-1]

    def cut(cells: Array, first: Array) -> Array:
        for k, wanted in enumerate(target.window.shape):
            size = source.window.shape[k]
            at = (origin[2 - k] - first[2 - k] + np.arange(wanted, dtype=np.int32)) % ring[k]
            part = jnp.take(cells, jnp.minimum(at, size - 1), axis=k)
            cells = jnp.where((at < size).reshape([-1 if a == k else 1 for a in range(3)]), part, 0.0)
        return cells

    cells = jnp.sum(jax.vmap(cut)(block.activity, block.origin), axis=0)
    return Block(cells[None], origin[None])


def _extent(shape: Window, block: Block) -> tuple[Array, Array, Array]:
    """[3] first and last cells with activity over x, y, heading of one window, and bool: there are any."""
    cells, dtype = block.activity > 0, block.activity.dtype
    low, high = [], []
    for k in (2, 1, 0):
        among = jnp.any(cells, axis=tuple(a for a in range(3) if a != k))
        low.append(jnp.argmax(among))
        high.append(shape.shape[k] - 1 - jnp.argmax(among[::-1]))
    first = block.origin.astype(dtype)
    return first + jnp.stack(low).astype(dtype), first + jnp.stack(high).astype(dtype), jnp.any(cells)


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


StepResult = tuple[Array, Array, Array, Array]
"""Pose and spread [3] of the strongest packet, cells; bool, activity died out and was reseeded; and int32,
the level at which the step was computed."""


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
    pose, spread = level.window.decode(block.activity[0], block.origin[0])
    return block, (pose, spread, died, jnp.int32(0)), exact


def _equal_sums(a: Array, b: Array | float) -> Array:
    """bool: sums of activity that differ by rounding only."""
    return jnp.abs(a - b) <= SUM_TOLERANCE * jnp.finfo(a.dtype).eps


def _inject(level: Level, block: Block, inputs: StepInput) -> tuple[Block, Array]:
    """Energy goes into the window of the packet nearby, otherwise into a window of its own."""
    shape, given = level.window, inputs.energy > 0
    near = jax.vmap(lambda origin: shape.holds_deposit(origin, inputs.injection))(block.origin)
    if level.windows == 1:
        at, room, origin = jnp.int32(0), near[0], block.origin
    else:
        free = jnp.max(block.activity, axis=(1, 2, 3)) <= 0
        open_new = ~jnp.any(near & ~free)
        at = jnp.argmax(jnp.where(open_new, free, near & ~free)).astype(jnp.int32)
        room = ~open_new | jnp.any(free)
        centred = shape.origin_centred_on(inputs.injection)
        fresh = jnp.where(open_new & given & room, centred, block.origin[at])
        origin = block.origin.at[at].set(fresh)
    cells = shape.deposit(block.activity[at], origin[at], inputs.injection, inputs.energy)
    return Block(block.activity.at[at].set(cells), origin), room | ~given


def _attract(level: Level, block: Block, seed: Array) -> tuple[Array, Array]:
    """Activity after excitation and inhibition, normalised over all windows; and bool: it died out. Where it
    does, the torus gets unit activity at `seed` [3] instead; smaller windows leave that to the torus.

    Uniform activity always dies out: both kernels sum to 1, so excitation and inhibition cancel.
    """
    cells = _each_window(level, level.window.excite_and_inhibit, block.activity)
    total = jnp.sum(cells)
    dead = ~(total > 0)

    def reseed() -> Array:
        empty = jnp.zeros_like(cells[0])
        one = level.window.deposit(empty, block.origin[0], seed, jnp.ones_like(total))
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
    moved = jnp.stack([*rotate(inputs.motion[0], inputs.motion[1], angle * unit), inputs.motion[2]])
    origin = block.origin
    if not shape.is_torus:
        if level.follows_pose:
            middle = _predict(shape, inputs, done + 1, inputs.pose)[None]
        else:
            # The middle of each window's activity after this sub-step; an empty window stays.
            low, high, some = jax.vmap(partial(_extent, shape))(block)
            one = jnp.ones_like(inputs.energy)
            middle = jax.vmap(partial(_predict, shape, inputs, one))((low + high) / 2)
            unmoved = (block.origin + shape.cells_before_centre()[None]).astype(low.dtype)
            middle = jnp.where(some[:, None], middle, unmoved)
        origin = jax.vmap(shape.origin_centred_on)(middle)
    ring = shape.ring_sizes()[None]
    # A window that is behind its packet catches up by one cell per sub-step.
    shift = jnp.clip((origin - block.origin + ring // 2) % ring - ring // 2, -1, 1)
    origin = (block.origin + shift) % ring

    def translate(cells: Array, first: Array, by: Array) -> Array:
        return shape.integrate(cells, first, moved, inputs.lag, by)

    cells = _each_window(level, translate, block.activity, block.origin, shift)
    complete = jnp.all(jax.vmap(shape.margin_is_empty)(cells))
    return Block(cells, origin), (complete & _equal_sums(jnp.sum(cells), 1.0)) | shape.is_torus


def _predict(shape: Window, inputs: StepInput, substeps: Array, pose: Array) -> Array:
    """[3] approximate pose of a packet some sub-steps after it was at `pose` [3]."""
    x, y = rotate(inputs.motion[0], inputs.motion[1], pose[2] * shape.unit)
    return pose + substeps * (jnp.stack([x, y, inputs.motion[2]]) + inputs.lag)


def _packets_apart(level: Level, block: Block) -> Array:
    """bool: the packets are too far from each other to interact."""
    if level.windows == 1:
        return jnp.bool_(True)
    shape = level.window
    low, high, some = jax.vmap(partial(_extent, shape))(block)
    ring = shape.ring_sizes().astype(low.dtype)
    middle, half = (low + high) / 2, (high - low) / 2
    between = jnp.abs(ring_difference(middle[0] - middle[1], ring)) - half[0] - half[1]
    return jnp.any(between > shape.gap) | ~jnp.all(some)


def _strongest_first(level: Level, block: Block) -> Block:
    """The windows in order of their strongest packets; of equals, the peak first in the torus."""
    if level.windows == 1:
        return block
    peak = jnp.max(block.activity, axis=(1, 2, 3))
    tied = peak >= jnp.max(peak) * (1 - TIE)
    place = jax.vmap(level.window.peak_index)(block.activity, block.origin)
    front = jnp.argmin(jnp.where(tied, place, jnp.iinfo(jnp.int32).max))
    return jax.tree.map(lambda leaf: jnp.roll(leaf, -front, axis=0), block)


def _each_window(level: Level, function: Callable[..., Array], *blocks: Array) -> Array:
    """The function of every window; a single one is not batched, which is faster."""
    if level.windows == 1:
        return function(*(block[0] for block in blocks))[None]
    return jax.vmap(function)(*blocks)


def step_at_smallest(levels: Levels, activity: Activity, inputs: StepInput) -> tuple[Activity, StepResult]:
    """One step of the network, at the smallest level where it is exact.

    With the smallest level alone, `level` is 1 from the first step that was not exact there.
    """
    if len(levels) == 1:
        block, result, exact = step_at(levels[0], activity.blocks[0], inputs)
        missing = jnp.where(exact, activity.level, 1).astype(jnp.int32)
        return Activity((block,), missing), (*result[:3], missing)
    zero = jnp.zeros_like(inputs.pose)
    carry = (activity.level, activity.blocks[0], (zero, zero, jnp.bool_(False), jnp.int32(0)))

    # Loops of at most one round: XLA copies the results of a branch, but not the unchanged values of a loop.
    def at_smallest(carry: Any) -> Any:
        block, result, exact = step_at(levels[0], carry[1], inputs)
        return jnp.where(exact, len(levels), 1).astype(jnp.int32), block, result

    def at_larger(carry: Any) -> Any:
        for k in range(1, len(levels)):
            attempt = partial(_attempt, levels, k, activity.blocks[0], activity.level, inputs)
            carry = lax.cond(carry[0] == k, attempt, lambda carry: carry, carry)
        return carry

    to_try, block, result = lax.while_loop(lambda carry: carry[0] == 0, at_smallest, carry)
    now = Activity((block, *activity.blocks[1:]), jnp.int32(0))
    _, after, result = lax.while_loop(lambda carry: carry[0] < len(levels), at_larger, (to_try, now, result))
    return after, result


def _attempt(levels: Levels, k: int, smallest: Block, held: Array, inputs: StepInput, carry: Any) -> Any:
    """The step at level k; the result is moved to the smallest level if it fits there.

    Args:
        smallest: the block of the smallest level before the step; the others are in `carry`, unchanged.
        held: int32, the level that holds the activity before the step.
    """
    _, now, _ = carry
    level, last = levels[k], k == len(levels) - 1
    before = Activity((smallest, *now.blocks[1:]), held)
    source = _block_at(levels, k, before, level.window.origin_centred_on(_middle(levels, before, inputs)))
    block, result, exact = step_at(level, source, inputs)
    total = jnp.stack([jnp.sum(block.activity) for block in before.blocks])[held]
    exact = (exact & _equal_sums(total, jnp.sum(source.activity))) | last
    smallest_window = levels[0].window
    if level.window is smallest_window:
        low = jax.tree.map(lambda leaf: leaf[:1], block)
        fits = jnp.max(block.activity[1:]) <= 0
    else:
        low = _transfer(level, block, levels[0], smallest_window.origin_centred_on(result[0]))
        fits = jnp.sum(low.activity > 0) == jnp.sum(block.activity > 0)
        fits &= smallest_window.margin_is_empty(low.activity[0])
    blocks = list(now.blocks)
    blocks[0], blocks[k] = low, jax.tree.map(partial(jnp.where, exact), block, now.blocks[k])
    to_try = jnp.where(exact, len(levels), k + 1).astype(jnp.int32)
    after = Activity(tuple(blocks), jnp.where(fits, 0, k).astype(jnp.int32))
    return to_try, after, (*result[:3], jnp.int32(k))


def _middle(levels: Levels, activity: Activity, inputs: StepInput) -> Array:
    """[3] midway between the packet and the second one, or else the position of the injection."""
    ring = levels[0].window.ring_sizes().astype(inputs.pose.dtype)
    other = jnp.where(inputs.energy > 0, inputs.injection, inputs.pose)
    for k, level in enumerate(levels):
        if level.windows > 1:
            low, high, some = _extent(level.window, jax.tree.map(lambda leaf: leaf[1], activity.blocks[k]))
            other = jnp.where((activity.level == k) & some, (low + high) / 2, other)
    return inputs.pose + ring_difference(other - inputs.pose, ring) / 2
