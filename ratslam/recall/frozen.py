"""The memory of a finished map: views are compared with it and none is added."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from ratslam.recall.config import RecallConfig
from ratslam.recall.memory import MapFeedback, Memory, apply_map_feedback, init_memory


def frozen_memory(
    config: RecallConfig,
    feedback: MapFeedback,
    views: np.ndarray,
    labels: np.ndarray,
    capacity: int,
    dtype: np.dtype,
    groups: int,
) -> Memory:
    """A memory of N keyframes with an empty posterior.

    Args:
        feedback: poses [N, 3] and view metric of the map. views: [N, D], labels: [N] as recall stores them.
        capacity: rows, at least N. groups: see `init_memory`.
    """
    count = len(labels)
    empty = init_memory(config, views.shape[1], capacity, dtype, groups)
    view = np.zeros(empty.view.shape, empty.view.dtype)
    view[:, :count] = views.T
    label = np.full(capacity, -1, np.int32)
    label[:count] = labels
    filled = empty._replace(
        view=jnp.asarray(view),
        label=jnp.asarray(label),
        count=jnp.int32(count),
        distinct=jnp.int32(len(np.unique(labels[labels >= 0]))),
    )
    return apply_map_feedback(filled, feedback)


def first_keyframes(memory: Memory, count: int) -> Memory:
    """The memory as if it held only its first `count` keyframes, and had seen no view before."""
    label = np.array(memory.label)
    label[count:] = -1
    return memory._replace(
        count=jnp.int32(count),
        label=jnp.asarray(label),
        distinct=jnp.int32(len(np.unique(label[label >= 0]))),
        before=jnp.zeros_like(memory.before),
    )
