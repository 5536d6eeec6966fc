"""Alignment, ATE, RPE (also of evo), energies, TUM files, rates; errors known of published recordings."""

import os
import re
import shutil
import subprocess
from itertools import combinations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from evaluation.metrics import energy_metric, trajectory
from evaluation.metrics.energy_metric import (
    energy,
    energy_all_pairs,
)
from evaluation.metrics.run_metrics import energy_within_pieces, unjoined_share
from evaluation.metrics.statistics import bootstrap, expected_calibration_error, wilson_interval
from evaluation.metrics.trajectory import ate, online_errors, read_tum, rpe, successive_pairs, write_tum
from tactile.base.errors import InputError
from tactile.base.se2 import between, compose, integrate, wrap

law = settings(max_examples=50)
motions = st.tuples(st.floats(-50, 50), st.floats(-50, 50), st.floats(-np.pi, np.pi)).map(np.array)


@st.composite
def pairs_of_trajectories(draw):
    random = np.random.default_rng(draw(st.integers(0, 2**32)))
    truth = np.cumsum(random.normal(size=(draw(st.integers(2, 25)), 3)), axis=0)
    return truth + random.normal(0, draw(st.sampled_from([0.1, 3.0])), truth.shape), truth


def every_pair(count):
    return np.array(list(combinations(range(count), 2)))


@law
@given(pairs_of_trajectories(), motions, motions)
def test_errors_do_not_depend_on_the_frames(pair, a, b):
    estimate, truth = pair
    moved, other = compose(a, estimate), compose(b, truth)
    assert ate(moved, other) == pytest.approx(ate(estimate, truth), abs=1e-9)
    assert rpe(moved, other) == pytest.approx(rpe(estimate, truth), abs=1e-9)
    direct = energy(estimate, truth, every_pair(len(truth)))
    assert energy_all_pairs(moved, other) == pytest.approx(direct, rel=1e-9, abs=1e-9)
    slow = [trajectory.position_errors(estimate[:n], truth[:n])[-1] for n in range(1, len(truth) + 1)]
    assert online_errors(moved, truth) == pytest.approx(np.array(slow), abs=1e-6)  # of the rows so far


@law
@given(pairs_of_trajectories(), motions, st.integers(1, 4))
def test_a_rigid_motion_of_the_truth_is_no_error(pair, motion, step):
    truth, _ = pair
    moved = compose(motion, truth)
    assert between(trajectory.align(truth, moved), motion) == pytest.approx(np.zeros(3), abs=1e-9)
    assert ate(truth, moved) == pytest.approx(0, abs=1e-9)
    assert energy_all_pairs(truth, moved)[:2] == pytest.approx((0, 0), abs=1e-10)
    if len(truth) > step:
        pairs = successive_pairs(len(truth), step)
        assert energy(truth, moved, pairs)[:2] == pytest.approx((0, 0), abs=1e-10)


def test_errors_by_hand_and_of_rotations_across_half_a_turn():
    line = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]])
    assert ate(2 * line, line) == pytest.approx(np.sqrt(2 / 3))  # alignment keeps the scale
    assert trajectory.position_errors(2 * line, line) == pytest.approx([1, 0, 1])
    assert ate(line[:1], line[1:2]) == 0
    for estimate, truth in ((line[:0], line[:0]), (line[:2], line)):
        with pytest.raises(InputError, match="the same number of rows"):
            ate(estimate, truth)
    found = energy(np.array([[0.0, 0, 0], [1, 0.5, 0.2]]), line[:2], successive_pairs(2))
    assert found == pytest.approx((0.25, 0.04, 1))
    assert found.total == pytest.approx(0.29)
    none = energy(line[:1], line[:1], successive_pairs(1)), energy_all_pairs(line[:1], line[:1])
    assert np.isnan([one.total for one in none]).all()
    assert successive_pairs(5, 3).tolist() == [[0, 3], [1, 4]]
    assert successive_pairs(2, 3).shape == (0, 2)
    truth, estimate = np.zeros((2, 2, 3))
    truth[:, 2], estimate[:, 2] = np.radians([179, -179]), np.radians([178, -177])
    assert np.degrees(rpe(estimate, truth)[1]) == pytest.approx(3)
    assert np.isnan(rpe(estimate, truth, step=2)).all()
    truth, estimate = np.zeros((2, 3, 3))
    estimate[:, 2] = np.radians([179, -179, 1])
    expected = np.mean(np.radians([2, 178, 180]) ** 2)
    assert energy(estimate, truth, every_pair(3)).rot2 == pytest.approx(expected)
    assert energy_all_pairs(estimate, truth).rot2 == pytest.approx(expected)
    truth = np.array([[x, 0.0, 0.0] for x in range(5)])
    online = truth.copy()
    assert trajectory.summarize_errors(online_errors(online, truth)) == pytest.approx((0, 0, 0), abs=1e-9)
    online[4, 0] = 9.0  # the last of five steps jumps 5 m ahead; the alignment makes up for a fifth
    assert trajectory.summarize_errors(online_errors(online, truth)) == pytest.approx(
        (0, 4 / 3**0.5, 4), abs=1e-9
    )


def test_all_pairs_of_a_long_run_need_no_memory():
    random = np.random.default_rng(1)
    truth = np.cumsum(random.normal(size=(14_000, 3)), axis=0)
    found = energy_all_pairs(truth + random.normal(0, 0.01, truth.shape), truth)
    assert found.pairs == 14_000 * 13_999 // 2
    assert found.rot2 == pytest.approx(2e-4, rel=0.05)


@law
@given(pairs_of_trajectories(), st.integers(1, 4), st.integers(0, 2**32))
def test_energy_within_pieces_is_of_their_pairs_wherever_they_lie(pair, count, seed):
    estimate, truth = pair
    piece = np.random.default_rng(seed).integers(0, count, len(truth))
    close = {"rel": 1e-6, "abs": 1e-9, "nan_ok": True}
    pairs = [(i, j) for i, j in combinations(range(len(piece)), 2) if piece[i] == piece[j]]
    found = energy_within_pieces(estimate, truth, piece)
    assert found == pytest.approx(energy(estimate, truth, np.array(pairs, int).reshape(-1, 2)), **close)
    moved = estimate.copy()
    moved[piece == piece[0]] = compose(np.array([3.0, -2.0, 1.0]), moved[piece == piece[0]])
    assert energy_within_pieces(moved, truth, piece) == pytest.approx(found, **close)
    one = np.full(len(truth), 3)
    assert energy_within_pieces(estimate, truth, one) == energy_all_pairs(estimate, truth)
    assert unjoined_share(one) == 0
    assert unjoined_share(piece) == pytest.approx(1 - np.bincount(piece).max() / len(piece))
    assert np.isnan(unjoined_share(piece[:0]))
    assert energy_within_pieces(estimate[:0], truth[:0], piece[:0]).pairs == 0


def test_headings_and_relations_are_interpolated_along_the_shorter_arc():
    time, pose = np.array([0.0, 1.0]), np.array([[0, 0, np.radians(170)], [1, 2, np.radians(-170)]])
    found = trajectory.interpolate(time, pose, np.array([-0.1, 0.0, 0.5, 0.75, 1.0, 1.1]))
    assert np.isnan(found[[0, 5]]).all()
    assert found[2, :2] == pytest.approx([0.5, 1])
    assert np.degrees(wrap(found[1:5, 2] - np.radians(170))) == pytest.approx([0, 10, 15, 20])
    with pytest.raises(InputError, match=r"row 2: time 1\.0 after 1\.0"):
        trajectory.interpolate(np.array([0.0, 1, 1]), np.zeros((3, 3)), np.zeros(1))
    time = np.array([0.0, 1, 2])
    pose = np.array([[0, 0, np.radians(170)], [1, 0, np.radians(-170)], [2, 0, np.radians(-170)]])
    true = between(np.array([0.5, 0, np.pi]), np.array([1.5, 0, np.radians(-170)]))
    off = true + np.array([0.3, 0.4, np.radians(-6)])
    relations = energy_metric.Relations(
        np.array([0.5, 0.5, 1.5]), np.array([1.5, 1.5, 2.5]), np.stack([true, off, true])
    )
    assert energy_metric.relation_errors(time, pose, relations) == pytest.approx((0.25, 3.0, 2, 1))
    with pytest.raises(InputError, match="none inside the recording"):
        energy_metric.relation_errors(time + 100, pose, relations)


@pytest.mark.parametrize("head", ["", "t1,t2,x,y,z,roll,pitch,yaw\n"])
def test_relations_file_with_and_without_a_header(tmp_path, head):
    path, row = tmp_path / "relations", "1.5 2.5 0.1 0.2 0 0 0 -1.5\n"
    path.write_text(head + (row.replace(" ", ",") if head else row) + "3 4 5")
    found = energy_metric.read_relations(path)
    assert (found.start.tolist(), found.end.tolist()) == ([1.5], [2.5])
    assert found.motion.tolist() == [[0.1, 0.2, -1.5]]


@law
@given(pairs_of_trajectories())
def test_tum_files_read_back_equal(tmp_path_factory, pair):
    pose, path = pair[0], tmp_path_factory.getbasetemp() / "t.tum"
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
    path.write_text("0 1 2 3 0 0 2 2\n")  # roll and pitch are ignored; not of length 1 either
    assert read_tum(path)[1] == pytest.approx(np.array([[1, 2, np.pi / 2]]))
    for text, message in (
        ("# a comment\n\n" + whole.replace("2.0 6.0", "2.0 six"), r"t\.tum:5: '2\.0 six"),
        (whole[: whole.rindex(" ")] + "\n", r"t\.tum:5"),
        ("0 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 0\n", r"t\.tum:2: a quaternion of length 0"),
    ):
        path.write_text(text)
        with pytest.raises(InputError, match=message):
            read_tum(path)


@law
@given(st.integers(0, 200), st.integers(1, 200))
def test_an_interval_holds_the_rate_and_mirrors_its_complement(count, runs):
    count = min(count, runs)
    low, high = wilson_interval(count, runs)
    assert 0 <= low <= count / runs <= high <= 1
    assert wilson_interval(runs - count, runs) == pytest.approx((1 - high, 1 - low))
    assert wilson_interval(0, 4 * runs)[1] < wilson_interval(0, runs)[1]
    assert wilson_interval(0, 0) == (0.0, 1.0)
    printed = {(0, 10): (0.0, 0.2775), (5, 10): (0.2366, 0.7634), (18, 18): (0.8241, 1.0)}
    for rate, interval in printed.items():
        assert wilson_interval(*rate) == pytest.approx(interval, abs=1e-4)


def test_calibration_and_bootstrap_of_known_values():
    half = np.full(20, 0.5)
    assert expected_calibration_error(half, np.arange(20) % 2 == 0) == 0.0
    assert expected_calibration_error(half, np.ones(20, bool)) == 0.5
    random = np.random.default_rng(0)
    probability = random.random(20_000)
    assert expected_calibration_error(probability, random.random(20_000) < probability) < 0.02
    assert expected_calibration_error(probability, random.random(20_000) < probability**2) > 0.1
    assert np.isnan(expected_calibration_error(np.zeros(0), np.zeros(0, bool)))
    values = np.random.default_rng(1).normal(size=30)
    low, high = bootstrap(values, "a")
    assert (low, high) == bootstrap(values, "a")
    assert len({(low, high), bootstrap(values, "b"), bootstrap(values, "a", seed=1)}) == 3
    assert low < values.mean() < high
    # of the normal approximation, within a tenth
    assert high - low == pytest.approx(2 * 1.96 * values.std() / np.sqrt(30), rel=0.1)
    assert np.isnan(bootstrap(np.zeros(0), "a")).all()


def dead_reckoning(trace):
    """Raw odometry [N, 3]: a step goes along its new heading, and the first row only sets the clock."""
    dt = np.diff(trace["in_t"], prepend=trace["in_t"][0])
    way, turn = trace["in_v"] * dt, trace["in_w"] * dt
    return integrate(np.stack([way * np.cos(turn), way * np.sin(turn), turn], axis=1))


def final_map(trace):
    """Final position [N, 3] of each row's experience; node 0 before there is any."""
    return trace["map_final"][trace["out_em_exp"].astype(int), 1:4]


@pytest.mark.parametrize(("name", "odometry", "reference", "digit"), [
    ("f_real_intel_laser3x6", 24.16, 9.83, 0.01),
    ("f_real_tuc_lecture_hall", 12.95, 3.03, 0.01),
    ("b_figure8_alias", 0.174, 0.742, 0.001),
    ("a_square3", 0.248, 0.044, 0.001),
    ("e_kidnap", 0.764, 0.432, 0.001),
])  # fmt: skip
def test_ate_of_odometry_and_of_the_reference_map(find_trace, name, odometry, reference, digit):
    run = np.load(find_trace(name))
    assert ate(dead_reckoning(run), run["truth"]) == pytest.approx(odometry, abs=digit / 2)
    assert ate(final_map(run), run["truth"]) == pytest.approx(reference, abs=digit / 2)


def test_relations_of_the_intel_lab(reference_data, find_trace):
    relations = energy_metric.read_relations(reference_data / "data" / "intel_relations.csv")
    rows = np.loadtxt(reference_data / "data" / "intel_odom_gt.csv", delimiter=",", skiprows=1)
    time, odometry, truth = rows[:, 0], rows[:, 1:4], rows[:, 4:]
    run = np.load(find_trace("f_real_intel_laser3x6"))

    def errors(pose):
        return energy_metric.relation_errors(time, pose, relations)

    assert errors(truth) == pytest.approx((0.126, 4.11, 2983, 1), abs=0.005)
    # raw odometry is the recording's own pose columns; the trace's has lost its lateral part
    assert errors(odometry)[:2] == pytest.approx((7.43, 40.9), abs=0.005)
    assert errors(dead_reckoning(run))[:2] == pytest.approx((7.506, 40.9), abs=0.005)
    assert errors(final_map(run))[:2] == (pytest.approx(1.385, abs=0.001), pytest.approx(25.9, abs=0.05))


def test_ate_and_rpe_agree_with_evo(tmp_path):
    if not (shutil.which("evo_ape") and shutil.which("evo_rpe")):
        pytest.skip("evo's command line is not installed")

    def evo(command, *options):
        line = [command, "tum", tmp_path / "truth.tum", tmp_path / "estimate.tum", *options]
        env = {**os.environ, "HOME": str(tmp_path), "MPLBACKEND": "Agg"}
        done = subprocess.run(line, env=env, capture_output=True, text=True, timeout=120, check=True)
        return float(re.search(r"rmse\s+(\S+)", done.stdout)[1])

    random = np.random.default_rng(8)
    truth = np.cumsum(random.normal(size=(80, 3)) * [0.3, 0.3, 0.4], axis=0)
    estimate = truth + random.normal(0, 0.1, truth.shape)
    write_tum(tmp_path / "truth.tum", np.arange(80.0), truth)
    write_tum(tmp_path / "estimate.tum", np.arange(80.0), estimate)
    assert evo("evo_ape", "--align") == pytest.approx(ate(estimate, truth), abs=2e-6)
    assert evo("evo_rpe") == pytest.approx(rpe(estimate, truth)[0], abs=2e-6)
    found = evo("evo_rpe", "--pose_relation", "angle_deg", "--delta", "5", "--all_pairs")
    assert found == pytest.approx(np.degrees(rpe(estimate, truth, step=5)[1]), abs=2e-6)
