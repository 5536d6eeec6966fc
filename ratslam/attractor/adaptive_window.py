"""The ladder of patches on which the network is worked on: as few cells as are exact at this moment.

A settled packet fills some 200 cells however large the torus is. One small patch moves with it; after an
injection far away there is one for each of two packets, with one normaliser; then a larger one; at last the
whole torus. A step is tried on the lowest rung that holds the activity, and where the result would not be
exact it is made again from the same activity one rung up. A rung that is not needed costs nothing: it is the
body of a loop that does not run.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from ratslam.attractor import window
from ratslam.attractor.config import PoseCellConfig
from ratslam.attractor.window import Patch
from tactile.base.types import Array

SETTLED = 10
"""Cells across a packet as it settles, for the patch that moves with it (with the default kernels 16^3)."""
WIDE = 26
"""For the larger one (32^3)."""
WORTH = 0.5
"""Share of the torus beyond which a rung is left out."""
LOSS = 64
"""Activity that may be missing after a step, in units of rounding."""


class Rung(NamedTuple):
    """patches: how many of that shape, one for each packet. led: the patch follows the pose of its packet;
    else the middle of all its activity."""

    patch: Patch
    patches: int
    led: bool = False


class Block(NamedTuple):
    """What is worked on. activity: [C, H, Y, X]. origin: [C, 3] int32 over x, y, heading, its first cells."""

    activity: Array
    origin: Array


class Activity(NamedTuple):
    """Activity on one rung of the ladder.

    Attributes:
        blocks: one for each rung; only that of `rung` holds. rung: int32.
    """

    blocks: tuple[Block, ...]
    rung: Array


class Push(NamedTuple):
    """What happens to the activity in one step.

    Attributes:
        pose: [3] where the packet is, cells. recall: [3] where `energy` is injected. parts: int32 sub-steps.
            part: [3] body-frame motion of each, cells. behind: [3] lag to be made up in each. lag: of heading
            at the start.
    """

    pose: Array
    recall: Array
    energy: Array
    parts: Array
    part: Array
    behind: Array
    lag: Array


class Result(NamedTuple):
    """pose, spread: [3] of the strongest packet, cells. died: bool, activity was put back in between. rung:
    int32, where the step was made."""

    pose: Array
    spread: Array
    died: Array
    rung: Array


def rungs(config: PoseCellConfig, dtype: np.dtype) -> tuple[Rung, ...]:
    """From the smallest to the torus."""
    torus = Rung(window.patch(config, None, dtype), 1)
    if config.engine == "dense":
        return (torus,)
    small, wide = (window.patch(config, inner, dtype) for inner in (SETTLED, WIDE))
    lower = [Rung(small, 1, led=True), Rung(small, 2), Rung(wide, 1)]
    most = WORTH * np.prod(torus.patch.shape)
    return (*(rung for rung in lower if rung.patches * np.prod(rung.patch.shape) <= most), torus)


def empty(rung: Rung, dtype: np.dtype) -> Block:
    """Nothing."""
    return Block(jnp.zeros((rung.patches, *rung.patch.shape), dtype), jnp.zeros((rung.patches, 3), jnp.int32))


def seeded(ladder: tuple[Rung, ...], pose: Array) -> Activity:
    """A single cell's activity, between cells shared out, on the lowest rung."""
    patch, dtype = ladder[0].patch, pose.dtype
    origin = window.origin_about(patch, pose)
    cells = window.deposit(patch, jnp.zeros(patch.shape, dtype), origin, pose, jnp.ones((), dtype))
    above = tuple(empty(rung, dtype) for rung in ladder[1:])
    return Activity((Block(cells[None], origin[None]), *above), jnp.int32(0))


def spread_out(ladder: tuple[Rung, ...], activity: Activity) -> Array:
    """[K, N, N] the activity of the whole torus."""
    return _switched(ladder, len(ladder) - 1, activity, jnp.zeros(3, jnp.int32)).activity[0]


def whole(ladder: tuple[Rung, ...], activity: Array) -> Activity:
    """Activity [K, N, N] of the whole torus, on the last rung."""
    below = tuple(empty(rung, activity.dtype) for rung in ladder[:-1])
    return Activity((*below, Block(activity[None], jnp.zeros((1, 3), jnp.int32))), jnp.int32(len(ladder) - 1))


def climb(ladder: tuple[Rung, ...], activity: Activity, push: Push) -> tuple[Activity, Result]:
    """One step, on the lowest rung where it is exact.

    A ladder of a small patch alone tells of the second rung from the step on that it could not make.
    """
    if len(ladder) == 1:
        block, result, exact = _step(ladder[0], activity.blocks[0], push)
        missing = jnp.where(exact, activity.rung, 1).astype(jnp.int32)
        return Activity((block,), missing), result._replace(rung=missing)
    nothing = jnp.zeros_like(push.pose)
    carry = (activity.rung, activity.blocks[0], Result(nothing, nothing, jnp.bool_(False), jnp.int32(0)))
    # Loops of one round or none: what a branch hands on is copied, what a loop does not touch is not.
    to_try, block, result = lax.while_loop(_is_first, partial(_first, ladder, push), carry)
    now = Activity((block, *activity.blocks[1:]), jnp.int32(0))
    climbing = partial(_climbing, ladder, activity.blocks[0], activity.rung, push)
    _, after, result = lax.while_loop(lambda carry: carry[0] < len(ladder), climbing, (to_try, now, result))
    return after, result


def _is_first(carry: Any) -> Array:
    return carry[0] == 0


def _first(ladder: tuple[Rung, ...], push: Push, carry: Any) -> Any:
    block, result, exact = _step(ladder[0], carry[1], push)
    return jnp.where(exact, len(ladder), 1).astype(jnp.int32), block, result


def _climbing(ladder: tuple[Rung, ...], lowest: Block, held: Array, push: Push, carry: Any) -> Any:
    for k in range(1, len(ladder)):
        attempt = partial(_attempt, ladder, k, lowest, held, push)
        carry = lax.cond(carry[0] == k, attempt, lambda carry: carry, carry)
    return carry


def _attempt(ladder: tuple[Rung, ...], k: int, lowest: Block, held: Array, push: Push, carry: Any) -> Any:
    """The step on rung k; then down again if the lowest rung holds what it led to.

    Args:
        lowest: the block of the lowest rung before the step; the others are in `carry`, untouched so far.
        held: int32, the rung that holds the activity before the step.
    """
    _, now, _ = carry
    rung, last = ladder[k], k == len(ladder) - 1
    before = Activity((lowest, *now.blocks[1:]), held)
    source = _switched(ladder, k, before, window.origin_about(rung.patch, _middle(ladder, before, push)))
    block, result, exact = _step(rung, source, push)
    exact = (exact & _same(_mass(before), jnp.sum(source.activity))) | last
    low, fits = _lowered(ladder, rung, block, result.pose)
    blocks = list(now.blocks)
    blocks[0], blocks[k] = low, jax.tree.map(partial(jnp.where, exact), block, now.blocks[k])
    to_try = jnp.where(exact, len(ladder), k + 1).astype(jnp.int32)
    after = Activity(tuple(blocks), jnp.where(fits, 0, k).astype(jnp.int32))
    return to_try, after, result._replace(rung=jnp.int32(k))


def _step(rung: Rung, block: Block, push: Push) -> tuple[Block, Result, Array]:
    """Inject, then for each part attract and integrate; decode. And whether it is what the torus does."""
    patch = rung.patch
    block, exact = _injected(rung, block, push)

    def part(s: Array, carry: Any) -> Any:
        block, exact, died = carry
        exact &= _apart(rung, block)
        cells, dead = _attracted(rung, block, push.pose)
        block, whole = _integrated(rung, block._replace(activity=cells), push, s)
        return block, exact & whole, died | dead

    block, exact, died = lax.fori_loop(0, push.parts, part, (block, exact, jnp.bool_(False)))
    block = _strongest_first(rung, block)
    pose, spread = window.decode(patch, block.activity[0], block.origin[0])
    return block, Result(pose, spread, died, jnp.int32(0)), exact


def _injected(rung: Rung, block: Block, push: Push) -> tuple[Block, Array]:
    """Energy goes to the packet it is near to, else to a patch of its own."""
    patch, given = rung.patch, push.energy > 0
    near = jax.vmap(lambda origin: window.inside(patch, origin, push.recall))(block.origin)
    if rung.patches == 1:
        at, room, origin = jnp.int32(0), near[0], block.origin
    else:
        free = jnp.max(block.activity, axis=(1, 2, 3)) <= 0
        open_new = ~jnp.any(near & ~free)
        at = jnp.argmax(jnp.where(open_new, free, near & ~free)).astype(jnp.int32)
        room = ~open_new | jnp.any(free)
        fresh = jnp.where(open_new & given & room, window.origin_about(patch, push.recall), block.origin[at])
        origin = block.origin.at[at].set(fresh)
    cells = window.deposit(patch, block.activity[at], origin[at], push.recall, push.energy)
    return Block(block.activity.at[at].set(cells), origin), room | ~given


def _attracted(rung: Rung, block: Block, seed: Array) -> tuple[Array, Array]:
    """Normalised over all patches; a network that dies of it starts again from a seed [3].

    Uniform activity always dies: both kernels sum to 1, so it excites and inhibits itself alike.
    """
    cells = _each(rung, partial(window.kept, rung.patch), block.activity)
    total = jnp.sum(cells)
    dead = ~(total > 0)

    def again() -> Array:
        one = window.deposit(
            rung.patch, jnp.zeros_like(cells[0]), block.origin[0], seed, jnp.ones_like(total)
        )
        return jnp.zeros_like(cells).at[0].set(one)

    return lax.cond(dead, again, lambda: cells / jnp.where(dead, 1.0, total)), dead


def _integrated(rung: Rung, block: Block, push: Push, s: Array) -> tuple[Block, Array]:
    """One part of the motion, every patch following its packet; and whether nothing was left behind."""
    patch = rung.patch
    unit, done = patch.unit, s.astype(push.part.dtype)
    # Odometry is told in the frame the step began in; the packet has turned since, and lags behind it.
    aside = push.lag - done * (push.part[2] + push.behind[2])
    told = jnp.stack([*window.turned(push.part[0], push.part[1], aside * unit), push.part[2]])
    ahead = partial(_ahead, patch, push, done + 1)
    origin = block.origin
    if not patch.all_whole:
        middle = ahead(push.pose)[None] if rung.led else jax.vmap(partial(_following, patch, push))(block)
        origin = jax.vmap(partial(window.origin_about, patch))(middle)
    ring = window.torus(patch)[None]
    # A patch that is left behind follows a cell at a time.
    shift = jnp.clip((origin - block.origin + ring // 2) % ring - ring // 2, -1, 1)
    origin = (block.origin + shift) % ring

    def moved(cells: Array, first: Array, by: Array) -> Array:
        return window.integrate(patch, cells, first, told, push.behind, by)

    cells = _each(rung, moved, block.activity, block.origin, shift)
    whole = jnp.all(jax.vmap(partial(window.contained, patch))(cells)) & _same(jnp.sum(cells), 1.0)
    return Block(cells, origin), whole | patch.all_whole


def _ahead(patch: Patch, push: Push, parts: Array, pose: Array) -> Array:
    """About where a packet that was at a pose [3] when the step began is after some parts of it."""
    x, y = window.turned(push.part[0], push.part[1], pose[2] * patch.unit)
    return pose + parts * (jnp.stack([x, y, push.part[2]]) + push.behind)


def _following(patch: Patch, push: Push, block: Block) -> Array:
    """[3] about where the middle of one patch's activity is after this part."""
    low, high, some = _extent(patch, block)
    at = _ahead(patch, push, jnp.ones_like(push.energy), (low + high) / 2)
    kept = (block.origin + window.half(patch)).astype(low.dtype)
    return jnp.where(some, at, kept)


def _apart(rung: Rung, block: Block) -> Array:
    """Whether packets are so far from each other that none feels the other, bool."""
    if rung.patches == 1:
        return jnp.bool_(True)
    patch = rung.patch
    low, high, some = jax.vmap(partial(_extent, patch))(block)
    ring = window.torus(patch).astype(low.dtype)
    middle, half = (low + high) / 2, (high - low) / 2
    between = jnp.abs(window.around(middle[0] - middle[1], ring)) - half[0] - half[1]
    return jnp.any(between > patch.gap) | ~jnp.all(some)


def _extent(patch: Patch, block: Block) -> tuple[Array, Array, Array]:
    """[3] first and last cells with any activity over x, y, heading, and whether there is any."""
    cells, dtype = block.activity > 0, block.activity.dtype
    low, high = [], []
    for k, axis in zip((2, 1, 0), patch.axes[::-1], strict=True):
        among = jnp.any(cells, axis=tuple(a for a in range(3) if a != k))
        low.append(jnp.argmax(among))
        high.append(axis.size - 1 - jnp.argmax(among[::-1]))
    first = block.origin.astype(dtype)
    return first + jnp.stack(low).astype(dtype), first + jnp.stack(high).astype(dtype), jnp.any(cells)


def _strongest_first(rung: Rung, block: Block) -> Block:
    """The patch with the strongest packet in front; of equals, that whose peak comes first in the torus."""
    if rung.patches == 1:
        return block
    peak = jnp.max(block.activity, axis=(1, 2, 3))
    tied = peak >= jnp.max(peak) * (1 - window.TIE)
    place = jax.vmap(partial(window.peak_number, rung.patch))(block.activity, block.origin)
    front = jnp.argmin(jnp.where(tied, place, jnp.iinfo(jnp.int32).max))
    return jax.tree.map(lambda leaf: jnp.roll(leaf, -front, axis=0), block)


def _lowered(ladder: tuple[Rung, ...], rung: Rung, block: Block, pose: Array) -> tuple[Block, Array]:
    """The block on the lowest rung, and whether that holds all of it."""
    lowest = ladder[0]
    if rung.patch is lowest.patch:
        return jax.tree.map(lambda leaf: leaf[:1], block), jnp.max(block.activity[1:]) <= 0
    low = _transfer(rung, block, lowest, window.origin_about(lowest.patch, pose))
    held = jnp.sum(low.activity > 0) == jnp.sum(block.activity > 0)
    return low, held & window.contained(lowest.patch, low.activity[0])


def _middle(ladder: tuple[Rung, ...], activity: Activity, push: Push) -> Array:
    """[3] between the packet and another one, or else where energy is injected."""
    ring = window.torus(ladder[0].patch).astype(push.pose.dtype)
    other = jnp.where(push.energy > 0, push.recall, push.pose)
    for k, rung in enumerate(ladder):
        if rung.patches > 1:
            low, high, some = _extent(rung.patch, jax.tree.map(lambda leaf: leaf[1], activity.blocks[k]))
            other = jnp.where((activity.rung == k) & some, (low + high) / 2, other)
    return push.pose + window.around(other - push.pose, ring) / 2


def _switched(ladder: tuple[Rung, ...], k: int, activity: Activity, origin: Array) -> Block:
    """The activity on rung k, from whichever rung holds it; new patches begin at `origin` [3]."""

    def taken(j: int) -> Callable[[], Block]:
        if j == k:
            return lambda: activity.blocks[k]
        return lambda: _transfer(ladder[j], activity.blocks[j], ladder[k], origin)

    return lax.switch(jnp.minimum(activity.rung, k), [taken(j) for j in range(k + 1)])


def _transfer(source: Rung, block: Block, target: Rung, origin: Array) -> Block:
    """A block on another rung: the same patches and empty ones, or one patch that begins at `origin` [3]."""
    more = target.patches - source.patches
    if more > 0:
        return jax.tree.map(lambda leaf: jnp.pad(leaf, [(0, more)] + [(0, 0)] * (leaf.ndim - 1)), block)
    ring = window.torus(source.patch)[::-1]

    def shown(cells: Array, first: Array) -> Array:
        for k, axis in enumerate(target.patch.axes):
            size = source.patch.shape[k]
            at = (origin[2 - k] - first[2 - k] + np.arange(axis.size, dtype=np.int32)) % ring[k]
            part = jnp.take(cells, jnp.minimum(at, size - 1), axis=k)
            cells = jnp.where((at < size).reshape([-1 if a == k else 1 for a in range(3)]), part, 0.0)
        return cells

    cells = jnp.sum(jax.vmap(shown)(block.activity, block.origin), axis=0)
    return Block(cells[None], origin[None])


def _each(rung: Rung, function: Callable[..., Array], *blocks: Array) -> Array:
    """The function of every patch; of a single one without the cost of a batch."""
    if rung.patches == 1:
        return function(*(block[0] for block in blocks))[None]
    return jax.vmap(function)(*blocks)


def _mass(activity: Activity) -> Array:
    """Sum of all activity, on whichever rung."""
    sums = jnp.stack([jnp.sum(block.activity) for block in activity.blocks])
    return sums[activity.rung]


def _same(a: Array, b: Array | float) -> Array:
    return jnp.abs(a - b) <= LOSS * jnp.finfo(a.dtype).eps
