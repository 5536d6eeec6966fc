"""The control of recall: a second filter that looks for the mirror image of every view.

It moves by mirrored motion and searches the same memory. No robot has seen the world mirrored, so every place
that it recognises is false, except where the world itself is symmetric. The closure sequences of the control
show how often and how strongly different places of this world are mistaken for each other. The method is
ours; the idea is that of decoys in proteomics (Elias & Gygi 2007).

Given ids have no mirror image; the control looks for permuted ids instead.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax

from ratslam.recall.config import RecallConfig
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


def control_config(config: RecallConfig) -> RecallConfig:
    """Settings of the control: no mass enters around the map's pose, where no mirrored robot is."""
    return config.model_copy(update={"local": 0.0})


def mirrored_memory(memory: Memory) -> Memory:
    """The memory with the posterior of the control, mirrored motion and mirrored bias."""
    motion = memory.motion * jnp.asarray(MIRROR, memory.motion.dtype)
    return memory._replace(**memory.control._asdict(), motion=motion, bias=-memory.bias)


def keep_control(memory: Memory, mirrored: Memory) -> Memory:
    """The memory with the posterior of the control updated from `mirrored`."""
    values = {name: getattr(mirrored, name) for name in memory.control._fields}
    return memory._replace(control=type(memory.control)(**values))


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
