"""Spikes on a path as a recording, their controls, and cells of two sessions of known tuning side by side."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from evaluation.cells.analysis import CONTROLLED, analyse_cells, control_scores, speed_score, write_scores
from evaluation.cells.cell_comparison import ComparedScore, compare_cells
from evaluation.cells.decoding import decode_positions
from evaluation.cells.rate_map import running_speed
from evaluation.cells.recording import CellRecording, record_spikes
from tactile.base.errors import InputError
from tactile.base.random_streams import stream
from tests.evaluation.cells.box_walk import Walk, direction_cells, place_cells, random_walk

WALK = random_walk()
DT = 0.05


def spikes_of(rates: np.ndarray, seed: int, time: np.ndarray = WALK.time) -> list[np.ndarray]:
    """Poisson spikes of cells with rates [T, n] Hz, anywhere within their step."""
    draw = stream(seed, "test spikes")
    counts = draw.poisson(rates * DT)
    return [np.sort(np.repeat(time, each) + draw.uniform(-DT / 2, DT / 2, each.sum())) for each in counts.T]


def fields(seed: int, cells: int, width: float, walk: Walk = WALK, turn: float = 0.0) -> np.ndarray:
    """[T, cells] rates of place cells of 15 Hz at most, in the second half turned with the cues."""
    centre = 0.1 + 0.8 * stream(seed, "centres").random((cells, 2)) - 0.5
    back = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    late = np.arange(len(walk.time)) >= len(walk.time) // 2
    place = walk.truth[:, :2] - 0.5
    return 15 * place_cells(np.where(late[:, None], place @ back, place), centre, width)


def turning(seed: int, cells: int, turn: float) -> np.ndarray:
    """[T, cells] rates of direction cells that turn with the cues."""
    preferred = stream(seed, "preferred").uniform(0, 2 * np.pi, cells)
    late = np.arange(len(WALK.time)) >= len(WALK.time) // 2
    return 20 * direction_cells(WALK.truth[:, 2] - turn * late, preferred)


def recorded(*rates: np.ndarray, seed: int = 0) -> CellRecording:
    return record_spikes(*WALK, spikes_of(np.concatenate(rates, axis=1), seed))


def by_score(rows: list[ComparedScore]) -> dict[str, ComparedScore]:
    return {row.score: row for row in rows}


@given(st.integers(0, 10**6))
def test_every_spike_of_known_time_and_place_counts_once(seed: int) -> None:
    """Also with a gap in the path, a session that was recorded in part, and samples of unknown place."""
    draw = stream(seed, "path")
    kept = np.ones(400, bool)
    kept[150:190] = False
    time, truth = DT * np.arange(400)[kept], draw.random((400, 3))[kept]
    truth[20:30] = np.nan
    spikes = [np.sort(draw.uniform(-1, 21, count)) for count in (300, 1, 0)]
    made = record_spikes(time, truth, spikes, np.array([[0.0, 9.0], [12.0, 18.0]]))
    assert (np.diff(made.time) > 0).all()
    seconds = np.diff(made.time, prepend=made.time[0] - DT)
    known = np.isfinite(made.truth).all(axis=1)
    assert_allclose(seconds[known], DT, rtol=1e-9)  # the gap is the time of no place
    whole = (made.activity * seconds[:, None]).sum(axis=0)
    inside = [((each >= -DT / 2) & (each <= time[-1] + DT / 2)).sum() for each in spikes]
    assert_allclose(whole, inside, atol=1e-9)
    counted = (made.activity * seconds[:, None])[known].sum(axis=0)
    near = [np.abs(each[:, None] - made.time[known]).min(axis=1) <= DT / 2 for each in spikes]
    assert_allclose(counted, [each.sum() for each in near], atol=1e-9)
    assert not ((made.time[known] > 9.0) & (made.time[known] < 12.0)).any()


def test_spikes_that_do_not_fit_are_refused() -> None:
    for change in (
        (WALK.time[::-1], WALK.truth, [WALK.time]),
        (*WALK, []),
        (WALK.time[:5], WALK.truth, [WALK.time]),
    ):
        with pytest.raises(InputError, match=r"increasing times, \[T, 3\] poses and one cell or more"):
            record_spikes(*change)


def test_own_spikes_are_scored_as_rates_and_every_control_is_of_its_score(tmp_path: Path) -> None:
    made = recorded(fields(0, 6, 0.1), turning(1, 3, 0.0), np.full((len(WALK.time), 2), 0.5))
    scores, controls = analyse_cells(made), control_scores(made, shuffles=40)
    assert list(controls) == [name for names in CONTROLLED.values() for name in names]
    for name, control in controls.items():
        assert_allclose(control.score, getattr(scores, name), rtol=1e-5, atol=1e-9, err_msg=name)
        assert control.shuffled.shape == (40, 11)
    assert np.isnan(scores.sheet_x).all()
    assert np.isnan(scores.sheet_heading).all()
    # A cell without tuning has the information of its scatter, which the shuffles have too.
    assert controls["information"].above[:6].all()
    assert controls["vector_length"].above[6:9].all()
    assert (scores.information[9:] > 0.02).all()
    assert (np.abs(controls["information"].corrected[9:]) < 0.01).all()
    flat = made.activity.mean(axis=0)
    assert_allclose(scores.mean_rate, flat, rtol=0.05)
    write_scores(tmp_path / "cells.csv", scores, controls, tuple("abcdefghijk"))
    lines = (tmp_path / "cells.csv").read_text(encoding="utf-8").splitlines()
    header, first = (line.split(",") for line in lines[:2])
    assert len(lines) == 12
    assert first[0] == "a"
    at = header.index("information")
    assert header[at : at + 4] == [
        "information",
        "information_shuffled",
        "information_p95",
        "information_corrected",
    ]
    assert float(first[at + 2]) == controls["information"].percentile[0]
    for name in ("grid", "square", "border", "speed"):
        assert {f"{name}_shuffled", f"{name}_p95"} <= set(header)


def test_speed_cells_have_their_score_and_jitter_is_no_speed() -> None:
    time, still = DT * np.arange(100), np.zeros((100, 3))
    still[50:, 0] = np.arange(50) * 0.3 * DT
    assert_allclose(running_speed(time, still)[60:90], 0.3, rtol=1e-9)
    assert running_speed(time, still)[:40].max() == 0
    rates, seconds = np.array([[1.0, 2, 3, 4], [4, 3, 2, 1], [2, 2, 2, 2]]), np.array([1.0, 5, 2, 1])
    assert_allclose(speed_score(rates, seconds), [1, -1, np.nan], atol=1e-12)


def test_cells_of_one_kind_are_alike_and_other_tuning_is_found_on_its_side() -> None:
    narrow, wide = (
        recorded(fields(2, 20, 0.1), turning(2, 10, 0.0), seed=2),
        recorded(fields(3, 30, 0.16), seed=3),
    )
    rows = by_score(compare_cells(narrow, wide, (300.0, 300.0), shuffles=19, draws=200))
    assert rows["turn of preferred directions, rad"].cells[1] < 5  # hardly any cell is tuned by chance
    assert rows["information, corrected"].cells == (30, 30)
    difference = rows["field_area"].difference
    assert difference[1] > 0  # m², without 0 in the interval
    assert rows["field_area"].above[1] > 0.5
    assert (
        rows["vector_length, share beyond shuffles"].model[0]
        > rows["vector_length, share beyond shuffles"].data[2]
    )
    same = by_score(
        compare_cells(
            narrow, recorded(fields(4, 20, 0.1), turning(4, 10, 0.0), seed=4), shuffles=19, draws=200
        )
    )
    held = [row.difference[1] <= 0 <= row.difference[2] for row in same.values()]
    assert np.mean(held) > 0.8
    assert all(0.3 < row.above[0] < 0.7 for row in same.values() if np.isfinite(row.above[0]))
    with pytest.raises(InputError, match="a cell with 50 spikes"):
        compare_cells(narrow, record_spikes(*WALK, [WALK.time[:10]]))


def test_maps_and_directions_that_turn_with_the_cues_are_told_from_those_that_stay() -> None:
    quarter = np.pi / 2
    followed = recorded(fields(5, 16, 0.12, turn=quarter), turning(5, 5, quarter), seed=5)
    stayed = recorded(fields(6, 16, 0.12), turning(6, 5, 0.0), seed=6)
    rows = by_score(compare_cells(followed, stayed, (300.0, 300.0), shuffles=19, draws=100))
    turn, direction = rows["best turn of maps, rad"], rows["turn of preferred directions, rad"]
    assert turn.model[0] == pytest.approx(quarter, abs=0.01)
    assert turn.data[0] == pytest.approx(0.0, abs=0.01)
    assert direction.model[0] == pytest.approx(quarter, abs=0.06)
    assert direction.data[0] == pytest.approx(0.0, abs=0.06)
    assert direction.model[1] <= direction.model[0] <= direction.model[2]
    assert (
        rows["map correlation, before and after"].model[2]
        < 0.4
        < rows["map correlation, before and after"].data[1]
    )
    back = rows["map correlation, turned back by the best turn"]
    assert back.model[1] > 0.5 > rows["map correlation, so turned, with another cell"].model[2]
    alone = by_score(compare_cells(followed, stayed, (300.0, None), shuffles=20, draws=50))[
        "best turn of maps, rad"
    ]
    assert alone.cells[1] == 0
    assert np.isnan(alone.data).all()
    with pytest.raises(InputError, match="a turn of cues at 9000 s"):
        compare_cells(followed, stayed, (9000.0, None))


def test_regions_of_the_decoded_place_hold_their_share_of_truths() -> None:
    made = recorded(fields(7, 64, 0.12), seed=7)
    found = decode_positions(made, window=0.2, bins=30, smoothing=2.0)
    levels = found.level[np.unique(found.time // 5, return_index=True)[1]]
    assert len(levels) == 120
    assert 0.38 < np.mean(levels < 0.5) < 0.62  # 3 sd of 120 truths
    assert 0.82 < np.mean(levels < 0.9) < 0.98
