"""Rows with stand-ins for the operations: the truth reaches every goal, errors on purpose are counted."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from evaluation.papers.figure import MAPS, find_figure
from evaluation.papers.maps import merged_maps
from evaluation.papers.maps import merged_maps as merging
from evaluation.papers.maps.operations import Localised, MapTask, Methods, reproduce_maps
from evaluation.papers.maps.scenarios import (
    Recipe,
    Recorded,
    carried_sessions,
    kidnapped,
    overlapping_sessions,
    record,
    same_maze,
    ten_circuits,
)
from evaluation.papers.maps.stored_maps import STEPS, MapArrays, StoredMap
from evaluation.papers.tables.comparison import read_sessions
from tactile.base.se2 import compose
from tests.evaluation.papers.maps.stand_ins import APART, ORACLE, WRONG, Oracle, cells_by_figure

MAZE = 31000
MOTION = np.array([1.0, -0.5, 0.7])
"""Of the planted maps, from the truth."""


def plant(folder: Path, *recipes: Recipe) -> Path:
    """Puts true maps of these sessions, moved by `MOTION`, where rows look for them."""
    for recipe in recipes:
        truth = record(recipe).truth
        pose = np.where(np.isfinite(truth), compose(MOTION, np.nan_to_num(truth)), 0.0)
        arrays = MapArrays(pose, truth, np.zeros(len(truth), int), len(truth) // 2)
        path = StoredMap.place(recipe, folder)
        path.mkdir(parents=True)
        np.savez(path / STEPS, **arrays._asdict())
    return folder


@pytest.fixture(scope="module")
def maps(tmp_path_factory: pytest.TempPathFactory) -> Path:
    recipes = [ten_circuits(MAZE), ten_circuits(MAZE + 1), kidnapped(MAZE), carried_sessions(MAZE)[0]]
    recipes += overlapping_sessions(MAZE)
    recipes += [same_maze(MAZE, number) for number in (1, 2)]
    return plant(tmp_path_factory.mktemp("maps"), *recipes)


def measured(name: str, methods: Methods, maps: Path) -> dict[str, Sequence[str]]:
    """The measured value and that of the control, without intervals, of each figure."""
    row = find_figure(MAPS[name])
    cells = cells_by_figure(row.table([row.measure(MapTask(MAZE, maps, methods))]))
    return {figure: [value.split(" [")[0] for value in values] for figure, values in cells.items()}


@pytest.mark.parametrize(
    ("name", "figure", "oracle", "wrong"),
    [
        ("start", "found and right within 120 whisks", "1 of 1", "0 of 1"),
        ("start", "sure and wrong (> 0.18 m or 30 degrees)", "0 of 1", "1 of 1"),
        ("start", "whisks until then, median (worst)", "11 (11)", "inf (inf)"),
        ("carried", "tied on rightly after 60 whisks in the known part", "1 of 1", "0 of 1"),
        ("carried", "wrong ties, known and unknown part", "0 of 2", "2 of 2"),
        ("wall moved", "found and right within 120 whisks after the change", "1 of 1", "0 of 1"),
        ("door closed", "sure and wrong at some whisk after the change", "0 of 1", "1 of 1"),
    ],
)
def test_truth_reaches_the_goal_and_errors_are_counted(
    name: str, figure: str, oracle: str, wrong: str, maps: Path
) -> None:
    assert measured(name, ORACLE, maps)[figure][0] == oracle
    assert measured(name, WRONG, maps)[figure][0] == wrong


def test_shuffled_images_find_nothing_with_a_method_that_looks(maps: Path) -> None:
    for name, figure in (
        ("start", "found and right within 120 whisks"),
        ("carried", "tied on rightly after 60 whisks in the known part"),
    ):
        assert measured(name, ORACLE, maps)[figure][1] == "0 of 1"


def test_what_is_found_in_another_maze_is_counted(maps: Path) -> None:
    found = measured("other maze", ORACLE, maps)  # this stand-in believes to be in every maze
    assert found["found in another maze, 300 whisks"] == ["1 of 1", "1 of 1"]
    assert measured("other maze", Never(), maps)["found in another maze, 300 whisks"][0] == "0 of 1"


class Never(Oracle):
    def localise(self, made: StoredMap, recorded: Recorded) -> Localised:
        localised = super().localise(made, recorded)
        return localised._replace(found=np.zeros_like(localised.found))


def test_a_merged_map_is_compared_with_one_session_over_both(maps: Path) -> None:
    joined, apart = (measured("merge", methods, maps) for methods in (ORACLE, APART))
    assert joined["joined rightly"][0] == "1 of 1"
    assert joined["EM of the union, median (worst), of joined"][0] == "0.000 (0.000)"
    assert apart["joined rightly"][0] == "0 of 1"
    assert apart["EM of the union, median (worst), of joined"][0] == "-"


def test_joined_mazes_are_counted(maps: Path) -> None:
    assert measured("merge mazes", ORACLE, maps)["joined"] == ["1 of 1", "1 of 1"]
    assert measured("merge mazes", APART, maps)["joined"][0] == "0 of 1"


def test_frames_of_many_sessions_are_those_of_the_merged_map(maps: Path, monkeypatch) -> None:
    monkeypatch.setattr(merging, "SESSIONS", 3)
    found = measured("ten sessions", ORACLE, maps)
    frames, separate = found["keyframes after ten sessions, over those after one"]
    assert frames == "1.00 (1.00)"
    assert 2.9 < float(separate.split()[0]) < 3.1
    assert failures("ten sessions", ORACLE, maps) == []


def test_a_place_named_in_an_unchanged_maze_is_a_false_alarm(maps: Path) -> None:
    figure = "surest place named within a cell of the change"

    class Alarm(Oracle):
        def changes(self, made: StoredMap, recorded: Recorded) -> np.ndarray:
            return made.arrays.trajectory[:2, :2]

    assert measured("door closed", ORACLE, maps)[figure][1] == "0 of 1"
    assert measured("door closed", Alarm(), maps)[figure][1] == "1 of 1"


def test_a_recording_is_split_into_two_halves(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(merged_maps, "RECORDINGS", ("square",))
    recipes = merged_maps.split_recording("square")
    whole, first, second = map(record, recipes)
    assert first.log.length + second.log.length == whole.log.length
    np.testing.assert_array_equal(np.concatenate([first.truth, second.truth]), whole.truth)
    plant(tmp_path, *recipes)
    figures = find_figure(MAPS["buildings"]).measure(MapTask(0, tmp_path, ORACLE)).record
    assert not figures["not_joined"]
    assert figures["found"] > 0.9
    assert figures["off"] == figures["shuffled_found"] == 0
    assert figures["ate_merged"] == pytest.approx(figures["ate_whole"], abs=1e-9)


def test_the_page_has_a_table_and_a_picture_per_row(maps: Path, tmp_path: Path) -> None:
    (tmp_path / "maps").symlink_to(maps)
    names = ["start", "carried", "kidnaps", "merge", "door closed"]
    text = "\n".join(reproduce_maps(names, ORACLE, tmp_path, MAZE, 1))
    page = (tmp_path / "maps.md").read_text(encoding="utf-8")
    for name in names:
        picture = f"{name.replace(' ', '_')}.png"
        assert f"## {find_figure(MAPS[name]).title}" in text
        assert picture in page
        assert (tmp_path / picture).stat().st_size > 10_000
    assert "31000" in page
    sessions = read_sessions(tmp_path / "maps.csv")
    assert list(sessions) == [(name, "31000") for name in names]
    _, figures = sessions["start", "31000"]
    assert figures["whisks"] == 11


def failures(name: str, methods: Methods, maps: Path) -> list[str]:
    """What a session of a row fails in."""
    row = find_figure(MAPS[name])
    record = row.measure(MapTask(MAZE, maps, methods)).record
    assert all(isinstance(value, bool | int | float) for value in record.values())
    return [figure for figure, value in record.items() if value is True]


@pytest.mark.parametrize(
    ("name", "methods", "expected"),
    [
        ("start", ORACLE, []),
        ("start", WRONG, ["missed", "sure_and_wrong", "shuffled_sure_and_wrong"]),
        ("carried", ORACLE, []),
        ("carried", WRONG, ["not_tied", "wrong_tie", "shuffled_tied"]),
        ("wall moved", ORACLE, ["not_named"]),
        (
            "wall moved",
            WRONG,
            ["missed", "sure_and_wrong", "missed_before", "sure_and_wrong_before", "not_named"],
        ),
        ("other maze", ORACLE, ["found_elsewhere", "not_said"]),
        ("kidnaps", ORACLE, []),
        ("merge", ORACLE, []),
        ("merge", APART, ["not_joined"]),
        ("merge mazes", ORACLE, ["mazes_joined"]),
        ("merge mazes", APART, ["maze_not_joined"]),
    ],
)
def test_a_session_is_recorded_with_what_it_fails_in(
    name: str, methods: Methods, expected: list[str], maps: Path
) -> None:
    assert failures(name, methods, maps) == expected


def test_two_runs_of_saved_maps_are_compared_by_figure(maps: Path, tmp_path: Path) -> None:
    for folder in (tmp_path / "old", tmp_path / "new"):
        folder.mkdir()
        (folder / "maps").symlink_to(maps)
    list(reproduce_maps(["start", "wall moved"], ORACLE, tmp_path / "old", MAZE, 1))
    lines = list(
        reproduce_maps(["start", "wall moved"], WRONG, tmp_path / "new", MAZE, 1, against=tmp_path / "old")
    )
    assert "| start | missed | 1 | 0 | 1 | - | 0, 1 (1) |" in lines
    assert "| start | whisks | 1 | 11.000 | inf | inf [-] | - |" in lines
    assert "| all rows | missed | 2 | 0 | 2 | - | 0, 2 (0.5) |" in lines
    assert not any(line.startswith("| all rows | whisks") for line in lines)
    (said,) = (line for line in lines if line.startswith("New failures"))
    assert said.startswith("New failures: missed: start 31000; sure_and_wrong: start 31000; ")
    assert "sure_and_wrong_before: wall moved 31000" in said
    assert "Before, and now" not in (tmp_path / "new" / "maps.md").read_text()
