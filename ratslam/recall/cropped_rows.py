"""The memory of recall after its map was cropped."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from ratslam.recall.memory import Memory, MergedRows, Modes, merge_rows
from tactile.base.se2 import compose


class CroppedRows(NamedTuple):
    """Rows of the memory after a map was cropped.

    Attributes:
        rows: the rows that remain; those that do not are taken to be merged with any other. left: [N] bool,
            former rows that remain. motion, length, turn: [3], m, rad: odometry from the newest row that
            remains to the newest former one. elsewhere: the robot is in a piece of the map that is gone, so
            that there is no such odometry.
    """

    rows: MergedRows
    left: np.ndarray
    motion: np.ndarray
    length: float
    turn: float
    elsewhere: bool


def crop_rows(memory: Memory, cropped: CroppedRows) -> Memory:
    """The memory reduced to rows; the posterior of the others becomes novelty."""
    left = np.zeros(memory.label.shape[0], bool)
    left[: len(cropped.left)] = cropped.left
    dtype = memory.x.dtype

    def lose(modes: Modes) -> Modes:
        mass = np.where(left[np.asarray(modes.anchor)], modes.mass, 0)
        rest = np.where(left, modes.rest, 0) if modes.rest.size else modes.rest
        return modes._replace(mass=jnp.asarray(mass, dtype), rest=jnp.asarray(rest, dtype))

    own = lose(Modes(*(getattr(memory, name) for name in Modes._fields)))
    memory = merge_rows(memory._replace(**own._asdict(), control=lose(memory.control)), cropped.rows)
    labels = np.asarray(memory.label)[: cropped.rows.rows]
    return memory._replace(
        distinct=jnp.asarray(len(np.unique(labels[labels >= 0])), jnp.int32),
        motion=jnp.asarray(compose(cropped.motion, np.asarray(memory.motion)), dtype),
        length=memory.length + jnp.asarray(cropped.length, dtype),
        turn=memory.turn + jnp.asarray(cropped.turn, dtype),
    )
