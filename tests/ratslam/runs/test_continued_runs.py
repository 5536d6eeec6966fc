"""Runs that go on from a map after another recording: none of their samples is left out or mapped twice."""

import json
import signal
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path

import numpy as np
import pytest

import ratslam
import ratslam.runs.runner
from ratslam.core.session import Session
from ratslam.runs.build_session import build_session
from ratslam.runs.continuation import resume_session
from ratslam.runs.run import process_source
from ratslam.runs.runner import open_runner
from ratslam.runs.saved_map import SavedMap, describe_readings, read_map, write_map
from ratslam.runs.settings.run_config import LoopConfig
from robot.recordings.formats import open_recording
from robot.recordings.recording_config import RecordingConfig
from robot.sources.in_memory import InMemorySource
from robot.sources.source import Sample
from tests.ratslam.runs.test_saved_map import rewritten

TRACE = Path(__file__).parents[2] / "golden" / "a_square3.npz"
METHOD = {
    "pose_cells": {"cells_xy": 11, "cells_heading": 12, "cell_size": 0.1},
    "attractor": {"engine": "dense"},
}
FIRST, SECOND = 60, 100
"""Samples of the two recordings; the first ends amid a chunk of the session."""


class Killed(Exception):
    pass


def interrupt() -> None:
    signal.raise_signal(signal.SIGINT)


def kill() -> None:
    raise Killed


@dataclass(frozen=True, eq=False)
class Stopping(InMemorySource):
    number: int = -1
    happens: Callable[[], None] = interrupt

    def __iter__(self) -> Iterator[Sample]:
        for number, sample in enumerate(super().__iter__()):
            if number == self.number:
                self.happens()
            yield sample


def part(name: str, rows: slice) -> InMemorySource:
    with open_recording(RecordingConfig(file=TRACE)) as whole:
        assert isinstance(whole, InMemorySource)
        names = ("time", "motion", "moved", "views", "seen", "label", "truth")
        return replace(whole, name=name, digest=name, **{each: getattr(whole, each)[rows] for each in names})


first = partial(part, "monday", slice(FIRST))
second = partial(part, "tuesday", slice(FIRST, FIRST + SECOND))


def stopping(number: int, happens: Callable[[], None]) -> Stopping:
    return Stopping(**vars(second()), number=number, happens=happens)


@cache
def compiled() -> Session:
    return build_session(LoopConfig.model_validate(METHOD), first())


def run(source: InMemorySource, directory: Path, resume: Path | None = None, *warned: str) -> SavedMap:
    config, session = LoopConfig.model_validate(METHOD), compiled()
    session.restart()
    with open_runner(config, source, directory, resume, session, warnings=list(warned)) as runner:
        runner.finish(process_source(runner, source))
    return read_map(directory)


@pytest.fixture(scope="module")
def monday(tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("continued") / "monday"
    run(first(), directory)
    return directory


@pytest.fixture(scope="module")
def expected(monday: Path) -> SavedMap:
    return run(second(), monday.with_name("whole"), monday)


def test_warnings_about_the_input_go_with_the_map(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of readers and of the judge of motion, those of the map first, each once."""
    told = iter((["a gap"], ["a gap", "a jump"]))
    found: list[tuple[np.ndarray, np.ndarray, str, float]] = []
    monkeypatch.setattr(ratslam.runs.runner, "judge_motion", lambda *args: found.append(args) or next(told))
    for name, source, resume, wanted in (
        ("a", first(), None, ["cut off", "a gap"]),
        ("b", second(), tmp_path / "a", ["cut off", "a gap", "late", "a jump"]),
    ):
        run(source, tmp_path / name, resume, *(["cut off", "late"] if resume else ["cut off"]))
        manifest = json.loads((tmp_path / name / "manifest.json").read_text())
        assert manifest["input"] == {"verdict": "warned", "warnings": wanted}
        result = ratslam.Result(tmp_path / name)
        assert list(result.warnings) == list(result.scorecard.health.warnings) == wanted
        assert result.health.input == "warned"
    time, motion, where, interval = found[1]
    assert (where, interval) == ("tuesday", 0.0)
    np.testing.assert_array_equal(time, second().time)
    np.testing.assert_allclose(motion[:, :3], second().motion[:, :3], atol=1e-12)
    np.testing.assert_allclose(motion[1:, 3], np.diff(time))


def assert_same(found: SavedMap, expected: SavedMap) -> None:
    assert (found.steps, found.arrays.keys()) == (FIRST + SECOND, expected.arrays.keys())
    for name, array in expected.arrays.items():
        np.testing.assert_array_equal(found.arrays[name], array, err_msg=name)
    assert found.digest == expected.digest


def test_an_interrupted_run_goes_on_after_its_own_samples(monday, expected, tmp_path):
    """Twice: at a sample within a chunk of the session, and before the end."""
    parts = [run(stopping(30, interrupt), tmp_path / "a", monday)]
    parts.append(run(stopping(70, interrupt), tmp_path / "b", tmp_path / "a"))
    assert FIRST < parts[0].steps < parts[1].steps < FIRST + SECOND
    assert [each.samples_of("tuesday") for each in parts] == [each.steps - FIRST for each in parts]
    assert [each.samples_of("monday") for each in parts] == [None, None]
    assert_same(run(second(), tmp_path / "c", tmp_path / "b"), expected)
    times = [np.loadtxt(tmp_path / each / "online.tum", usecols=0) for each in "abc"]
    np.testing.assert_array_equal(np.concatenate(times), second().time)


def test_a_killed_run_goes_on_from_its_checkpoint(monday, expected, tmp_path, monkeypatch):
    monkeypatch.setattr(ratslam.runs.runner, "CHECKPOINT_EVERY", 16)
    with pytest.raises(Killed):
        run(stopping(45, kill), tmp_path / "killed", monday)
    assert 0 < read_map(tmp_path / "killed").steps - FIRST < 45
    assert_same(run(second(), tmp_path / "rest", tmp_path / "killed"), expected)


of_first_format = partial(rewritten, drop=("earlier",), format="ratslam-map-1")
"""A copy of a map file in the format that does not tell which steps are of the last recording."""


def test_a_map_in_the_first_format_goes_on_if_it_tells_its_samples(expected, tmp_path):
    whole = run(second(), tmp_path / "whole")
    run(stopping(45, interrupt), tmp_path / "a")
    found = run(second(), tmp_path / "b", of_first_format(tmp_path / "a" / "map.npz", tmp_path / "a.npz"))
    assert found.steps == whole.steps
    maps = [saved.open_session().map for saved in (found, whole)]
    np.testing.assert_array_equal(*(map.trajectory() for map in maps))
    old = of_first_format(expected.path, tmp_path / "old.npz")
    message = r"old\.npz: 160 steps of several recordings.*continue the map that this one went on from"
    with pytest.raises(ratslam.InputError, match=message):
        run(second(), tmp_path / "refused", old)
    assert run(part("wednesday", slice(160, 170)), tmp_path / "other", old).samples_of("wednesday") == 10
    with pytest.raises(ratslam.InputError, match=f"already holds all {SECOND} samples of tuesday"):
        run(second(), tmp_path / "again", expected.path)


def test_a_map_of_one_piece_takes_no_other_recording_and_no_other_method(monday, tmp_path):
    config = LoopConfig.model_validate(METHOD | {"backend": "classic"})
    session, source = build_session(config, first()), describe_readings(first())
    write_map(tmp_path / "map.npz", session, config, source, recording="monday")
    assert resume_session(session, tmp_path, config, first())[0] == 0
    for recording in ("tuesday", ""):
        other = replace(second(), name=recording or "loop", digest=recording)
        message = rf"map\.npz: a map of `backend: classic`, which is one piece; {other.name} is not the "
        with pytest.raises(ratslam.InputError, match=f"{message}recording.*by itself, or map both with"):
            resume_session(session, tmp_path, config, other)
        assert session.steps == session.earlier == 0
    with pytest.raises(
        ratslam.InputError, match=r"backend is classic and was recall.*`--set backend=recall`"
    ):
        resume_session(session, monday, config, second())
