"""Saved maps merged into one: what joins, what stays apart, maps of the same session; killed merges."""

from __future__ import annotations

import signal
import subprocess
import sys
from dataclasses import replace
from functools import cache, partial
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ratslam
from ratslam.cli import main
from ratslam.core.session import Session
from ratslam.places.crop import keyframes_of_steps
from ratslam.runs import merge as merging
from ratslam.runs.map_care import crop_saved, undo_sequence
from ratslam.runs.map_settings import differing_settings
from ratslam.runs.merge import check_mergeable, describe_merge, merge_maps
from ratslam.runs.saved_map import describe_readings, read_map, write_map
from ratslam.runs.settings.completion import complete
from robot.recordings.formats import open_recording
from robot.recordings.recording_config import RecordingConfig
from robot.simulation.head.simulated_session import HeadSimulation
from robot.touch_source import open_touch_source
from tactile.base.errors import InputError
from tactile.base.se2 import between
from tests.ratslam.runs.test_map_formats import FILES
from tests.ratslam.runs.touch_walks import (
    LAPS,
    SMALL,
    Walk,
    config_of,
    dead_reckoning,
    empty_session,
    follow,
    metric,
    simulate_walk,
)

READINGS = Path(__file__).parents[2] / "golden" / "touch_circuits.mcap"
WHOLE = FILES[-1]


MAZES = {1: 31001, 2: 31001, 3: 31002}
"""The maze of each session, by its seed."""


def session_in(seed: int) -> dict[str, Any]:
    return {"seed": seed} | LAPS | {"maze": SMALL | {"seed": MAZES[seed]}}


@cache
def walk_of(seed: int) -> Walk:
    return simulate_walk(**session_in(seed))


@pytest.fixture(scope="module")
def maps(tmp_path_factory: pytest.TempPathFactory) -> dict[int, Path]:
    """The map of each session."""
    folder = tmp_path_factory.mktemp("maps")
    for seed in MAZES:
        config = config_of(simulation=session_in(seed))
        assert config.simulation is not None
        source = HeadSimulation(config.simulation)
        config, session = complete(config, source), empty_session()
        follow(session, walk_of(seed).readings)
        described = describe_readings(open_touch_source(source, config.touch))
        write_map(folder / f"{seed}.npz", session, config, described)
    return {seed: folder / f"{seed}.npz" for seed in MAZES}


@pytest.fixture(scope="module")
def joined(maps: dict[int, Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("joined") / "both.npz"
    merge_maps([maps[1], maps[2]], path)
    return path


def map_in(path: Path) -> Any:
    return read_map(path).open_session().map


def test_two_sessions_of_a_maze_become_one_map(maps: dict[int, Path], joined: Path) -> None:
    made, kept = map_in(joined), [map_in(maps[seed]).state.count for seed in (1, 2)]
    order = sorted((1, 2), key=lambda seed: read_map(maps[seed]).digest)
    truth = np.concatenate([walk_of(seed).truth for seed in order])
    assert not made.pieces().any()
    union = metric(made.map_trajectory(), truth)
    alone = metric(map_in(maps[1]).map_trajectory(), walk_of(1).truth)
    odometry = np.concatenate([dead_reckoning(walk_of(seed).readings) for seed in order])
    assert union < 1.5 * alone + 0.02 < metric(odometry, truth)
    assert made.state.count < 0.7 * sum(kept)


@pytest.mark.soak
def test_the_order_of_arguments_does_not_matter(maps: dict[int, Path], joined: Path, tmp_path: Path) -> None:
    merge_maps([maps[2], maps[1]], tmp_path / "both.npz")
    assert read_map(tmp_path / "both.npz").digest == read_map(joined).digest


def test_a_merged_map_goes_on_as_any_other(joined: Path) -> None:
    readings, saved = walk_of(1).readings[:40], read_map(joined)

    def begin() -> Session:
        session = empty_session()
        saved.restore(session, saved.config)
        session.begin_piece()
        return session

    session = begin()
    live = [session.step(reading).pose for reading in readings]
    assert len(session.map.trajectory()) == session.steps == saved.steps + len(readings)
    assert np.array_equal(live, [step.pose for step in begin().replay(readings)])


def test_what_nothing_joins_stays_a_piece(maps: dict[int, Path], tmp_path: Path, capsys) -> None:
    target = tmp_path / "both"
    assert main(["merge", str(maps[1]), str(maps[3]), "-o", str(target)]) == 0
    assert "Nothing in the views joins these maps" in capsys.readouterr().out
    made = map_in(target)
    piece, path = made.pieces(), made.trajectory()
    assert np.loadtxt(target / "pieces.csv", delimiter=",", skiprows=1)[:, 1].tolist() == piece.tolist()
    assert {one.name for one in target.iterdir()} >= {"map.npz", "map.png", "trajectory.tum", "map.json"}
    assert (target / "merge.json").exists()
    page, bag = str(tmp_path / "page.html"), str(tmp_path / "both.mcap")
    for command in (["score"], ["report", "-o", page], ["export", "-o", bag]):
        assert main([*command, str(target)]) == 2
        assert f"{target}: a merged map, which has no steps" in capsys.readouterr().err
    for suffix in ("tum", "g2o", "json"):
        assert main(["export", str(target), "-o", str(tmp_path / f"exported.{suffix}")]) == 0
    assert main(["map", "info", str(target)]) == 0
    assert "pieces 2" in capsys.readouterr().out
    assert np.unique(piece).tolist() == [0, 1]
    for seed in (1, 3):
        own = map_in(maps[seed]).trajectory()
        parts = [path[piece == k] for k in (0, 1) if (piece == k).sum() == len(own)]
        moved = [between(between(own[0], own), between(part[0], part)) for part in parts]
        assert min(np.abs(error).max() for error in moved) < 0.05, seed


def part(path: Path, first: int, last: int) -> Path:
    """The steps of a map from `first` to `last` - 1."""
    crop_saved(read_map(WHOLE), partial(keyframes_of_steps, first=first, last=last), path)
    return path


@pytest.fixture(scope="module")
def halves(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("halves")
    return [part(folder / "one.npz", 0, 180), part(folder / "two.npz", 180, 360)]


@pytest.fixture
def quick_merge(monkeypatch: pytest.MonkeyPatch) -> None:
    """Merges that look for no common places, which takes most of the time."""
    monkeypatch.setattr(merging, "join_all", lambda *_: [])


def test_a_map_is_not_merged_with_itself(halves: list[Path], tmp_path: Path) -> None:
    with pytest.raises(InputError, match="the same map as"):
        merge_maps([halves[0], halves[0]], tmp_path / "both.npz")
    with pytest.raises(InputError, match="two or more maps"):
        merge_maps([halves[0]], tmp_path / "both.npz")
    assert not list(tmp_path.iterdir())


def refused(capsys: pytest.CaptureFixture[str], target: Path, *maps: Path) -> str:
    assert main(["merge", *map(str, maps), "-o", str(target)]) == 2
    (error,) = capsys.readouterr().err.splitlines()
    assert not target.exists()
    return error


def test_a_session_that_two_maps_hold_is_not_merged(halves, capsys, tmp_path: Path, quick_merge) -> None:
    """A part, merged, continued and corrected maps."""
    both, longer, undone = (tmp_path / f"{name}.npz" for name in ("both", "longer", "undone"))
    merge_maps(halves, both)
    slam = ratslam.Slam.load(halves[0])
    with open_recording(RecordingConfig(file=READINGS)) as recording:
        for sample in islice(recording, 390, 400):
            slam.step(sample.reading)
    slam.save(longer)
    log = map_in(WHOLE).solution().log
    undo_sequence(read_map(WHOLE), int(log.table()[log.accepted_rows(), 5].max()), undone)
    for one, other in ((WHOLE, halves[1]), (both, halves[0]), (both, halves[1]), (longer, halves[0])):
        error = refused(capsys, tmp_path / "again.npz", one, other)
        assert str(one) in error
        assert "keyframes are equal to the bit; expected maps of different sessions" in error
        assert f"leave out {other}, all of which is in the other map" in error
    error = refused(capsys, tmp_path / "again", WHOLE, undone)
    assert "leave one of them out: each holds all of the other" in error


def test_common_steps_can_be_cut_out(halves, capsys, tmp_path: Path, quick_merge) -> None:
    """The command that the error gives does so."""
    late = part(tmp_path / "late.npz", 120, 300)
    error = refused(capsys, tmp_path / "both", halves[0], late)
    command = error.split("`ratslam ")[1].removesuffix("`").split()
    rest = tmp_path / "rest.npz"
    assert main([*command[:-1], str(rest)]) == 0
    other = late if command[2] == str(halves[0]) else halves[0]
    assert merge_maps([rest, other], tmp_path / "both.npz")["steps"]


def test_a_recording_is_mapped_once_whatever_the_settings(halves) -> None:
    one, two = (replace(read_map(half), recording="ab") for half in halves)
    with pytest.raises(InputError, match=r"two.npz: .* the same recording .* as that of .*one.npz"):
        check_mergeable([one, two])
    check_mergeable([one, replace(two, recording="cd")])


def test_of_two_sensors_both_maps_are_named(halves) -> None:
    one, two = (read_map(half) for half in halves)
    cells = two.config.pose_cells.model_copy(update={"cell_size": 7.0})
    other = replace(two, config=two.config.model_copy(update={"pose_cells": cells}))
    size = one.config.pose_cells.cell_size
    with pytest.raises(InputError, match=r"two.npz: made with other settings of") as caught:
        check_mergeable([one, other])
    assert f"pose_cells.cell_size is 7.0 here and {size} there" in str(caught.value)
    assert f"config.yaml --set pose_cells.cell_size={size} -o" in caught.value.cure


def test_settings_that_differ_are_told(halves, tmp_path: Path, quick_merge) -> None:
    """With the values of each map; the merged map has those that the report says."""
    saved = read_map(halves[1])
    keyframes = saved.config.keyframes.model_copy(update={"min_score": 77.0})
    config = saved.config.model_copy(update={"keyframes": keyframes})
    write_map(tmp_path / "two.npz", saved.open_session(), config, saved.source)
    report = merge_maps([halves[0], tmp_path / "two.npz"], tmp_path / "both.npz")
    ((name, values),) = report["settings"].items()
    assert (name, sorted(values)) == ("keyframes.min_score", [saved.config.keyframes.min_score, 77.0])
    assert read_map(tmp_path / "both.npz").config.keyframes.min_score == values[0]
    heading, line = describe_merge(report).splitlines()[-2:]
    assert report["maps"][0] in heading
    assert line == f"keyframes.min_score {values[0]} (map 2: {values[1]})"
    assert merge_maps(halves, tmp_path / "alike.npz")["settings"] == {}


def test_what_is_no_setting_of_the_method_may_differ() -> None:
    config = read_map(WHOLE).config
    session = config.session.model_copy(update={"seed": 5, "reserve": 64})
    assert differing_settings([config, config.model_copy(update={"session": session, "cells": None})]) == {}
    session = config.session.model_copy(update={"precision": "float32"})
    other = config.model_copy(update={"session": session})
    found = differing_settings([config, config, other])
    assert found == {"session.precision": ["float64", "float64", "float32"]}


@pytest.mark.parametrize("name", ["both.npz", "both"])
def test_an_interrupted_merge_leaves_nothing(halves, tmp_path, monkeypatch, name):
    before = {path: path.read_bytes() for path in halves}

    def stop(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(merging, "join_all", stop)
    with pytest.raises(KeyboardInterrupt):
        merge_maps(halves, tmp_path / name)
    assert not list(tmp_path.iterdir())
    assert {path: path.read_bytes() for path in halves} == before


MERGE = """
import os, signal, sys
from pathlib import Path
from typing import Any

from ratslam.runs import merge

moment, output, *maps = sys.argv[1:]
left = int(moment)

def stop(event, arguments):
    global left
    if event not in ("open", "os.rename", "os.mkdir") or isinstance(arguments[0], int):
        return
    if os.fsdecode(arguments[0]).startswith(os.path.dirname(output)):
        left -= 1
        if left < 0:
            os.kill(os.getpid(), signal.SIGKILL)

merge.join_all = lambda *_: []  # takes most of the time, and writes nothing
sys.addaudithook(stop)
merge.merge_maps([Path(one) for one in maps], Path(output))
"""
"""Merges maps, and kills itself before the given one of the moments at which it opens, creates or renames
something beside the output."""


def check_kill(moment: int, output: Path, halves: list[Path]) -> bool:
    """Kills a merge before a moment, if it has so many; returns whether it has."""
    output.parent.mkdir()
    before = [path.read_bytes() for path in halves]
    command = [sys.executable, "-c", MERGE, str(moment), str(output), *map(str, halves)]
    found = subprocess.run(command, capture_output=True, text=True)
    assert found.returncode in (0, -signal.SIGKILL), found.stderr
    killed = found.returncode != 0
    assert [path.read_bytes() for path in halves] == before
    if killed:
        assert not output.exists()
        assert all(path.name.startswith(".") for path in output.parent.iterdir())
    else:
        assert list(output.parent.iterdir()) == [output]
        assert read_map(output).steps == 360
    return killed


@pytest.mark.parametrize(
    ("name", "moment"), [("both.npz", 1), pytest.param("both", 5, marks=pytest.mark.soak)]
)
def test_a_killed_merge_leaves_the_maps_and_no_half_map(name, moment, halves, tmp_path, quick_merge):
    """Killed once its map file is whole but not in its place yet, and while it writes the other files."""
    output = tmp_path / "out" / name
    assert check_kill(moment, output, halves)
    left = {path.name for path in output.parent.iterdir()}
    assert left
    merge_maps(halves, output)
    assert read_map(output).steps == 360
    assert {path.name for path in output.parent.iterdir()} == left | {name}


@pytest.mark.soak
@pytest.mark.parametrize("name", ["both.npz", "both"])
def test_a_merge_may_be_killed_at_every_moment(name: str, halves: list[Path], tmp_path: Path) -> None:
    moment = 0
    while check_kill(moment, tmp_path / str(moment) / name, halves):
        moment += 1
    assert moment >= 3
