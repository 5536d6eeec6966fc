"""Likelihood of a view, a whisker image or a given id at every keyframe and at a new place."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax

from ratslam.recall.config import RecallConfig, sector_shifts
from ratslam.recall.memory import Memory
from ratslam.recall.signed_likelihood import log_odds, project, unpack
from ratslam.recall.whisker_likelihood import PixelLayout
from tactile.base.types import Array

SAMPLES = 20
"""Number of errors against ruled-out keyframes reported to the map at each keyframe, for calibration."""
LABELS = {"same": 0.6, "unknown": 0.35, "other": 0.05, "new_unknown": 0.9, "new_known": 0.1}
"""Likelihood of a given id at a keyframe with the same id or another one (`unknown`: a new id), and at a
new place (new or known id). Ids are assumed to be right more often than not."""
LABEL_TEMPER = 0.7
"""Exponent of the likelihood of an id, because ids of consecutive views are not independent."""
STEPS = (0.02, 0.94, 0.02, 0.02)
"""Probabilities that the next image is that of the same keyframe, the next one, and so on."""


class ObservationLikelihood(NamedTuple):
    """Likelihoods of an observation.

    Attributes:
        likelihood: [S or 1, C] at each shift and keyframe. novelty: likelihood at a new place.
        background: see `RecallResult`. certain: whether recall can decide yet. informative: whether the
            observation is evidence about the current place (a label never given before is not).
    """

    likelihood: Array
    novelty: Array
    background: Array
    certain: Array
    informative: Array


Weighed = tuple[Memory, ObservationLikelihood]
"""The memory with an image's likelihoods, which the next image needs; the likelihood."""


def view_likelihood(config: RecallConfig, cell: float, memory: Memory, view: Array) -> ObservationLikelihood:
    """Likelihood of a view [D]. Novelty contains the mean over all keyframes, so that a view similar to many
    places is little evidence for any of them."""
    error = _errors(sector_shifts(config), memory, view)
    frames = memory.recallable(config)
    width = config.sharpness * memory.scale
    known = width > jnp.finfo(width.dtype).tiny
    width = jnp.where(known, width, 1.0)
    likelihood = jnp.where(frames[None], jnp.exp(-error / width), 0.0)
    shifts = jnp.sum(jnp.isfinite(error[:, 0]))
    mean = jnp.sum(likelihood) / (jnp.maximum(jnp.sum(frames), 1) * shifts).astype(width.dtype)
    floor = jnp.exp(-config.floor * memory.scale / width)
    novelty = config.common * mean + config.fresh * floor
    away = jnp.maximum(3 * cell, 3 * (0.5 * cell + 0.05 * (memory.since + memory.length)))
    here = memory.current_pose()
    apart = (memory.x - here[0]) ** 2 + (memory.y - here[1]) ** 2
    return ObservationLikelihood(
        likelihood=jnp.where(known, likelihood, 1.0),
        novelty=jnp.where(known, novelty, 1.0),
        background=_background(jnp.min(error, axis=0), frames & (apart > away**2)),
        certain=known & jnp.any(frames),
        informative=known,
    )


def touch_likelihood(config: RecallConfig, memory: Memory, level: Array, pixels: PixelLayout) -> Weighed:
    """Likelihood of a whisker image: levels [D].

    Pixels are not independent, so their log-odds are tempered.

    Returns:
        see `Weighed`.
    """
    row = memory.likeness[pixels.group, level]
    then = [memory.view, memory.view[pixels.opposite]][: len(sector_shifts(config))]
    odds = jnp.stack([jnp.sum(jnp.take_along_axis(row, levels, axis=1), axis=0) for levels in then])
    return _weigh(config, memory, config.temper * odds)


def signed_likelihood(config: RecallConfig, memory: Memory, image: Array) -> Weighed:
    """Likelihood of a signed image: its stored form [D]."""
    model = unpack(memory.likeness)
    odds = log_odds(model, project(model, image[:, None]), project(model, memory.view))
    return _weigh(config, memory, odds[None])


def _weigh(config: RecallConfig, memory: Memory, odds: Array) -> Weighed:
    """Likelihood of an image with these log-odds [S, C] against the keyframes.

    The likelihood at a new place is that at the successors of keyframes similar to the previous image,
    because images in corridors change alike.
    """
    frames = memory.recallable(config)
    certain = (memory.scale != 0) & jnp.any(frames)
    likelihood = jnp.where(frames[None] & certain, jnp.exp(odds), 0.0)
    expected = jnp.where(frames[None], _successors(memory.before), 0.0)
    total = jnp.sum(expected)
    familiar = jnp.sum(expected * likelihood) / jnp.where(total > 0, total, 1.0)
    share = jnp.where(total > 0, config.familiar, 0.0)
    novelty = share * familiar + (1 - share) * jnp.exp(config.temper * memory.scale)
    observation = ObservationLikelihood(
        likelihood=jnp.where(certain, likelihood, 1.0),
        novelty=jnp.where(certain, novelty, 1.0),
        background=jnp.full(SAMPLES, jnp.nan, memory.x.dtype),
        certain=certain,
        informative=certain,
    )
    return memory._replace(before=likelihood), observation


def _successors(before: Array) -> Array:
    """[S, C] likelihoods [S, C] of keyframes moved to their successors (predecessors for half turns)."""
    index = jnp.arange(before.shape[1], dtype=jnp.int32)

    def shift_mass(row: Array, by: int) -> Array:
        came = index - by
        return jnp.where((came >= 0) & (came < len(index)), jnp.roll(row, by), 0.0)

    rows = [
        sum(
            (share * shift_mass(before[s], sign * step) for step, share in enumerate(STEPS)),
            jnp.zeros_like(before[s]),
        )
        for s, sign in enumerate((1, -1)[: len(before)])
    ]
    return jnp.stack(rows)


def label_likelihood(config: RecallConfig, memory: Memory, label: Array) -> ObservationLikelihood:
    """Likelihood of a given id."""
    known = jnp.any(memory.label == label)
    share = 1 / jnp.maximum(memory.distinct + (~known).astype(jnp.int32), 1).astype(memory.x.dtype)
    other = jnp.where(known, LABELS["other"] * share, LABELS["unknown"])
    likelihood = jnp.where(memory.label == label, LABELS["same"], other)
    novelty = jnp.where(known, LABELS["new_known"] * share, LABELS["new_unknown"])
    return ObservationLikelihood(
        likelihood=(likelihood**LABEL_TEMPER)[None],
        novelty=novelty**LABEL_TEMPER,
        background=jnp.full(SAMPLES, jnp.nan, memory.x.dtype),
        certain=jnp.any(memory.recallable(config)),
        informative=known,
    )


def label_gains(distinct: int) -> tuple[float, float]:
    """Log-likelihood of a known id at a keyframe with the same id, and with another one, less that at a new
    place, nat.

    Args:
        distinct: number of known ids.
    """
    same, other = LABELS["same"] * max(distinct, 1), LABELS["other"]
    same, other = same / LABELS["new_known"], other / LABELS["new_known"]
    return LABEL_TEMPER * float(np.log(same)), LABEL_TEMPER * float(np.log(other))


def _errors(shifts: np.ndarray, memory: Memory, view: Array) -> Array:
    """[S, C] mean absolute difference between view[k:] and the stored views' [:-k] for each shift k; infinite
    for shifts that are not allowed because the sectors are not known to be ordered."""
    size = memory.view.shape[0]
    common = np.maximum(size - np.abs(shifts), 0)  # [S] rows that both have
    reach = int(np.max(np.abs(shifts)))
    padded = jnp.pad(view, reach)

    # One row after the other: a reduction over all rows at once takes several times as long.
    def add_row(total: Array, one: tuple[Array, Array]) -> tuple[Array, None]:
        row, stored = one
        seen = lax.dynamic_slice_in_dim(padded, row, 2 * reach + 1)[shifts + reach]
        both = (row + shifts >= 0) & (row + shifts < size)
        return total + jnp.where(both[:, None], jnp.abs(stored[None] - seen[:, None]), 0.0), None

    rows = jnp.arange(size, dtype=jnp.int32)
    total, _ = lax.scan(
        add_row, jnp.zeros((len(shifts), memory.view.shape[1]), view.dtype), (rows, memory.view)
    )
    mean = total / jnp.asarray(np.maximum(common, 1), view.dtype)[:, None]
    return jnp.where((memory.allowed_shifts(shifts) & (common > 0))[:, None], mean, jnp.inf)


def _background(error: Array, away: Array) -> Array:
    """[SAMPLES] of the errors [C], spread evenly over the keyframes ruled out by the map (`away` [C])."""
    rank = jnp.cumsum(away.astype(jnp.int32))
    count = rank[-1]
    ranks = (jnp.arange(SAMPLES, dtype=jnp.int32) * jnp.maximum(count - 1, 0)) // (SAMPLES - 1) + 1
    row = jnp.minimum(jnp.searchsorted(rank, ranks), len(rank) - 1)
    # With fewer than SAMPLES keyframes each is reported once.
    fresh = jnp.concatenate([jnp.ones(1, bool), row[1:] != row[:-1]])
    return jnp.where(fresh & (count > 0), error[row], jnp.nan)
