"""Spliced streams: the fitted model, reproducible, and scores that count false and missed contacts."""

from __future__ import annotations

from itertools import islice, pairwise

import numpy as np
from scipy.signal import lfilter

from evaluation.papers.whiskers.drift import (
    fit_free_model,
    score_stream,
    simulate_stream,
)
from tactile.base.random_streams import stream

MODEL = np.repeat([[2.0], [0.45], [0.1]], 3, axis=1)
SNIPPET = np.concatenate([np.zeros((10, 3)), np.full((40, 3), 500.0), np.zeros((10, 3))]), slice(10, 50)


def blocks(seed: int = 0, count: int = 20):
    return simulate_stream(MODEL, [SNIPPET], 4, count, 300, seed)


def test_the_fit_finds_the_model_of_its_own_stream() -> None:
    whites = stream(0, "fit").standard_normal((40_000, 1, 3))
    noise = 2.0 * np.sqrt(1 - 0.45**2) * lfilter([1.0], [1.0, -0.45], whites, axis=0)
    found = fit_free_model(noise + np.cumsum(0.1 * stream(1, "fit").standard_normal(noise.shape), axis=0))
    np.testing.assert_allclose(found[0], 2.0, rtol=0.1)
    np.testing.assert_allclose(found[1], 0.45, atol=0.1)
    np.testing.assert_allclose(found[2], 0.1, rtol=0.35)


def test_a_stream_follows_from_its_seed_and_does_not_jump_between_blocks() -> None:
    first, again, other = ([samples for samples, _ in blocks(seed, 5)] for seed in (0, 0, 1))
    for one, two in zip(first, again, strict=True):
        np.testing.assert_array_equal(one, two)
    assert not np.array_equal(first[0], other[0])
    jumps = [np.abs(b[0] - a[-1]).max() for a, b in pairwise(first)]
    assert max(jumps) < 20


def test_scores_count_false_and_missed_contacts() -> None:
    rules = {
        "always": lambda samples: np.ones(samples.shape[:2], bool),
        "never": lambda samples: np.zeros(samples.shape[:2], bool),
        "true": lambda samples: (np.abs(samples) > 200).any(axis=-1),
    }
    scores = score_stream(rules, blocks())
    free = 20 * 4 * (300 - 60)
    assert scores["never"].tolist() == [80, 80, 0, 0, free]
    assert scores["true"].tolist() == [80, 0, 0, 0, free]
    contacts, missed, false, *wrong = scores["always"].tolist()
    assert (contacts, missed, wrong) == (80, 0, [free, free])
    assert false >= 80


def test_parts_of_a_stream_add_up_to_the_whole() -> None:
    rule = {"true": lambda samples: (np.abs(samples) > 6).any(axis=-1)}
    made = blocks()
    parts = [score_stream(rule, islice(made, count))["true"] for count in (5, 15)]
    np.testing.assert_array_equal(sum(parts), score_stream(rule, blocks())["true"])
