"""Recorded pose cells: those of the network of both methods, the same bits of all else, Ctrl-C, refusals."""

from dataclasses import replace
from functools import partial

import jax
import numpy as np
import pytest

import ratslam
from ratslam.classic.cell_probe import active_cells, choose_cells
from ratslam.classic.levels import to_full_torus
from ratslam.examples import dead_reckoning
from ratslam.methods.method_registry import Sensors
from ratslam.runs.build_session import build_session
from ratslam.runs.cell_recorder import ROWS, plan_recording
from ratslam.runs.run import process_source
from ratslam.runs.runner import open_runner
from ratslam.runs.settings.run_config import LoopConfig
from robot.sources.in_memory import InMemorySource
from tests.ratslam.runs.test_continued_runs import Stopping

STEPS, RATE = 200, 50.0
SHAPE = (36, 21, 21)
CELLS = {"chosen": 40, "sums": {"bins": 4, "heading_bins": 8}}
METHOD = {"backend": "classic", "templates": {"threshold": 0.02, "recent": 0}}


@pytest.fixture(scope="module")
def walk():
    """Circles whose views come back, so that both window levels are used; the last poses are unknown."""
    angle = 4 * np.pi * np.arange(STEPS) / STEPS
    truth = np.stack([0.5 + 0.4 * np.cos(angle), 0.5 + 0.4 * np.sin(angle), angle + np.pi / 2], axis=1)
    truth[-10:] = np.nan
    motion = np.tile([0.06, 0.0, 4 * np.pi / STEPS, 1 / RATE], (STEPS, 1))
    motion[0] = 0.0
    kind = 1 + np.arange(STEPS) // 5 % 7
    views = 0.5 + 0.5 * np.sin(np.arange(8) * kind[:, None])
    return InMemorySource(
        name="circles", digest="circles", time=np.arange(STEPS) / RATE, motion=motion,
        moved=np.ones(STEPS, bool), views=views[:, None, :, None], seen=np.arange(STEPS) % 5 == 0,
        label=np.full(STEPS, -1, np.int32), truth=truth,
    )  # fmt: skip


def config_of(cells, method=METHOD):
    return LoopConfig.model_validate({**method, "cells": cells})


@pytest.fixture(scope="module")
def live(walk):
    """A session that records, its steps one at a time, and the whole torus after each."""
    session = build_session(config_of(CELLS), walk)
    whole = jax.jit(partial(to_full_torus, session.backend.window_levels))
    steps, torus = [], []
    for sample in walk:
        steps.append(session.step(sample.reading))
        torus.append(whole(session.state.cells.activity))
    return session, steps, np.array(torus).reshape(STEPS, -1)


def test_recorded_activity_is_that_of_the_state_after_each_step(live):
    session, steps, torus = live
    assert {int(step.evidence.window_level) for step in steps} == {0, 1}
    single, drawn = torus.astype(np.float32), np.array([step.probed for step in steps])
    assert drawn.shape == (STEPS, 40)
    assert (drawn > 0).any()
    for k, step in enumerate(steps):
        assert set(drawn[k].tolist()) <= set(single[k].tolist())
        assert (step.seldom is not None) == (k % 5 == 4)
        if step.seldom is not None:
            cell, active = active_cells(session.backend.window_levels, step.seldom)
            np.testing.assert_array_equal(np.bincount(cell, active, len(single[k])), single[k])


def test_recall_records_the_same_live_and_in_replay(walk):
    # The same at the same place of both circles.
    walk = replace(walk, views=walk.views[np.arange(STEPS) // 5 % 20 * 5])
    session = build_session(config_of({**CELLS, "chosen": 400}, {"backend": "recall"}), walk)
    cells = session.backend.probe()
    whole = jax.jit(partial(cells.each, chosen=np.arange(np.prod(cells.shape))))
    steps, torus = [], []
    for sample in walk:
        steps.append(session.step(sample.reading))
        torus.append(np.asarray(whole(session.state)))
    drawn = np.array([step.probed for step in steps])
    assert drawn.dtype == np.float32
    assert (drawn > 0).any()
    expected = np.array(torus)[:, choose_cells(400, cells.shape, seed=0)]
    np.testing.assert_allclose(drawn, expected, rtol=1e-4, atol=1e-9)
    check_replay(session, walk, steps)


def check_replay(session, walk, steps):
    session.restart()
    again = session.replay([sample.reading for sample in walk][: len(steps)])
    for one, other in zip(steps, again, strict=True):
        np.testing.assert_array_equal(one.probed, other.probed)
        jax.tree.map(np.testing.assert_array_equal, one.seldom, other.seldom)


def leaves(steps):
    return [np.concatenate([np.ravel(x) for x in (*s.estimate, *s.evidence, s.pose)]) for s in steps]


def test_replay_equals_live_and_recording_changes_no_bit(live, walk):
    session, steps, _ = live
    state = session.arrays() | {"path": session.map.trajectory()}
    check_replay(session, walk, steps)
    assert session.compilations() == 1
    plain = build_session(config_of(None), walk)
    off = list(plain.replay([sample.reading for sample in walk]))
    assert off[0].probed is None
    np.testing.assert_array_equal(leaves(off), leaves(steps))
    for name, value in (plain.arrays() | {"path": plain.map.trajectory()}).items():
        np.testing.assert_array_equal(value, state[name], err_msg=name)


def run(walk, directory, cells=CELLS, resume=None):
    """An unfinished run has rows and no recording."""
    with open_runner(config_of(cells), walk, directory, resume) as runner:
        interrupted = process_source(runner, walk)
        assert (directory / ROWS).exists() == (cells is not None)
        assert not (directory / "cells.npz").exists()
        runner.finish(interrupted)
    return ratslam.Result(directory)


@pytest.fixture(scope="module")
def result(walk, tmp_path_factory):
    return run(walk, tmp_path_factory.mktemp("cells") / "run")


def test_a_run_and_a_loop_of_ones_own_record_their_steps(result, live, walk):
    (_, steps, torus), cells = live, result.cells
    assert (cells.shape, cells.cell_size) == (SHAPE, 0.1)
    expected = {
        "time": walk.time, "truth": walk.truth, "activity": torus.astype(np.float32)[:, cells.cell],
        "packet": [step.evidence.packet for step in steps], "place": [step.estimate.place for step in steps],
        "energy": [step.evidence.energy for step in steps],
    }  # fmt: skip
    for name, values in expected.items():
        np.testing.assert_array_equal(getattr(cells, name), values, err_msg=name)
    assert (cells.energy > 0).any()
    assert not (result.directory / ROWS).exists()
    slam = ratslam.Slam(config_of(CELLS), walk)
    assert slam.cells is None
    for sample, activity in zip(walk, result.cells.activity[:20], strict=False):
        slam.step(sample)
        np.testing.assert_array_equal(slam.cells, activity)


def test_sums_are_those_of_the_whole_recording(result, live, walk):
    _, _, torus = live
    sums, due = result.cells.sums, np.arange(4, STEPS - 10, 5)
    pose, seconds = walk.truth[due], np.diff(walk.time[due], prepend=0.0)
    edges, at = [sums.y_edges, sums.x_edges], [pose[:, 1], pose[:, 0]]
    expected = np.array([np.histogram2d(*at, edges, weights=seconds * one)[0] for one in torus[due].T])
    np.testing.assert_allclose(sums.seconds, np.histogram2d(*at, edges, weights=seconds)[0], rtol=1e-9)
    np.testing.assert_allclose(sums.place, expected, rtol=1e-6, atol=1e-12)
    headings = np.round(pose[:, 2] / (2 * np.pi) * 8).astype(int) % 8
    expected = np.array([np.bincount(headings, seconds * one, 8) for one in torus[due].T])
    np.testing.assert_allclose(sums.heading, expected, rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(sums.heading_seconds, np.bincount(headings, seconds, 8), rtol=1e-9)
    assert (sums.x_edges[0], sums.x_edges[-1]) == (np.nanmin(walk.truth[:, 0]), np.nanmax(walk.truth[:, 0]))


def test_an_interrupted_run_has_its_cells_and_a_continued_one_the_rest(result, walk, tmp_path, capsys):
    first = run(Stopping(**vars(walk), number=70), tmp_path / "first")
    assert first.interrupted
    second = run(walk, tmp_path / "second", resume=tmp_path / "first")
    assert len(first.cells.time) == 80
    whole, parts = result.cells, (first.cells, second.cells)
    for name in ("time", "truth", "packet", "energy", "place", "activity"):
        found = np.concatenate([getattr(part, name) for part in parts])
        np.testing.assert_array_equal(found, getattr(whole, name), err_msg=name)
    # The first due step of the second part counts from the part's first step on: 4 steps instead of 5.
    lost = whole.sums.seconds.sum() - sum(part.sums.seconds.sum() for part in parts)
    assert lost == pytest.approx(1 / RATE)


def test_bad_settings_are_one_error_before_the_run_directory_is_made(walk, tmp_path):
    for cells, message in (
        ({"chosen": 15_877}, "cells.chosen: 15877; expected at most 15876"),
        ({"sums": {"bins": 500}}, "cells.sums: .* 15876 cells, which need 29.6 GiB; expected at most 2 "),
    ):
        with (
            pytest.raises(ratslam.InputError, match=message),
            open_runner(config_of(cells), walk, tmp_path / "run"),
        ):
            pass
        assert not (tmp_path / "run").exists()
    backend = dead_reckoning.ENTRY.build(dead_reckoning.Config(), Sensors((1, 8, 1)), np.dtype(float))
    config = LoopConfig.model_validate({"backend": "dead_reckoning", "cells": {}})
    with pytest.raises(
        ratslam.InputError, match="cells: `backend: dead_reckoning`, a method without pose cells"
    ):
        plan_recording(config, walk, backend)


def test_the_extent_is_given_if_the_truth_is_unknown(walk, tmp_path):
    unknown = replace(walk, truth=None)
    with pytest.raises(ratslam.InputError, match=r"cells.sums.extent: missing, and circles does not tell"):
        build_session(config_of(CELLS), unknown)
    given = {**CELLS, "sums": {**CELLS["sums"], "extent": [0.0, 0.0, 0.5, 1.0]}}
    sums = run(walk, tmp_path / "known", given).cells.sums
    assert (sums.x_edges[-1], sums.y_edges[-1]) == (0.5, 1.0)
    inside = np.flatnonzero(walk.truth[:, 0] <= 0.5)
    assert sums.seconds.sum() == pytest.approx(5 / RATE * np.sum(inside % 5 == 4))
    cells = run(unknown, tmp_path / "unknown", given).cells
    assert np.isnan(cells.truth).all()
    assert len(cells.activity) == STEPS
    assert cells.sums.seconds.sum() == cells.sums.place.sum() == 0
