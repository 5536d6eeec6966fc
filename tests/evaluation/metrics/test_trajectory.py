"""Alignment, ATE, RPE, online error, interpolation, TUM files."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize

from evaluation.metrics.trajectory import (
    align,
    ate,
    interpolate,
    online_errors,
    position_errors,
    read_tum,
    rpe,
    summarize_errors,
    write_tum,
)
from tactile.base.errors import InputError
from tactile.base.se2 import between, compose, wrap

law = settings(derandomize=True, deadline=None, max_examples=60)
motions = st.tuples(st.floats(-50, 50), st.floats(-50, 50), st.floats(-np.pi, np.pi)).map(np.array)


@st.composite
def pairs_of_trajectories(draw):
    random = np.random.default_rng(draw(st.integers(0, 2**32)))
    truth = np.cumsum(random.normal(size=(draw(st.integers(2, 30)), 3)), axis=0)
    return truth + random.normal(0, 0.3, truth.shape), truth


@law
@given(pairs_of_trajectories(), motions, motions)
def test_ate_and_rpe_do_not_depend_on_the_frames(pair, a, b):
    estimate, truth = pair
    assert ate(compose(a, estimate), compose(b, truth)) == pytest.approx(ate(estimate, truth), abs=1e-9)
    assert rpe(compose(a, estimate), compose(b, truth)) == pytest.approx(rpe(estimate, truth), abs=1e-9)


@law
@given(pairs_of_trajectories(), motions)
def test_alignment_recovers_a_rigid_motion(pair, motion):
    truth, _ = pair
    assert between(align(truth, compose(motion, truth)), motion) == pytest.approx(np.zeros(3), abs=1e-9)
    assert ate(truth, compose(motion, truth)) == pytest.approx(0, abs=1e-9)


def test_no_other_rigid_motion_fits_better():
    random = np.random.default_rng(5)
    truth = np.cumsum(random.normal(size=(40, 3)), axis=0)
    estimate = truth + random.normal(0, 0.5, truth.shape)

    def rms(motion):
        return np.sqrt(np.mean(np.sum((compose(motion, estimate) - truth)[:, :2] ** 2, axis=1)))

    best = minimize(rms, np.zeros(3), method="Nelder-Mead", options={"xatol": 1e-9, "fatol": 1e-12})
    assert ate(estimate, truth) == pytest.approx(best.fun, abs=1e-9)


def test_alignment_keeps_the_scale():
    truth = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]])
    assert ate(2 * truth, truth) == pytest.approx(np.sqrt(2 / 3))
    assert position_errors(2 * truth, truth) == pytest.approx([1, 0, 1])


def test_one_row_aligns_and_none_is_refused():
    assert ate(np.array([[1.0, 2, 3]]), np.array([[4.0, 5, 6]])) == 0
    for estimate, truth in ((np.zeros((0, 3)), np.zeros((0, 3))), (np.zeros((2, 3)), np.zeros((3, 3)))):
        with pytest.raises(InputError, match="the same number of rows"):
            ate(estimate, truth)


def test_relative_rotations_are_compared_across_half_a_turn():
    truth = np.array([[0, 0, np.radians(179)], [0, 0, np.radians(-179)]])
    estimate = np.array([[0, 0, np.radians(178)], [0, 0, np.radians(-177)]])
    assert np.degrees(rpe(estimate, truth)[1]) == pytest.approx(3)
    assert np.isnan(rpe(estimate, truth, step=2)).all()


@law
@given(pairs_of_trajectories(), motions)
def test_online_errors_use_the_rows_so_far(pair, motion):
    estimate, truth = pair
    slow = [position_errors(estimate[:n], truth[:n])[-1] for n in range(1, len(truth) + 1)]
    assert online_errors(compose(motion, estimate), truth) == pytest.approx(np.array(slow), abs=1e-6)


def test_summary_of_online_errors():
    truth = np.array([[x, 0.0, 0.0] for x in range(5)])
    online = truth.copy()
    assert summarize_errors(online_errors(online, truth)) == pytest.approx((0, 0, 0), abs=1e-9)
    online[4, 0] = 9.0  # the last of five steps jumps 5 m ahead; the alignment makes up for a fifth
    assert summarize_errors(online_errors(online, truth)) == pytest.approx((0, 4 / np.sqrt(3), 4), abs=1e-9)


def test_headings_are_interpolated_along_the_shorter_arc():
    time, pose = np.array([0.0, 1.0]), np.array([[0, 0, np.radians(170)], [1, 2, np.radians(-170)]])
    found = interpolate(time, pose, np.array([-0.1, 0.0, 0.5, 0.75, 1.0, 1.1]))
    assert np.isnan(found[[0, 5]]).all()
    assert found[2, :2] == pytest.approx([0.5, 1])
    assert np.degrees(wrap(found[1:5, 2] - np.radians(170))) == pytest.approx([0, 10, 15, 20])


def test_times_must_increase():
    with pytest.raises(InputError, match=r"row 2: time 1\.0 after 1\.0"):
        interpolate(np.array([0.0, 1, 1]), np.zeros((3, 3)), np.zeros(1))


@law
@given(pairs_of_trajectories())
def test_tum_files_read_back_equal(tmp_path_factory, pair):
    pose, _ = pair
    path = tmp_path_factory.mktemp("tum") / "t.tum"
    time = 976052890.244111 + np.arange(len(pose)) / 3
    write_tum(path, time, pose)
    again_time, again = read_tum(path)
    assert np.array_equal(again_time, time)
    assert np.array_equal(again[:, :2], pose[:, :2])
    assert wrap(again[:, 2] - pose[:, 2]) == pytest.approx(np.zeros(len(pose)), abs=1e-12)


def test_a_cut_off_tum_file_lacks_only_its_last_line(tmp_path):
    path = tmp_path / "t.tum"
    write_tum(path, np.arange(5.0), np.arange(15.0).reshape(5, 3))
    whole = path.read_text()
    path.write_text(whole[: whole.rindex(" ", 0, len(whole) - 20)])
    assert read_tum(path)[0].tolist() == [0, 1, 2, 3]
    path.write_text("# a comment\n\n" + whole.replace("2.0 6.0", "2.0 six"))
    with pytest.raises(InputError, match=r"t\.tum:5: '2\.0 six"):
        read_tum(path)
    path.write_text(whole[: whole.rindex(" ")] + "\n")
    with pytest.raises(InputError, match=r"t\.tum:5"):
        read_tum(path)


def test_a_tum_rotation_of_length_zero_is_refused(tmp_path):
    path = tmp_path / "t.tum"
    path.write_text("0 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 0\n")
    with pytest.raises(InputError, match=r"t\.tum:2: a quaternion of length 0"):
        read_tum(path)


def test_roll_and_pitch_are_ignored(tmp_path):
    path = tmp_path / "t.tum"
    path.write_text("0 1 2 3 0 0 2 2\n")  # not of length 1 either
    assert read_tum(path)[1] == pytest.approx(np.array([[1, 2, np.pi / 2]]))
