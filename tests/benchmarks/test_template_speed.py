"""Exact best match among 100 000 and 1 000 000 views of 18 pixels, beside comparing with all of them.

What a tree must look through grows with the threshold and with how alike the views are, so there are three
kinds of views and two thresholds. A near query is a stored view moved by up to the threshold, a far one
a new view of the same kind.
"""

from __future__ import annotations

import time
from functools import cache

import numpy as np
import pytest

from ratslam.templateindex import TemplateIndex

PIXELS = 18


def noise(count, stream):
    """Nothing known of one pixel from others: the hardest."""
    return stream.random((count, PIXELS))


def scenery(count, stream):
    """What is seen along a way: each view is like the one before, yet so much another that it was stored."""
    steps = stream.normal(0, 0.2, (count, PIXELS))
    steps[0] = stream.uniform(0, 2 * np.pi, PIXELS)
    return 0.5 + 0.5 * np.sin(np.cumsum(steps, axis=0))


def touch(count, stream):
    """Whiskers, most of which touch nothing: 30 heights, and silence."""
    heights = stream.integers(1, 30, (count, PIXELS)) / 30
    return heights * (stream.random((count, PIXELS)) < 0.4)


VIEWS = {"noise": noise, "scenery": scenery, "touch": touch}


@pytest.mark.parametrize("kind", VIEWS)
@pytest.mark.parametrize("count", [100_000, 1_000_000])
@pytest.mark.parametrize("threshold", [0.02, 0.05])
def test_best_match(benchmark, kind, count, threshold):
    stream, count = np.random.default_rng(0), count if benchmark.enabled else 3000
    views = VIEWS[kind](count, stream)
    index = TemplateIndex(PIXELS, threshold)
    for rows in np.array_split(views, 10):  # as many trees as a live index would have
        index.extend(rows)
    for row in views[:100]:  # a tail as well
        index.append(np.clip(row + 0.5, 0, 1.5))
    near = views[stream.integers(0, count, 100)] + stream.uniform(-threshold, threshold, (100, PIXELS))
    far = VIEWS[kind](100, stream)
    took = {name: each(index.query, queries) for name, queries in (("near", near), ("far", far))}
    plain = each(lambda view: brute(index.views, view), far[:5])[0]
    loop = each(lambda view: compiled()(index.views, view, threshold), far[:20])[0]
    near_us, far_us = (f"{name} {took[name][0]:.0f} us (p90 {took[name][1]:.0f})" for name in took)
    print(f"\n{kind}, {count}, threshold {threshold}: {near_us}, {far_us}", end="; ")
    print(f"numpy {plain:.0f} us, compiled loop {loop:.0f} us")
    benchmark.extra_info["near_us"], benchmark.extra_info["far_us"] = took["near"][0], took["far"][0]
    benchmark.pedantic(index.query, args=(near[0],), rounds=3)
    for view in [*near[:5], *far[:5]]:
        template, error = brute(index.views, view)
        found = index.query(view)
        assert found.template == (template if error <= threshold else -1)
        assert compiled()(index.views, view, threshold) == found.template


def test_appending(benchmark):
    """What a view costs that is added alone, all trees it ever goes into included."""
    views = noise(100_000 if benchmark.enabled else 3000, np.random.default_rng(0))

    def grown():
        index = TemplateIndex(PIXELS, 0.05)
        for view in views:
            index.append(view)
        return index

    start = time.perf_counter()
    index = grown()
    took = (time.perf_counter() - start) / len(views)
    print(f"\nappending {took * 1e6:.1f} us a view, put into {index.built / len(views):.1f} trees each")
    assert len(index) == len(views)
    benchmark.pedantic(index.append, args=(views[0],), rounds=3)


def each(call, queries):
    """Median and 90 % quantile of microseconds over queries, the first of which warms up."""
    call(queries[0])
    took = []
    for view in queries:
        start = time.perf_counter()
        call(view)
        took.append(time.perf_counter() - start)
    return np.quantile(took, [0.5, 0.9]) * 1e6


def brute(views, view):
    errors = np.abs(views - view).mean(axis=1)
    best = int(np.argmin(errors))
    return best, errors[best]


@cache
def compiled():
    """A loop over all views that leaves each as soon as it is farther than the best: as the classic C++."""

    @pytest.importorskip("numba").njit
    def matched(views, view, threshold):
        best, limit = -1, threshold * len(view)
        for row in range(len(views)):
            total = 0.0
            for k in range(len(view)):
                total += abs(views[row, k] - view[k])
                if total > limit:
                    break
            else:
                if total < limit or best < 0:
                    best, limit = row, total
        return best

    return matched
