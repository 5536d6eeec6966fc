"""Rows of saved maps: stand-ins reach every goal or err on purpose; drives to goals; sessions of a maze."""

from collections.abc import Callable, Iterable, Sequence
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from evaluation.papers.figure import MAPS, find_figure
from evaluation.papers.maps import merged_maps, scenarios, stored_maps
from evaluation.papers.maps.arenas import GRID, REPORTS, SOON, arena_figures, shuffled_contacts
from evaluation.papers.maps.goals import GOALS, ClosedLoop, Drive, goal_figures, shortest_driven
from evaluation.papers.maps.localising import Judged
from evaluation.papers.maps.merged_maps import Join
from evaluation.papers.maps.operations import Localised, MapTask, Methods, reproduce_maps
from evaluation.papers.maps.scenarios import Recipe, Recorded, open_world
from evaluation.papers.maps.stored_maps import STEPS, MapArrays, StoredMap, store_map
from evaluation.papers.tables.comparison import Measured, read_sessions
from evaluation.papers.tables.touch_table import MAIN, touch_config
from ratslam.live.goal_drive import DriveState
from robot.world.maze import CELL_SIDE, Cell, cell_centre
from robot.world.scene import make_maze
from tactile.base.se2 import between, compose
from tests.helpers.grid_world import report


def true_pose(made: StoredMap, truth: np.ndarray) -> np.ndarray:
    """[T, 3] where true poses are in a map: moved with the nearest step."""
    steps = made.arrays.steps
    near = steps.nearest(truth, 0.09)
    return compose(steps.pose[near], between(steps.truth[near], truth))


class Oracle(Methods):
    def localise(self, made: StoredMap, recorded: Recorded) -> Localised:
        """Found after 10 steps at the true pose if images are those of the place, else never."""
        known = "+" not in recorded.log.digest
        steps = np.arange(recorded.log.length)
        found = known & (steps >= 10)
        return Localised(found, ~found & (steps > 100), true_pose(made, recorded.truth))

    def extend(self, made: StoredMap, recorded: Recorded) -> MapArrays:
        """Tied on at the true pose, unless the images are in random order."""
        return _joined(made, recorded.truth, true_pose(made, recorded.truth), "+" not in recorded.log.digest)

    def merge(self, maps: Sequence[StoredMap], path: Path) -> StoredMap:
        one, other = maps
        return _stored(path, _joined(one, other.arrays.truth, true_pose(one, other.arrays.truth), True))

    def changes(self, made: StoredMap, recorded: Recorded) -> np.ndarray:
        """Where the session is at its step 50, in the map; nowhere in an unchanged maze."""
        changed = recorded.config.simulation.maze.added
        return true_pose(made, recorded.truth[[50]])[:, :2] if changed else np.zeros((0, 2))


class Wrong(Oracle):
    """Sure and wrong, two cells off; joins everything."""

    def localise(self, made: StoredMap, recorded: Recorded) -> Localised:
        found = np.ones(recorded.log.length, bool)
        return Localised(found, ~found, true_pose(made, recorded.truth) + [2 * CELL_SIDE, 0, 0])

    def extend(self, made: StoredMap, recorded: Recorded) -> MapArrays:
        pose = true_pose(made, recorded.truth) + [2 * CELL_SIDE, 0, 0]
        return _joined(made, recorded.truth, pose, True)


class Apart(Oracle):
    def merge(self, maps: Sequence[StoredMap], path: Path) -> StoredMap:
        one, other = maps
        return _stored(path, _joined(one, other.arrays.truth, other.arrays.trajectory, False))


def _stored(path: Path, arrays: MapArrays) -> StoredMap:
    return StoredMap(path, arrays, np.arange(len(arrays.truth)))


def _joined(made: StoredMap, truth: np.ndarray, pose: np.ndarray, joined: bool) -> MapArrays:
    arrays = made.arrays
    later = np.full(len(truth), arrays.piece[0] if joined else arrays.piece.max() + 1)
    pairs = (arrays.trajectory, pose), (arrays.truth, truth), (arrays.piece, later)
    return MapArrays(*map(np.concatenate, pairs), arrays.frames)


class Never(Oracle):
    """Finds no place, and alarms at the first steps."""

    def localise(self, made: StoredMap, recorded: scenarios.Recorded) -> Localised:
        localised = super().localise(made, recorded)
        return localised._replace(found=np.zeros_like(localised.found))

    def changes(self, made: StoredMap, recorded: scenarios.Recorded) -> np.ndarray:
        return made.arrays.trajectory[:2, :2]


ORACLE, WRONG, APART, NEVER = Oracle(), Wrong(), Apart(), Never()


def cells_by_figure(lines: Iterable[str]) -> dict[str, tuple[str, str]]:
    """What was measured and the control, by the figure of a line of a Markdown table."""
    _, *rows = ([cell.strip() for cell in line.strip("| ").split(" | ")] for line in lines)
    return {figure: (measured, control) for figure, _, measured, control in rows}


MAZE = 31000
MOTION = np.array([1.0, -0.5, 0.7])
"""Of the planted maps, from the truth."""
Measure = Callable[[str, Methods], Measured]


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
    recipes = [scenarios.ten_circuits(MAZE), scenarios.ten_circuits(MAZE + 1), scenarios.kidnapped(MAZE)]
    recipes += [scenarios.carried_sessions(MAZE)[0], *scenarios.overlapping_sessions(MAZE)]
    recipes += [scenarios.same_maze(MAZE, number) for number in (1, 2)]
    return plant(tmp_path_factory.mktemp("maps"), *recipes)


@pytest.fixture(scope="module")
def measure(maps: Path) -> Measure:
    return cache(lambda name, methods: find_figure(MAPS[name]).measure(MapTask(MAZE, maps, methods)))


def shown(name: str, one: Measured) -> dict[str, list[str]]:
    """The measured value and that of the control, without intervals, of each figure."""
    cells = cells_by_figure(find_figure(MAPS[name]).table([one]))
    return {figure: [value.split(" [")[0] for value in values] for figure, values in cells.items()}


def failures(one: Measured) -> list[str]:
    assert all(isinstance(value, bool | int | float) for value in one.record.values())
    return [figure for figure, value in one.record.items() if value is True]


WALL_WRONG = ["missed", "sure_and_wrong", "missed_before", "sure_and_wrong_before", "not_named"]


@pytest.mark.parametrize(("name", "methods", "failed", "figures"), [
    ("start", ORACLE, [], {"found and right within 120 whisks": "1 of 1",
     "sure and wrong (> 0.18 m or 30 degrees)": "0 of 1", "whisks until then, median (worst)": "11 (11)"}),
    ("start", WRONG, ["missed", "sure_and_wrong", "shuffled_sure_and_wrong"],
     {"whisks until then, median (worst)": "inf (inf)"}),
    ("carried", ORACLE, [], {"tied on rightly after 60 whisks in the known part": "1 of 1"}),
    ("carried", WRONG, ["not_tied", "wrong_tie", "shuffled_tied"],
     {"wrong ties, known and unknown part": "2 of 2"}),
    ("wall moved", ORACLE, ["not_named"], {"found and right within 120 whisks after the change": "1 of 1"}),
    ("door closed", WRONG, WALL_WRONG, {"sure and wrong at some whisk after the change": "1 of 1"}),
    ("other maze", ORACLE, ["found_elsewhere", "not_said"], {"found in another maze, 300 whisks": "1 of 1"}),
    ("other maze", NEVER, ["not_said", "known_missed"], {"found in another maze, 300 whisks": "0 of 1"}),
    ("merge", ORACLE, [],
     {"joined rightly": "1 of 1", "EM of the union, median (worst), of joined": "0.000 (0.000)"}),
    ("merge", APART, ["not_joined"], {"EM of the union, median (worst), of joined": "-"}),
    ("merge mazes", ORACLE, ["mazes_joined"], {"joined": "1 of 1"}),
    ("merge mazes", APART, ["maze_not_joined"], {"joined": "0 of 1"}),
])  # fmt: skip
def test_truth_reaches_the_goal_and_errors_are_counted(name, methods, failed, figures, measure) -> None:
    one = measure(name, methods)
    assert failures(one) == failed
    found = shown(name, one)
    assert {figure: found[figure][0] for figure in figures} == figures


def test_controls_find_nothing_with_a_method_that_looks(measure: Measure) -> None:
    for name, methods, figure, control in (
        ("start", ORACLE, "found and right within 120 whisks", "0 of 1"),
        ("carried", ORACLE, "tied on rightly after 60 whisks in the known part", "0 of 1"),
        ("door closed", ORACLE, "surest place named within a cell of the change", "0 of 1"),
        ("door closed", NEVER, "surest place named within a cell of the change", "1 of 1"),
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
    assert figures["found"] > 0.9
    assert figures["not_joined"] == figures["off"] == figures["shuffled_found"] == 0
    assert figures["ate_merged"] == pytest.approx(figures["ate_whole"], abs=1e-9)


def test_a_page_has_a_table_and_a_picture_per_row_and_is_compared(maps: Path, tmp_path: Path) -> None:
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
    path, piece = np.concatenate([truth, truth + [0.0, shift, turn]]), np.repeat([0, not joined], COUNT)
    return MapArrays(path, np.concatenate([truth, truth]), piece.astype(int), COUNT)


def test_a_join_is_right_or_wrong_or_neither_by_known_steps_and_revisits_alone() -> None:
    for arrays, right, wrong in (
        (two_sessions(0.05), True, False),
        (two_sessions(0.3), False, True),
        (two_sessions(0.0, 0.6), False, True),
        (two_sessions(0.0, joined=False), False, False),
        (two_sessions(0.3, joined=False), False, False),
    ):
        found = Join.of(arrays, COUNT)
        assert (found.right, found.wrong) == (right, wrong)
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


def test_right_and_wrong_sessions_of_grids_are_counted_and_shuffled_contacts_keep_odometry() -> None:
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


def test_the_shortest_way_runs_between_cells_and_only_true_ends_count_as_reached(tmp_path: Path):
    a, b = cell_centre((0, 0)) + [0.02, 0.0], cell_centre((1, 1))
    assert shortest_driven(SQUARE, a, b)[0] == pytest.approx(0.16 + 0.18)
    assert shortest_driven(SQUARE, a, b - [0.0, 0.02])[1] == [(1, 0)]
    ends = [(DriveState.REACHED, 0.01), (DriveState.REACHED, 0.2), (DriveState.LOST, 0.01)]
    walls = (DriveState.BLOCKED, 0.3), (DriveState.REACHED, 0.01, 1), (DriveState.REACHED, 0.01)
    walled = [drive(*end) for end in walls]
    maze, _ = open_world(DRIVEN)
    found = goal_figures([drive(*end) for end in ends], walled, 120.0, np.zeros((2, 2)), 0.09, maze)
    lines = cells_by_figure(GOALS.table([found]))
    reached, control = lines["reached (truly within 0.09 m)"]
    assert (reached[:6], control[:6]) == ("1 of 3", "0 of 3")
    assert lines["path over the shortest driven way, all reached"][0] == "1.11"
    record = found.record
    counts = [record[name] for name in ("not_reached", "wrongly_reached", "in_wall", "wall_not_solved")]
    assert counts == [2, 1, 0, 1]
    assert (record["path_ratio"], record["error"]) == pytest.approx((0.2 / 0.18, 0.105))
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
    for found, known in zip(walls, loop.scene.surroundings.walls, strict=True):
        assert np.array_equal(found, known)


def cells_of(poses: np.ndarray) -> list[Cell]:
    return [(int(x), int(y)) for x, y in np.floor(poses[:, :2] / CELL_SIDE)]


@pytest.mark.parametrize("maze", [31003, 31015])
def test_sessions_share_half_their_cells_and_a_carried_robot_is_in_the_known_part_or_never(maze: int) -> None:
    recipes = scenarios.overlapping_sessions(maze)
    one, other, both = (set(cells_of(scenarios.record(recipe).truth)) for recipe in recipes)
    assert len(one) == len(other) == 2 * len(one & other) >= 8
    assert both == one | other
    *recipes, entry = scenarios.carried_sessions(maze)
    first, back, away = (cells_of(scenarios.record(recipe).truth) for recipe in recipes)
    known = set(first)
    assert not {*back[:entry], *away} & known
    assert set(back[entry:]) <= known
    assert (len(back), len(away)) == (entry + scenarios.REENTERED, scenarios.LOCALISED)


@pytest.mark.parametrize("maze", [31003, 31015])
@pytest.mark.parametrize(("change", "walls"), [(scenarios.moved_wall, 2), (scenarios.closed_door, 1)])
def test_a_change_is_beside_the_driven_way_and_leaves_it_clear(maze: int, change, walls: int) -> None:
    after, places = change(maze)
    (before, loop), simulation = scenarios.open_world(maze), after.config.simulation
    now, *_ = make_maze(simulation.maze, simulation.path, simulation.seed)
    apart = (now.across != before.across).sum() + (now.along != before.along).sum()
    assert apart == len(places) == walls
    truth = scenarios.record(after).truth  # simulating it checks that the path passes no wall
    for place in places:
        assert np.hypot(*(truth[:, :2] - place).T).min() < 0.6 * CELL_SIDE
    assert set(loop) <= set(cells_of(truth))


def test_maps_of_other_code_are_not_used_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    recipe, poses = scenarios.unknown_start(31000), np.zeros((5, 3))
    path = StoredMap.place(recipe, tmp_path)
    path.mkdir()
    np.savez(path / STEPS, **MapArrays(poses, poses, np.zeros(5, int), 2)._asdict())
    monkeypatch.setattr(stored_maps, "record", lambda _: pytest.fail("made again"))
    assert store_map(recipe, tmp_path).arrays.frames == 2
    monkeypatch.setattr(stored_maps, "code_digest", lambda: "other")
    with pytest.raises(pytest.fail.Exception, match="made again"):
        store_map(recipe, tmp_path)
