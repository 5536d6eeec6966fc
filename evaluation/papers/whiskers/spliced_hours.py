"""Hours of drifting whiskers made from a short record.

Drift and noise are fitted to its free whiskers, and its contacts are spliced in at known times.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from scipy.signal import lfilter

from tactile.base.random_streams import stream
from tactile.features.signal_noise import estimate_drift, estimate_noise

Decide = Callable[[np.ndarray], np.ndarray]
"""Contact [T, W] bool of the next samples [T, W, K] of a stream."""


class FreeModel(NamedTuple):
    """The signal of a free channel: a random walk and first-order autoregressive noise.

    Attributes:
        noise: [K] its standard deviation. correlation: [K] of neighbouring samples of the noise.
        drift: [K] standard deviation of the walk's step.
    """

    noise: np.ndarray
    correlation: np.ndarray
    drift: np.ndarray


class Snippet(NamedTuple):
    """A contact cut out of a record.

    Attributes:
        deviation: [S, K] from the baseline, with some samples before and after. first, last: the contact's.
    """

    deviation: np.ndarray
    first: int
    last: int


class Plant(NamedTuple):
    """A snippet in a block of a stream: its first and last sample, and its contact's; ends are exclusive."""

    first: int
    last: int
    begin: int
    end: int


class StreamScore(NamedTuple):
    """What a rule made of some hours.

    Attributes:
        contacts: planted, each longer than 0.1 s. missed: of them with less than half of it found.
        false: stretches found in contact with no snippet at that time. wrong: their samples.
        free: samples outside snippets.
    """

    contacts: int
    missed: int
    false: int
    wrong: int
    free: int


def fit_free_model(record: np.ndarray) -> FreeModel:
    """The model of free whiskers, each figure the largest of theirs.

    Args:
        record: [T, W, K] of whiskers that touch nothing.
    """
    noise = estimate_noise(record)
    difference = np.median(np.diff(record, axis=0) ** 2, axis=0) / 0.45494 / 2
    correlation = np.clip(1 - difference / noise**2, 0.0, 0.95)
    return FreeModel(noise.max(axis=0), correlation.max(axis=0), estimate_drift(record).max(axis=0))


def simulate_stream(
    model: FreeModel, snippets: Sequence[Snippet], whiskers: int, blocks: int, block: int, seed: int
) -> Iterator[tuple[np.ndarray, list[Plant]]]:
    """A drifting stream in blocks, in each of which every whisker has one contact of a drawn snippet.

    Yields:
        [block, W, K] samples, and each whisker's contact.
    """
    random, shape = stream(seed, "spliced hours"), (block, whiskers, len(model.noise))
    level, memory = np.zeros(shape[1:]), np.zeros(shape[1:])
    white = model.noise * np.sqrt(1 - model.correlation**2)
    for _ in range(blocks):
        walk = level + np.cumsum(model.drift * random.standard_normal(shape), axis=0)
        level, noise = walk[-1], np.empty(shape)
        push = white * random.standard_normal(shape)
        for channel, correlation in enumerate(model.correlation):
            start = correlation * memory[None, :, channel]
            noise[..., channel], _ = lfilter([1.0], [1.0, -correlation], push[..., channel], axis=0, zi=start)
        memory = noise[-1]
        planted = []
        for whisker in range(whiskers):
            snippet = snippets[int(random.integers(len(snippets)))]
            length = len(snippet.deviation)
            first = int(random.integers(block - length))
            noise[first : first + length, whisker] = snippet.deviation
            planted.append(Plant(first, first + length, first + snippet.first, first + snippet.last))
        yield walk + noise, planted


def score_stream(
    rules: Mapping[str, Decide], blocks: Iterable[tuple[np.ndarray, list[Plant]]]
) -> dict[str, StreamScore]:
    """Scores rules by name on the same stream of planted contacts."""
    scores = dict.fromkeys(rules, StreamScore(0, 0, 0, 0, 0))
    for samples, planted in blocks:
        for name, decide in rules.items():
            scores[name] = add_scores(scores[name], _score_block(decide(samples), planted))
    return scores


def add_scores(*scores: StreamScore) -> StreamScore:
    """The score of several parts of a stream together."""
    return StreamScore(*(sum(column) for column in zip(*scores, strict=True)))


def _score_block(contact: np.ndarray, planted: list[Plant]) -> StreamScore:
    """Scores [T, W] contacts of a block."""
    free = np.ones_like(contact)
    missed = 0
    for whisker, plant in enumerate(planted):
        missed += int(contact[plant.begin : plant.end, whisker].mean() < 0.5)
        free[plant.first : plant.last, whisker] = False
    wrong = contact & free
    false = np.count_nonzero(np.diff(wrong.astype(np.int8), prepend=0, axis=0) == 1)
    return StreamScore(len(planted), missed, int(false), int(wrong.sum()), int(free.sum()))
