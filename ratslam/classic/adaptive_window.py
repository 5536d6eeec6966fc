"""The adaptive window: every step of the network is computed at the smallest window level that is exact.

A step is tried at the smallest level that holds the activity; where the result would not be exact, it is
computed again from the same activity one level up. Unused levels cost nothing: each is the body of a loop
that does not run.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax

from ratslam.classic import excitation_inhibition as window
from ratslam.classic.level_step import StepInput, StepResult, equal_sums, step_at
from ratslam.classic.levels import Activity, Block, Level, block_at, extent, total, transfer
from tactile.base.types import Array


def step_at_smallest_level(
    levels: tuple[Level, ...], activity: Activity, inputs: StepInput
) -> tuple[Activity, StepResult]:
    """One step of the network, at the smallest level where it is exact.

    With the smallest level alone, `level` is 1 from the first step that was not exact there.
    """
    if len(levels) == 1:
        block, result, exact = step_at(levels[0], activity.blocks[0], inputs)
        missing = jnp.where(exact, activity.level, 1).astype(jnp.int32)
        return Activity((block,), missing), result._replace(level=missing)
    zero = jnp.zeros_like(inputs.pose)
    carry = (activity.level, activity.blocks[0], StepResult(zero, zero, jnp.bool_(False), jnp.int32(0)))
    # Loops of at most one round: XLA copies the results of a branch, but not the unchanged values of a loop.
    to_try, block, result = lax.while_loop(_is_smallest, partial(_smallest, levels, inputs), carry)
    now = Activity((block, *activity.blocks[1:]), jnp.int32(0))
    larger = partial(_larger, levels, activity.blocks[0], activity.level, inputs)
    _, after, result = lax.while_loop(lambda carry: carry[0] < len(levels), larger, (to_try, now, result))
    return after, result


def _is_smallest(carry: Any) -> Array:
    return carry[0] == 0


def _smallest(levels: tuple[Level, ...], inputs: StepInput, carry: Any) -> Any:
    block, result, exact = step_at(levels[0], carry[1], inputs)
    return jnp.where(exact, len(levels), 1).astype(jnp.int32), block, result


def _larger(levels: tuple[Level, ...], smallest: Block, held: Array, inputs: StepInput, carry: Any) -> Any:
    for k in range(1, len(levels)):
        attempt = partial(_attempt, levels, k, smallest, held, inputs)
        carry = lax.cond(carry[0] == k, attempt, lambda carry: carry, carry)
    return carry


def _attempt(
    levels: tuple[Level, ...], k: int, smallest: Block, held: Array, inputs: StepInput, carry: Any
) -> Any:
    """The step at level k; the result is moved to the smallest level if it fits there.

    Args:
        smallest: the block of the smallest level before the step; the others are in `carry`, unchanged.
        held: int32, the level that holds the activity before the step.
    """
    _, now, _ = carry
    level, last = levels[k], k == len(levels) - 1
    before = Activity((smallest, *now.blocks[1:]), held)
    source = block_at(
        levels, k, before, window.origin_centred_on(level.window, _middle(levels, before, inputs))
    )
    block, result, exact = step_at(level, source, inputs)
    exact = (exact & equal_sums(total(before), jnp.sum(source.activity))) | last
    low, fits = _at_smallest(levels, level, block, result.pose)
    blocks = list(now.blocks)
    blocks[0], blocks[k] = low, jax.tree.map(partial(jnp.where, exact), block, now.blocks[k])
    to_try = jnp.where(exact, len(levels), k + 1).astype(jnp.int32)
    after = Activity(tuple(blocks), jnp.where(fits, 0, k).astype(jnp.int32))
    return to_try, after, result._replace(level=jnp.int32(k))


def _at_smallest(levels: tuple[Level, ...], level: Level, block: Block, pose: Array) -> tuple[Block, Array]:
    """The block moved to the smallest level, and bool: all of its activity fits there."""
    smallest = levels[0]
    if level.window is smallest.window:
        return jax.tree.map(lambda leaf: leaf[:1], block), jnp.max(block.activity[1:]) <= 0
    low = transfer(level, block, smallest, window.origin_centred_on(smallest.window, pose))
    held = jnp.sum(low.activity > 0) == jnp.sum(block.activity > 0)
    return low, held & window.margin_is_empty(smallest.window, low.activity[0])


def _middle(levels: tuple[Level, ...], activity: Activity, inputs: StepInput) -> Array:
    """[3] midway between the packet and the second one, or else the position of the injection."""
    ring = window.ring_sizes(levels[0].window).astype(inputs.pose.dtype)
    other = jnp.where(inputs.energy > 0, inputs.injection, inputs.pose)
    for k, level in enumerate(levels):
        if level.windows > 1:
            low, high, some = extent(level.window, jax.tree.map(lambda leaf: leaf[1], activity.blocks[k]))
            other = jnp.where((activity.level == k) & some, (low + high) / 2, other)
    return inputs.pose + window.ring_difference(other - inputs.pose, ring) / 2
