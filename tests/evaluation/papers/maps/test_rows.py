"""Rows of saved maps: stand-ins for the operations reach every goal, or err on purpose; drives to goals."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from evaluation.papers.figure import MAPS, find_figure
from evaluation.papers.maps import merged_maps, scenarios
from evaluation.papers.maps.arenas import GRID, REPORTS, SOON, arena_figures, shuffled_contacts
from evaluation.papers.maps.goals import GOALS, ClosedLoop, Drive, goal_figures, shortest_driven
from evaluation.papers.maps.localising import Judged
from evaluation.papers.maps.merged_maps import Join
from evaluation.papers.maps.operations import Localised, MapTask, Measured, Methods, reproduce_maps
from evaluation.papers.maps.scenarios import Recipe, open_world
from evaluation.papers.maps.stored_maps import STEPS, MapArrays, StoredMap, store_map
from evaluation.papers.tables.comparison import read_sessions
from evaluation.papers.tables.touch_table import MAIN, touch_config
from ratslam.live.goal_drive import DriveState
from robot.world.maze import cell_centre
from tactile.base.se2 import compose
from tests.evaluation.papers.maps.stand_ins import APART, ORACLE, WRONG, Oracle, cells_by_figure
from tests.helpers.grid_world import report

MAZE = 31000
MOTION = np.array([1.0, -0.5, 0.7])
"""Of the planted maps, from the truth."""
Measure = Callable[[str, Methods], Measured]


class Never(Oracle):
    def localise(self, made: StoredMap, recorded: scenarios.Recorded) -> Localised:
        localised = super().localise(made, recorded)
        return localised._replace(found=np.zeros_like(localised.found))


class Alarm(Oracle):
    def changes(self, made: StoredMap, recorded: scenarios.Recorded) -> np.ndarray:
        return made.arrays.trajectory[:2, :2]


NEVER, ALARM = Never(), Alarm()


def plant(folder: Path, *recipes: scenarios.Recipe) -> Path:
    """Puts true maps of these sessions, moved by `MOTION`, where rows look for them."""
    for recipe in recipes:
        truth = scenarios.record(recipe).truth
        pose = np.where(np.isfinite(truth), compose(MOTION, np.nan_to_num(truth)), 0.0)
        arrays = MapArrays(pose, truth, np.zeros(len(truth), int), len(truth) // 2)
        path = StoredMap.place(recipe, folder)
        path.mkdir(parents=True)
        np.savez(path / STEPS, **arrays._asdict())
    return folder


@pytest.fixture(scope="module")
def maps(tmp_path_factory: pytest.TempPathFactory) -> Path:
    recipes = [
        scenarios.ten_circuits(MAZE),
        scenarios.ten_circuits(MAZE + 1),
        scenarios.kidnapped(MAZE),
        scenarios.carried_sessions(MAZE)[0],
    ]
    recipes += scenarios.overlapping_sessions(MAZE)
    recipes += [scenarios.same_maze(MAZE, number) for number in (1, 2)]
    return plant(tmp_path_factory.mktemp("maps"), *recipes)


@pytest.fixture(scope="module")
def measure(maps: Path) -> Measure:
    """One session of a row with some operations."""
    return cache(lambda name, methods: find_figure(MAPS[name]).measure(MapTask(MAZE, maps, methods)))


def shown(name: str, one: Measured) -> dict[str, list[str]]:
    """The measured value and that of the control, without intervals, of each figure."""
    cells = cells_by_figure(find_figure(MAPS[name]).table([one]))
    return {figure: [value.split(" [")[0] for value in values] for figure, values in cells.items()}


def failures(one: Measured) -> list[str]:
    """What a session of a row fails in."""
    assert all(isinstance(value, bool | int | float) for value in one.record.values())
    return [figure for figure, value in one.record.items() if value is True]


WALL_WRONG = ["missed", "sure_and_wrong", "missed_before", "sure_and_wrong_before", "not_named"]


@pytest.mark.parametrize(
    ("name", "methods", "failed", "figure", "value"),
    [
        ("start", ORACLE, [], "found and right within 120 whisks", "1 of 1"),
        ("start", ORACLE, [], "sure and wrong (> 0.18 m or 30 degrees)", "0 of 1"),
        ("start", ORACLE, [], "whisks until then, median (worst)", "11 (11)"),
        ("start", WRONG, ["missed", "sure_and_wrong", "shuffled_sure_and_wrong"],
         "whisks until then, median (worst)", "inf (inf)"),
        ("carried", ORACLE, [], "tied on rightly after 60 whisks in the known part", "1 of 1"),
        ("carried", WRONG, ["not_tied", "wrong_tie", "shuffled_tied"],
         "wrong ties, known and unknown part", "2 of 2"),
        ("wall moved", ORACLE, ["not_named"], "found and right within 120 whisks after the change", "1 of 1"),
        ("wall moved", WRONG, WALL_WRONG, "found and right within 120 whisks after the change", "0 of 1"),
        ("door closed", WRONG, WALL_WRONG, "sure and wrong at some whisk after the change", "1 of 1"),
        ("other maze", ORACLE, ["found_elsewhere", "not_said"],
         "found in another maze, 300 whisks", "1 of 1"),
        ("other maze", NEVER, ["not_said", "known_missed"], "found in another maze, 300 whisks", "0 of 1"),
        ("merge", ORACLE, [], "joined rightly", "1 of 1"),
        ("merge", ORACLE, [], "EM of the union, median (worst), of joined", "0.000 (0.000)"),
        ("merge", APART, ["not_joined"], "EM of the union, median (worst), of joined", "-"),
        ("merge mazes", ORACLE, ["mazes_joined"], "joined", "1 of 1"),
        ("merge mazes", APART, ["maze_not_joined"], "joined", "0 of 1"),
    ],
)  # fmt: skip
def test_truth_reaches_the_goal_and_errors_are_counted(
    name: str, methods: Methods, failed: list[str], figure: str, value: str, measure: Measure
) -> None:
    one = measure(name, methods)
    assert failures(one) == failed
    assert shown(name, one)[figure][0] == value


def test_controls_find_nothing_with_a_method_that_looks(measure: Measure) -> None:
    for name, methods, figure, control in (
        ("start", ORACLE, "found and right within 120 whisks", "0 of 1"),
        ("carried", ORACLE, "tied on rightly after 60 whisks in the known part", "0 of 1"),
        ("door closed", ORACLE, "surest place named within a cell of the change", "0 of 1"),
        ("door closed", ALARM, "surest place named within a cell of the change", "1 of 1"),
    ):
        assert shown(name, measure(name, methods))[figure][1] == control
    assert failures(measure("kidnaps", ORACLE)) == []


def test_frames_of_many_sessions_are_those_of_the_merged_map(measure: Measure, monkeypatch) -> None:
    monkeypatch.setattr(merged_maps, "SESSIONS", 3)
    one = measure("ten sessions", ORACLE)
    frames, separate = shown("ten sessions", one)["keyframes after ten sessions, over those after one"]
    assert frames == "1.00 (1.00)"
    assert 2.9 < float(separate.split()[0]) < 3.1
    assert failures(one) == []


def test_a_recording_is_split_into_two_halves(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(merged_maps, "RECORDINGS", ("square",))
    recipes = merged_maps.split_recording("square")
    whole, first, second = map(scenarios.record, recipes)
    assert first.log.length + second.log.length == whole.log.length
    np.testing.assert_array_equal(np.concatenate([first.truth, second.truth]), whole.truth)
    plant(tmp_path, *recipes)
    figures = find_figure(MAPS["buildings"]).measure(MapTask(0, tmp_path, ORACLE)).record
    assert not figures["not_joined"]
    assert figures["found"] > 0.9
    assert figures["off"] == figures["shuffled_found"] == 0
    assert figures["ate_merged"] == pytest.approx(figures["ate_whole"], abs=1e-9)


def test_a_page_has_a_table_and_a_picture_per_row_and_is_compared_with_another(
    maps: Path, tmp_path: Path
) -> None:
    names = ["start", "carried", "kidnaps", "merge", "door closed"]
    for folder in (tmp_path / "old", tmp_path / "new"):
        folder.mkdir()
        (folder / "maps").symlink_to(maps)
    text = "\n".join(reproduce_maps(names, ORACLE, tmp_path / "old", MAZE, 1))
    page = (tmp_path / "old" / "maps.md").read_text(encoding="utf-8")
    for name in names:
        picture = f"{name.replace(' ', '_')}.png"
        assert f"## {find_figure(MAPS[name]).title}" in text
        assert picture in page
        assert (tmp_path / "old" / picture).stat().st_size > 10_000
    sessions = read_sessions(tmp_path / "old" / "maps.csv")
    assert list(sessions) == [(name, "31000") for name in names]
    assert sessions["start", "31000"][1]["whisks"] == 11
    lines = list(reproduce_maps(["start"], WRONG, tmp_path / "new", MAZE, 1, against=tmp_path / "old"))
    assert "| start | missed | 1 | 0 | 1 | - | 0, 1 (1) |" in lines
    assert "| start | whisks | 1 | 11.000 | inf | inf [-] | - |" in lines
    (said,) = (line for line in lines if line.startswith("New failures"))
    assert "missed: start 31000; sure_and_wrong: start 31000; " in said


COUNT = 20


def two_sessions(shift: float, turn: float = 0.0, joined: bool = True) -> MapArrays:
    """A straight line of 2 m driven twice; the second is off by a shift (m) and a turn (rad)."""
    truth = np.column_stack([0.1 * np.arange(COUNT), np.zeros((COUNT, 2))])
    return MapArrays(
        np.concatenate([truth, truth + [0.0, shift, turn]]),
        np.concatenate([truth, truth]),
        np.repeat([0, 0 if joined else 1], COUNT),
        COUNT,
    )


@pytest.mark.parametrize(
    ("arrays", "right", "wrong"),
    [
        (two_sessions(0.05), True, False),
        (two_sessions(0.3), False, True),
        (two_sessions(0.0, 0.6), False, True),
        (two_sessions(0.0, joined=False), False, False),
        (two_sessions(0.3, joined=False), False, False),
    ],
)
def test_a_join_is_right_or_wrong_and_none_is_neither(arrays: MapArrays, right: bool, wrong: bool) -> None:
    found = Join.of(arrays, COUNT)
    assert (found.right, found.wrong) == (right, wrong)


def test_known_steps_and_revisits_alone_are_compared() -> None:
    early = two_sessions(0.0)
    early.trajectory[COUNT : COUNT + 12, 1] += 1
    assert Join.of(early, COUNT).wrong
    assert Join.of(early, COUNT, entry=12).right
    away = two_sessions(0.0)
    away.truth[COUNT : COUNT + 12, 1] += 5
    assert Join.of(away, COUNT).wrong
    assert Join.of(away, COUNT, revisits=True).right
    arrays = two_sessions(0.3)
    assert arrays.em > 0.01
    assert two_sessions(0.3, joined=False).em_within_pieces == pytest.approx(0, abs=1e-12)
    arrays.truth[COUNT:] = np.nan
    assert (arrays.em, arrays.em_within_pieces, arrays.ate) == pytest.approx((0, 0, 0), abs=1e-12)


def judged(found_at: int, error: float) -> Judged:
    found = np.arange(REPORTS) >= found_at
    errors = np.column_stack([np.full(REPORTS, error), np.zeros(REPORTS)])
    return Judged(found, ~found, found & (error <= 0.09), found & (error > 0.18), errors)


def arena(found_at: int, error: float, other_at: int) -> Measured:
    other = np.arange(REPORTS) >= other_at
    elsewhere = Localised(other, np.full(REPORTS, other_at >= REPORTS), np.zeros((REPORTS, 3)))
    session, shuffled = judged(found_at, error), judged(REPORTS, 1.0)
    return arena_figures(session, shuffled, elsewhere, np.full(REPORTS, 0.2))


def test_right_and_wrong_sessions_of_grids_are_counted() -> None:
    found = arena(SOON - 1, 0.02, REPORTS), arena(SOON, 0.03, SOON), arena(0, 0.5, REPORTS)
    cells = cells_by_figure(GRID.table(found))
    assert {figure: values[0].split(" [")[0] for figure, values in cells.items()}.items() >= {
        "found and right within 300 reports": "1 of 3",
        "found and right within 900 reports": "2 of 3",
        "sure and wrong (> 0.18 m or 30 degrees)": "1 of 3",
        "found in another arena within 300 reports": "0 of 3",
        "found in another arena within 900 reports": "1 of 3",
        "says after 900 reports that this is not the map": "2 of 3",
    }.items()
    assert [failures(one) for one in found] == [
        [],
        ["missed_soon", "found_elsewhere", "not_said"],
        ["missed_soon", "missed", "sure_and_wrong", "best_wrong_soon", "best_wrong"],
    ]


def test_shuffled_contacts_keep_odometry_and_what_was_met() -> None:
    seen = [report(0.01 * k, touching=[k % 4] if k % 3 == 0 else []) for k in range(20)]
    mixed = shuffled_contacts(seen, 0)
    assert [one.odometry for one in mixed] == [one.odometry for one in seen]
    contacts, before = ([one.contact.tolist() for one in each] for each in (mixed, seen))
    assert sorted(contacts) == sorted(before)
    assert contacts != before


SQUARE = [(0, 0), (1, 0), (1, 1), (0, 1)]
DRIVEN = 31002


def drive(state: DriveState, error: float, replans: int = 0) -> Drive:
    path = np.array([[0.09, 0.09], [0.27, 0.09]])
    return Drive(state, path[1], replans, error, 0.5, 0.01, 0.2, 0.18, 0.08, True, path)


def test_the_shortest_way_runs_along_the_lines_between_cells():
    a, b = cell_centre((0, 0)) + [0.02, 0.0], cell_centre((1, 1))
    assert shortest_driven(SQUARE, a, b)[0] == pytest.approx(0.16 + 0.18)
    assert shortest_driven(SQUARE, a, b - [0.0, 0.02])[1] == [(1, 0)]


def test_only_true_ends_count_as_reached(tmp_path: Path):
    ends = [(DriveState.REACHED, 0.01), (DriveState.REACHED, 0.2), (DriveState.LOST, 0.01)]
    walled = [
        drive(DriveState.BLOCKED, 0.3),
        drive(DriveState.REACHED, 0.01, 1),
        drive(DriveState.REACHED, 0.01),
    ]
    maze, _ = open_world(DRIVEN)
    found = goal_figures([drive(*end) for end in ends], walled, 120.0, np.zeros((2, 2)), 0.09, maze)
    lines = cells_by_figure(GOALS.table([found]))
    assert lines["reached (truly within 0.09 m)"][0].startswith("1 of 3")
    assert lines["reached (truly within 0.09 m)"][1].startswith("0 of 3")
    assert lines["said to be reached at a wrong place"][0].startswith("1 of 6")
    assert lines["path over the shortest driven way, all reached"][0] == "1.11"
    assert lines["wall in the way: reached by a new way, or blocked"][0].startswith("2 of 3")
    record = found.record
    counts = [record[name] for name in ("not_reached", "wrongly_reached", "in_wall", "wall_not_solved")]
    assert counts == [2, 1, 0, 1]
    assert record["path_ratio"] == pytest.approx(0.2 / 0.18)
    assert record["error"] == pytest.approx(0.105)
    assert GOALS.draw is not None
    GOALS.draw([found], tmp_path / "goals.png")
    assert (tmp_path / "goals.png").stat().st_size > 10_000


def test_the_arm_drives_to_a_goal_on_its_map(tmp_path: Path):
    settings = MAIN | {"path": {"circuits": "CCC"}}
    recipe = Recipe(touch_config(DRIVEN, 1, settings))
    loop = ClosedLoop(recipe, store_map(recipe, tmp_path))
    far = {place: loop.way_to(place)[0] for place in loop.experiences}
    goal = min(far, key=lambda place: abs(far[place] - 0.4))
    end = loop.drive(goal)
    assert end.reached, (end.state, end.error)
    assert end.clear
    assert end.length <= 1.15 * end.shortest + 0.09
    walls = loop.walls().walls
    assert (walls.box == loop.scene.surroundings.walls.box).all()
    assert (walls.height == loop.scene.surroundings.walls.height).all()
