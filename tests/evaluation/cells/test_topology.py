"""Holes in the states of cells on a ring, on a torus and without order."""

import numpy as np
import pytest

from evaluation.cells import topology
from evaluation.cells.topology import find_holes, shuffled_holes
from tactile.base.errors import InputError

pytest.importorskip("ripser", reason="of the extra [topology]")


def cells(rings, count=40, steps=3000):
    """[T, C] of cells tuned to a random place on so many rings, at random places."""
    rng = np.random.default_rng(rings)
    angle, own = (rng.uniform(0, 2 * np.pi, (n, 1, rings)) for n in (steps, count))
    return np.exp(2 * (np.cos(angle - own[:, 0]).mean(axis=2) - 1))


def test_a_ring_has_one_loop_and_a_torus_two_and_a_void(monkeypatch):
    monkeypatch.setattr(topology, "LANDMARKS", 120)
    ring, torus = find_holes(cells(1)), find_holes(cells(2))
    assert ring.loops[0] > 5 * max(ring.loops[1:2].max(initial=0), ring.voids.max(initial=0))
    others = shuffled_holes(cells(2), 10.0, 3, 0)
    assert torus.loops[1] > 2 * max(each.loops[0] for each in others)
    assert torus.voids[0] > max(each.voids.max(initial=0) for each in others)
    assert (np.diff(torus.loops) <= 0).all()


def test_too_few_states_and_too_short_a_session_are_refused():
    with pytest.raises(InputError, match="activity: 40 states; expected at least 222"):
        find_holes(cells(1)[:40])
    with pytest.raises(InputError, match="activity: 30 s; expected more than 40 s"):
        shuffled_holes(cells(1)[:300], 10.0, 1, 0)
