"""The control of recall: a second belief that looks for the mirror image of every view.

It moves by mirrored motion and searches the same memory by the same functions. No robot has seen the world
mirrored, so every place that it recognises is false, except where the world itself is symmetric. The closure
sequences of the control show how often and how strongly different places of this world are mistaken for each
other. The method is ours; the idea is that of decoys in proteomics (Elias & Gygi 2007).

Given ids have no mirror image; the control looks for permuted ids instead.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from ratslam.network.pose_cells import Belief
from ratslam.recall.memory import Memory
from tactile.base.types import Array

MIRROR = np.array([1.0, -1.0, -1.0])
"""Factors that mirror a motion (dx, dy, dtheta)."""
NEVER_GIVEN = np.iinfo(np.int32).max
"""An id that no recording gives."""
HASH = 0x9E3779B1
"""Odd multiplier that scatters ids (Knuth 1998, 6.4)."""


class Candidate(NamedTuple):
    """Candidate of the control, see `RecallResult`."""

    mirror_match: Array
    mirror_shift: Array
    mirror_posterior: Array
    mirror_log_ratio: Array


class Look(NamedTuple):
    """What distinguishes recall from its control: the belief, the motion [3] (m, m, rad) by which it moves,
    the view and id that it looks for, and the share of what enters anew around the map's pose (none for the
    control, because no mirrored robot is there)."""

    belief: Belief
    motion: Array
    view: Array
    label: Array
    local: Array


def both_looks(memory: Memory, look: Look, control: Belief, mirrored: Array) -> Look:
    """The look of recall and that of its control, stacked along a first axis; one loop over both compiles
    recall once.

    Args:
        mirrored: the mirror image of the view.
    """
    other = Look(
        control,
        look.motion * jnp.asarray(MIRROR, look.motion.dtype),
        mirrored,
        permuted_label(memory, look.label),
        jnp.zeros_like(look.local),
    )
    return jax.tree.map(lambda *pair: jnp.stack(pair), look, other)


def mirror_view(view: Array, shape: tuple[int, int, int], angle: Array) -> Array:
    """The mirror image [D] of a view [D] of rows, columns and channels: ordered sectors (`angle` not 0) in
    reverse, else the columns of each row in reverse."""
    columns = jnp.flip(view.reshape(shape), axis=1).reshape(-1)
    return jnp.where(angle != 0, jnp.flip(view), columns)


def permuted_label(memory: Memory, label: Array) -> Array:
    """Another id of the memory, the same for equal ids until the number of keyframes has doubled;
    `NEVER_GIVEN` where there is none."""
    rows = jnp.left_shift(jnp.int32(1), 31 - lax.clz(jnp.maximum(memory.count, 1)))
    scattered = (label.astype(jnp.uint32) * jnp.uint32(HASH)) >> jnp.uint32(8)
    row = (scattered % rows.astype(jnp.uint32)).astype(jnp.int32)
    other = memory.label[row]
    return jnp.where((label < 0) | (other < 0) | (other == label), jnp.int32(NEVER_GIVEN), other)
