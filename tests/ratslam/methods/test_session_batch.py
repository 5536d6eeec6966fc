"""Sessions of a batch end with the belief and memory of sessions by themselves."""

from __future__ import annotations

from functools import cache

import jax
import numpy as np
import pytest

from ratslam.methods.session_batch import Recording, RecordingSession, SessionBatch
from tests.ratslam.runs.touch_walks import empty_merging_session, simulate_walk

STEPS = 420
"""Not a whole number of chunks; keyframes are merged before."""


@cache
def recorded(seed: int, steps: int = STEPS) -> tuple[RecordingSession, Recording]:
    made = empty_merging_session(1)
    session = RecordingSession(made.backend, reserve=made.reserve)
    readings = simulate_walk(seed, path={"circuits": "CCCCCC"}).readings
    return session, session.record(readings[:steps])


def gap(found, expected) -> float:
    """The largest difference of two states."""
    pairs = zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True)
    return max(float(np.abs(np.asarray(a, float) - np.asarray(b, float)).max(initial=0.0)) for a, b in pairs)


def test_recording_does_not_change_a_session() -> None:
    session, recording = recorded(0)
    other = empty_merging_session(1)
    list(other.replay(simulate_walk(0, path={"circuits": "CCCCCC"}).readings[:STEPS]))
    assert gap(session.state, other.state) == 0
    assert sum(chunk[-1] for chunk in recording.chunks) == STEPS
    assert sum(chunk[0] is not None for chunk in recording.chunks) > 1


@pytest.mark.parametrize("at_once", [False, True])
def test_each_session_of_a_batch_ends_as_by_itself(at_once: bool) -> None:
    recordings = [recorded(seed)[1] for seed in (0, 1, 0)]
    assert gap(recordings[0].state, recordings[1].state) > 0.01
    states = SessionBatch(recorded(0)[0].backend, at_once).replay(recordings)
    for k, recording in enumerate(recordings):
        assert gap(jax.tree.map(lambda rows, k=k: rows[k], states), recording.state) < 1e-9


def test_sessions_of_other_lengths_are_refused() -> None:
    long, short = recorded(0)[1], recorded(0, STEPS - 3)[1]
    with pytest.raises(ValueError, match="same numbers of steps"):
        SessionBatch(recorded(0)[0].backend, False).replay([long, short])
