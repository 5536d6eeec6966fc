"""Selection beside the session: its result is taken up at a fixed keyframe, however long it takes."""

from threading import Event

import numpy as np
import pytest

from ratslam.mapping import selection_worker
from ratslam.mapping.loop_closures import Verdict
from ratslam.mapping.selection_worker import DELAY, THREAD
from tests.ratslam.mapping.map_cases import LAP, drive, new_map, same, sequence

EVERY, BEGUN = 60, 240
"""Keyframes between two selections, and at the first with closures to select from."""
SELECTED = {"select_every": EVERY}
SEEN = sequence(LAP + 2, 2, 80, 5.0)
LAST = LAP + 90


@pytest.fixture(scope="module")
def whole():
    """The map after all keyframes, without a pause; tests only read it."""
    return drive(new_map(**SELECTED), SEEN, last=LAST)


@pytest.mark.parametrize("restored", [False, True])
def test_a_slow_selection_gives_the_same_bits_and_keeps_its_views_when_the_map_is_restored(restored, whole):
    gate, slow = Event(), drive(new_map(**SELECTED), SEEN, last=BEGUN - 1)
    THREAD.submit(gate.wait, 60)  # holds the thread back until the event is set
    drive(slow, SEEN, first=BEGUN - 1, last=BEGUN if restored else BEGUN + DELAY - 1)
    assert restored or slow.state.unmerged.count > BEGUN  # the session went on meanwhile
    if restored:
        selection = slow.selection.job.result
        slow.restore(new_map(**SELECTED).arrays())
        gate.set()
        expected = drive(new_map(**SELECTED), SEEN, last=BEGUN).arrays()
        for name, value in selection.result(60).arrays().items():
            assert np.array_equal(value, expected[f"selection/job/result/{name}"], equal_nan=True), name
    else:
        gate.set()
        assert same(drive(slow, SEEN, first=BEGUN + DELAY - 1, last=LAST), whole)


@pytest.mark.parametrize("every", [EVERY, 10])
def test_the_result_is_taken_up_after_the_delay_or_before_the_next_selection(every, monkeypatch):
    taken = []
    real = selection_worker.SelectedMap.take_up

    def take_up(self, graph):
        taken.append((len(self.poses), graph.count - len(self.poses)))
        real(self, graph)

    monkeypatch.setattr(selection_worker.SelectedMap, "take_up", take_up)
    drive(new_map(select_every=every), SEEN, last=LAST)
    assert {delay for _, delay in taken} == {min(every, DELAY)}
    assert taken == [(BEGUN, DELAY)] if every == EVERY else len(taken) > 3


SOAK = [pytest.param(at, marks=pytest.mark.soak) for at in (BEGUN - 3, BEGUN + DELAY + 1)]


@pytest.mark.parametrize("at", [BEGUN + 1, BEGUN + DELAY - 1, *SOAK])
def test_a_checkpoint_during_a_selection_continues_to_the_same_bits(at, whole):
    part = drive(new_map(**SELECTED), SEEN, last=at)
    restored = new_map(**SELECTED)
    restored.restore(part.arrays())
    assert same(drive(restored, SEEN, first=at, last=LAST), whole)
    assert same(drive(part, SEEN, first=at, last=LAST), whole)


def test_verdicts_given_while_a_selection_works_stay():
    """A sequence too short to be selected when the selection begins, and accepted before it is taken up."""
    early, late = sequence(LAP + 2, 2, 20, 5.0), sequence(BEGUN - 1, BEGUN - 1 - LAP, 60, 5.0)
    before, after = (
        drive(new_map(**SELECTED), early | late, last=last).arrays()["log/verdict"]
        for last in (BEGUN, BEGUN + DELAY)
    )
    assert before.tolist() == [Verdict.ACCEPTED, Verdict.OPEN]
    assert after.tolist() == [Verdict.ACCEPTED, Verdict.ACCEPTED]
