"""Whiskers, grids and gaps, as read back from a drawing."""

from __future__ import annotations

import numpy as np
import pytest
from rerun.chunk import RrdReader

from ratslam.core.estimates import GridDrawing
from ratslam.runs.runner import MapReport, RunDescription, StepReport
from ratslam.service.viewer_process import Drawing, open_recording, whisker_curves
from tactile.base.types import Odometry, observation
from tactile.whisker_geometry import HeadConfig, ur10_head

HEAD = ur10_head(HeadConfig(dead=(7,)))
WHISKERS = len(HEAD.length)
NO_CLOSURES = np.zeros((0, 3), int)


def step(number, **changes):
    seen = observation(Odometry(0.1, 0.0, 0.0, 1.0), np.full((3, 6, 1), 0.5), whiskers=WHISKERS)
    pose = np.array([0.1 * number, 0.0, 0.0])
    return StepReport(number, 10.0 + number, seen._replace(**changes), pose, pose, 0, -1, False, np.nan)


@pytest.fixture
def drawn(tmp_path):
    """A function that draws reports with the whiskers of a head and returns the rows of an entity."""

    def draw(*updates):
        recording = open_recording(str(tmp_path / "view.rrd"))
        drawing = Drawing(recording)
        drawing.begin(RunDescription("test", "recall", HEAD, 0.05))
        for steps, made in updates:
            drawing.update(steps, made)
        drawing.finish(updates[-1][1] or MapReport(NO_CLOSURES, None))
        recording.disconnect()
        chunks = list(RrdReader(tmp_path / "view.rrd").stream().collect().stream())

        def rows(entity, component):
            found = {}
            for chunk in chunks:
                batch = chunk.to_record_batch()
                names = [name for name in batch.schema.names if name.endswith(component)]
                if chunk.entity_path == entity and names and not chunk.is_static:
                    found |= dict(zip(batch["step"].to_pylist(), batch[names[0]].to_pylist(), strict=True))
            return found

        return rows

    return draw


def test_whiskers_bend_to_their_contacts(drawn):
    contact = np.isin(np.arange(WHISKERS), [2, 7])  # the latter is dead
    point = np.tile([0.04, 0.02], (WHISKERS, 1))
    rows = drawn(([step(0, contact=contact, alive=HEAD.alive, point=point), step(1)], None))
    strips = np.array(rows("/world/robot/head/whiskers", "LineStrips3D:strips")[0])
    expected = whisker_curves(HEAD, contact & HEAD.alive, point, np.full(WHISKERS, 0.025))
    assert np.abs(strips - expected).max() < 1e-6
    assert np.abs(strips[2, -1] - [0.04, 0.02, 0.025]).max() < 1e-6
    colours = rows("/world/robot/head/whiskers", "LineStrips3D:colors")[0]
    assert len({colours[2], colours[7], colours[0]}) == 3
    assert colours[0] == colours[1]
    contacts = rows("/world/robot/head/contacts", "Points3D:positions")
    assert (len(contacts[0]), len(contacts[1])) == (1, 0)


def test_the_first_row_of_a_grid_is_drawn_lowest(drawn):
    grid = GridDrawing(np.array([[0.0, 0.1, 0.2], [0.3, 0.4, 1.0]]), np.array([-1.0, 2.0]), 0.5)
    rows = drawn(([step(0)], MapReport(NO_CLOSURES, None, np.zeros((1, 3)), grid)))
    (data,) = rows("/world/grid", "GridMap:data")[0]
    assert list(data) == [30, 40, 100, 0, 10, 20]  # images begin with the upper row
    ((x, y, _),) = rows("/world/grid", "GridMap:translation")[0]
    assert (x, y) == (-1.0, 2.0)


def test_dropped_steps_leave_gaps_only(drawn):
    """Steps 2 to 5 were dropped; a closure of one of them is drawn all the same."""
    closures = np.array([[0, 3, 1], [1, 900, 1]])  # the latter is of a step that is not known yet
    rows = drawn(([step(0), step(1)], None), ([step(6)], MapReport(closures, None)))
    assert sorted(rows("/world/robot", "Transform3D:translation")) == [0, 1, 6]
    (strip,) = rows("/world/online/recent", "LineStrips3D:strips")[6]
    assert [round(point[0], 6) for point in strip] == [0.0, 0.1, 0.6]
    (line,) = rows("/world/closures/accepted", "LineStrips3D:strips")[6]
    assert np.allclose(
        line, [[0.0, 0.0, 0.0], [0.6, 0.0, 0.0]], atol=1e-6
    )  # step 3 stands at the next known pose


def test_verdicts_are_told_once_and_an_accepted_one_that_falls_is_dropped(drawn):
    verdicts = [[[0, 9, 0]], [[0, 9, 0]], [[0, 9, 1]], [[0, 9, 0]], np.zeros((0, 3))]
    updates = [([step(k)], MapReport(np.array(one, int), None)) for k, one in enumerate(verdicts)]
    told = drawn(*updates)("/judgements", "TextLog:text")
    assert told == {
        k: [f"step 9 with step 0: {word}"] for k, word in ((0, "open"), (2, "accepted"), (3, "dropped"))
    }
