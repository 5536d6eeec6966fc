"""A slow or dead mapper does not affect the arm; the recording shows which images were dropped."""

from __future__ import annotations

import os
import signal

import numpy as np

from robot.recordings.mcap_reader import Recording
from tests.ratslam.live.bench import Bench
from tests.ratslam.live.expected_outcomes import ended


def test_a_slow_mapper(bench: Bench) -> None:
    """Images are dropped, odometry never; the recording repeats it."""
    with bench.session(mapper=0.55, budget=0.3, whisks=10) as session:
        assert session.code() == 0, session.output()
        report, recorded = session.report(), session.recorded()
        assert report["outcome"] == "complete"
        assert report["standing"]
        assert report["whisks"] == 10
        assert 3 <= report["dropped"] <= 9
        assert recorded.names().count("dropped") == report["dropped"]
        seen = [len(sample.reading.time) > 0 for sample in recorded.samples]
        assert seen.count(False) == report["dropped"]
        assert seen[0]
        recording = Recording(session.directory / "session.mcap")
        assert recording.length == 10
        for sample, again in zip(recorded.samples, recording, strict=True):
            assert (sample.time, sample.reading.odometry) == (again.time, again.reading.odometry)
            assert len(sample.reading.time) == len(again.reading.time)
        # The whole path is recorded: the arm's odometry has no errors here.
        x = np.cumsum([sample.reading.odometry.dx for sample in recorded.samples])
        truth = np.array([sample.truth[0] for sample in recorded.samples])
        np.testing.assert_allclose(x - x[0], truth - truth[0], atol=1e-6)
        assert x[-1] > 0.05


def test_the_mapper_is_killed(bench: Bench) -> None:
    with bench.in_motion() as session:
        at = bench.moment()
        os.kill(session.mapper(), signal.SIGKILL)
        report, _ = ended(bench, session, "mapper_gone", at)
        assert report["standing"]
