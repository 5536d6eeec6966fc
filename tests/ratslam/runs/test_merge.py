"""Saved maps merged into one; killed merges; maps of a building whose places have given ids."""

import signal
import subprocess
import sys
from dataclasses import replace
from functools import cache, partial
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

import ratslam
from evaluation.metrics.trajectory import align, ate
from ratslam.core.estimates import Localisation
from ratslam.places.crop import keyframes_of_steps
from ratslam.runs import merge as merging
from ratslam.runs.map_care import crop_saved, undo_sequence
from ratslam.runs.merge import check_mergeable, describe_merge, merge_maps
from ratslam.runs.saved_map import describe_readings, read_map, write_map
from ratslam.runs.settings.completion import complete
from ratslam.runs.settings.run_config import LoopConfig
from ratslam.runs.slam import Slam
from robot.recordings.formats import open_recording
from robot.recordings.recording_config import RecordingConfig
from robot.simulation.head.simulated_session import HeadSimulation
from robot.sources.source import SourceDescription
from robot.touch_source import open_touch_source
from tactile.base.se2 import between, compose, integrate
from tactile.base.types import Observation, Odometry, observation
from tests.helpers.commands import refused, said
from tests.ratslam.runs import touch_walks as walks
from tests.ratslam.runs.test_saved_map import FILE

READINGS = Path(__file__).parents[2] / "golden" / "touch_circuits.mcap"


MAZES = {1: 31001, 2: 31001, 3: 31002}
SESSIONS = {
    seed: {"seed": seed} | walks.LAPS | {"maze": walks.SMALL | {"seed": maze}} for seed, maze in MAZES.items()
}


@cache
def walk_of(seed: int) -> walks.Walk:
    return walks.simulate_walk(**SESSIONS[seed])


@pytest.fixture(scope="module")
def maps(tmp_path_factory: pytest.TempPathFactory) -> dict[int, Path]:
    folder = tmp_path_factory.mktemp("maps")
    for seed, simulation in SESSIONS.items():
        config = walks.config_of(simulation=simulation)
        assert config.simulation is not None
        source = HeadSimulation(config.simulation)
        config, session = complete(config, source), walks.empty_session()
        walks.follow(session, walk_of(seed).readings)
        described = describe_readings(open_touch_source(source, config.touch))
        write_map(folder / f"{seed}.npz", session, config, described)
    return {seed: folder / f"{seed}.npz" for seed in SESSIONS}


def map_in(path: Path) -> Any:
    return read_map(path).open_session().map


def test_two_sessions_become_one_map_that_goes_on_as_any_other(maps: dict[int, Path], tmp_path) -> None:
    joined = tmp_path / "both.npz"
    merge_maps([maps[1], maps[2]], joined)
    made, kept = map_in(joined), [map_in(maps[seed]).state.count for seed in (1, 2)]
    order = sorted((1, 2), key=lambda seed: read_map(maps[seed]).digest)
    truth = np.concatenate([walk_of(seed).truth for seed in order])
    assert not made.pieces().any()
    union = walks.metric(made.map_trajectory(), truth)
    alone = walks.metric(map_in(maps[1]).map_trajectory(), walk_of(1).truth)
    odometry = np.concatenate([walks.dead_reckoning(walk_of(seed).readings) for seed in order])
    assert union < 1.5 * alone + 0.02 < walks.metric(odometry, truth)
    assert made.state.count < 0.7 * sum(kept)
    readings, saved, session = walk_of(1).readings[:40], read_map(joined), walks.empty_session()
    results = []
    for play in (session.replay, partial(map, session.step)):
        saved.restore(session, saved.config)
        session.begin_piece()
        results.append([step.pose for step in play(readings)])
        assert len(session.map.trajectory()) == session.steps == saved.steps + len(readings)
    assert np.array_equal(*results)


def test_what_nothing_joins_stays_a_piece(maps: dict[int, Path], tmp_path: Path, capsys) -> None:
    target = tmp_path / "both"
    assert "Nothing in the views joins" in said(capsys, "merge", maps[1], maps[3], "-o", target)
    made = map_in(target)
    piece, path = made.pieces(), made.trajectory()
    assert np.loadtxt(target / "pieces.csv", delimiter=",", skiprows=1)[:, 1].tolist() == piece.tolist()
    assert {one.name for one in target.iterdir()} >= {"map.npz", "map.png", "trajectory.tum", "merge.json"}
    page, bag = tmp_path / "page.html", tmp_path / "both.mcap"
    for command in (["score"], ["report", "-o", page], ["export", "-o", bag]):
        assert f"{target}: a merged map, which has no steps" in refused(capsys, *command, target)
    for suffix in ("tum", "g2o", "json"):
        said(capsys, "export", target, "-o", tmp_path / f"exported.{suffix}")
    assert "pieces 2" in said(capsys, "map", "info", target)
    assert np.unique(piece).tolist() == [0, 1]
    for seed in (1, 3):
        own = map_in(maps[seed]).trajectory()
        parts = [path[piece == k] for k in (0, 1) if (piece == k).sum() == len(own)]
        moved = [between(between(own[0], own), between(part[0], part)) for part in parts]
        assert min(np.abs(error).max() for error in moved) < 0.05, seed


def part(path: Path, first: int, last: int) -> Path:
    crop_saved(read_map(FILE), partial(keyframes_of_steps, first=first, last=last), path)
    return path


@pytest.fixture(scope="module")
def halves(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("halves")
    return [part(folder / "one.npz", 0, 180), part(folder / "two.npz", 180, 360)]


@pytest.fixture
def quick_merge(monkeypatch: pytest.MonkeyPatch) -> None:
    """Merges that look for no common places, which takes most of the time."""
    monkeypatch.setattr(merging, "join_all", lambda *_: [])


def test_a_map_is_not_merged_with_itself_or_alone(halves: list[Path], tmp_path: Path) -> None:
    for maps, message in (([halves[0]] * 2, "the same map as"), ([halves[0]], "two or more maps")):
        with pytest.raises(ratslam.InputError, match=message):
            merge_maps(maps, tmp_path / "both.npz")
    assert not list(tmp_path.iterdir())


def test_a_session_that_two_maps_hold_is_not_merged(halves, capsys, tmp_path: Path, quick_merge) -> None:
    both, longer, undone = (tmp_path / f"{name}.npz" for name in ("both", "longer", "undone"))
    merge_maps(halves, both)
    slam = ratslam.Slam.load(halves[0])
    with open_recording(RecordingConfig(file=READINGS)) as recording:
        for sample in islice(recording, 390, 400):
            slam.step(sample.reading)
    slam.save(longer)
    log = map_in(FILE).solution().log
    undo_sequence(read_map(FILE), int(log.table()[log.accepted_rows(), 5].max()), undone)
    for one, other in ((FILE, halves[1]), (both, halves[0]), (both, halves[1]), (longer, halves[0])):
        error = refused(capsys, "merge", one, other, "-o", tmp_path / "again.npz")
        assert "keyframes are equal to the bit; expected maps of different sessions" in error
        assert f"leave out {other}, all of which is in the other map" in error
        assert not (tmp_path / "again.npz").exists()
    error = refused(capsys, "merge", FILE, undone, "-o", tmp_path / "again")
    assert "leave one of them out: each holds all of the other" in error


def test_common_steps_can_be_cut_out(halves, capsys, tmp_path: Path, quick_merge) -> None:
    late = part(tmp_path / "late.npz", 120, 300)
    error = refused(capsys, "merge", halves[0], late, "-o", tmp_path / "both")
    command = error.split("`ratslam ")[1].removesuffix("`").split()
    rest = tmp_path / "rest.npz"
    said(capsys, *command[:-1], rest)
    other = late if command[2] == str(halves[0]) else halves[0]
    assert merge_maps([rest, other], tmp_path / "both.npz")["steps"]


def test_a_recording_is_mapped_once_and_by_one_sensor(halves) -> None:
    one, two = (replace(read_map(half), recording="ab") for half in halves)
    with pytest.raises(ratslam.InputError, match=r"two.npz: .* the same recording .* as that of .*one.npz"):
        check_mergeable([one, two])
    two = replace(two, recording="cd")
    check_mergeable([one, two])
    cells = two.config.pose_cells.model_copy(update={"cell_size": 7.0})
    other = replace(two, config=two.config.model_copy(update={"pose_cells": cells}))
    size = one.config.pose_cells.cell_size
    found = rf"two.npz: made with other settings of .*pose_cells.cell_size is 7.0 here and {size} there"
    with pytest.raises(ratslam.InputError, match=found) as caught:
        check_mergeable([one, other])
    assert f"config.yaml --set pose_cells.cell_size={size} -o" in caught.value.cure


def test_settings_that_differ_are_told_and_the_merged_map_has_those_told(halves, tmp_path, quick_merge):
    saved = read_map(halves[1])
    keyframes = saved.config.keyframes.model_copy(update={"min_score": 77.0})
    config = saved.config.model_copy(update={"keyframes": keyframes})
    write_map(tmp_path / "two.npz", saved.open_session(), config, saved.source)
    report = merge_maps([halves[0], tmp_path / "two.npz"], tmp_path / "both.npz")
    ((name, values),) = report["settings"].items()
    assert (name, sorted(values)) == ("keyframes.min_score", [saved.config.keyframes.min_score, 77.0])
    assert read_map(tmp_path / "both.npz").config.keyframes.min_score == values[0]
    assert describe_merge(report).splitlines()[-1] == f"keyframes.min_score {values[0]} (map 2: {values[1]})"
    assert merge_maps(halves, tmp_path / "alike.npz")["settings"] == {}
    merge_maps(halves[::-1], tmp_path / "turned.npz")  # the order does not matter
    assert read_map(tmp_path / "turned.npz").digest == read_map(tmp_path / "alike.npz").digest


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
        assert (list(output.parent.iterdir()), read_map(output).steps) == ([output], 360)
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
    assert (read_map(output).steps, {path.name for path in output.parent.iterdir()}) == (360, left | {name})


@pytest.mark.soak
@pytest.mark.parametrize("name", ["both.npz", "both"])
def test_a_merge_may_be_killed_at_every_moment(name: str, halves: list[Path], tmp_path: Path) -> None:
    moment = 0
    while check_kill(moment, tmp_path / str(moment) / name, halves):
        moment += 1
    assert moment >= 3


STEP, MARKED = 0.25, 8
"""Motion of a step, m; steps between two places with an id."""
SETTINGS = {
    "templates": {"source": "labels"},
    "pose_cells": {"cells_xy": 11, "cell_size": 0.5},
    "attractor": {"engine": "dense"},
    "session": {"reserve": 128},
}


class Drive(NamedTuple):
    readings: list[Observation]
    truth: np.ndarray


def lap() -> np.ndarray:
    """[n, 3] motions once round the rectangle."""
    sides = [np.tile([STEP, 0.0, 0.0], (round(length / STEP), 1)) for length in (16.0, 12.0) * 2]
    for side in sides:
        side[-1, 2] = np.pi / 2
    return np.concatenate(sides)


def drive(begin: int, steps: int, seed: int, first_id: int = 0, order: int = 1) -> Drive:
    """A drive that begins at a step of the lap; markers have consecutive ids, but for an order."""
    motion = np.roll(lap(), -begin, axis=0)[np.arange(steps) % len(lap())]
    truth = compose(integrate(lap())[begin], integrate(motion))
    noise = np.random.default_rng(seed).normal(0, [0.01, 0.002, 0.01], (steps, 3))
    at = (begin + 1 + np.arange(steps)) % len(lap())
    given = first_id + order * (at // MARKED) % (len(lap()) // MARKED)
    label = np.where(at % MARKED == 0, given, -1)
    readings = [
        observation(Odometry(*moved, 0.25), view_shape=(1, 1, 1), label=int(one))
        for moved, one in zip(motion + noise, label, strict=True)
    ]
    return Drive(readings, truth)


def mapped(path: Path, made: Drive) -> Path:
    slam = Slam(LoopConfig.model_validate(SETTINGS), SourceDescription(view_shape=(1, 1, 1), rate_hz=4.0))
    for reading in made.readings:
        slam.step(reading)
    slam.save(path)
    return path


FIRST = drive(0, 450, 1)


@pytest.fixture(scope="module")
def map_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return mapped(tmp_path_factory.mktemp("ids") / "first.npz", FIRST)


def states(map_file: Path, session: Drive) -> tuple[np.ndarray, np.ndarray]:
    """[N] the state at each step, and the largest error of the poses where the robot is found, m."""
    slam = Slam.load(map_file, mode="localise")
    poses = np.array([slam.step(reading).pose for reading in session.readings])
    state = np.asarray(slam.map.states())
    frame = align(read_map(map_file).open_session().map.trajectory(), FIRST.truth)
    apart = np.hypot(*(compose(frame, poses) - session.truth)[:, :2].T)
    return state, apart[state == Localisation.FOUND].max(initial=0)


def test_a_robot_is_found_by_a_few_ids_and_stays_found(map_file: Path) -> None:
    state, error = states(map_file, drive(100, 150, 2))
    found = state == Localisation.FOUND
    assert 0 < np.argmax(found) <= 6 * MARKED
    assert found[np.argmax(found) :].all()
    assert error < 0.9  # largest standard deviation of the position of a robot that is found, m


@pytest.mark.parametrize(("first_id", "order"), [(1000, 1), (0, 11)], ids=["other ids", "the same elsewhere"])
def test_in_another_building_it_is_never_found(first_id: int, order: int, map_file: Path) -> None:
    state, _ = states(map_file, drive(100, 300, 8, first_id, order))
    assert not (state == Localisation.FOUND).any()
    assert (state[-1] == Localisation.NOT_THIS_MAP) == (order > 1)


def test_sessions_that_saw_the_same_ids_become_one_map(map_file: Path, tmp_path: Path) -> None:
    again, other = drive(60, 300, 5), drive(0, 300, 6, first_id=1000)
    report = merge_maps([map_file, mapped(tmp_path / "again.npz", again)], tmp_path / "joined.npz")
    assert len(report["pieces"]) == 1
    order = [FIRST if path == str(map_file) else again for path in report["maps"]]
    path = read_map(tmp_path / "joined.npz").open_session().map.trajectory()
    assert ate(path, np.concatenate([one.truth for one in order])) < 0.5
    apart = merge_maps([map_file, mapped(tmp_path / "other.npz", other)], tmp_path / "apart.npz")
    assert len(apart["pieces"]) == 2
