"""Exported MCAP files hold what the run holds: poses, transforms, twists, markers, views, grids."""

from __future__ import annotations

import shutil

import numpy as np
import pytest

from evaluation.artifacts.closure_table import read_closure_table
from evaluation.artifacts.grid_files import write_nav2
from evaluation.artifacts.recorded_views import WhiskerViews, write_whisker_views
from evaluation.artifacts.run_reader import read_run
from evaluation.metrics.trajectory import align
from ratslam.service.export_formats import export_run
from tactile.base.se2 import compose
from tests.ratslam.service.export.export_cases import (
    GRID,
    ROOT,
    assert_same_poses,
    messages,
    nanoseconds,
    path_of,
    pose_of,
)


def test_paths_and_poses_are_those_of_the_run(square, exported):
    run, found = read_run(square), messages(exported)
    assert_same_poses(path_of(found, "/path/map"), run.final)
    assert_same_poses(path_of(found, "/path/odometry"), run.odometry)
    known = np.isfinite(run.truth).all(axis=1)
    assert 200 < known.sum() < len(known)
    truth = path_of(found, "/path/truth")
    back = compose(align(run.final[known], run.truth[known]), truth)
    assert_same_poses(back, run.truth[known])
    assert_same_poses(np.array([pose_of(m.pose.pose) for _, m in found["/pose"]]), run.online)
    stamps = [round(float(t) * 10**9) for t in run.time]
    assert [time for time, _ in found["/pose"]] == stamps
    assert [nanoseconds(m.header.stamp) for _, m in found["/pose"]] == stamps
    spread = np.genfromtxt(
        square / "steps.csv", delimiter=",", names=True, usecols=("sd_x", "sd_y", "sd_heading")
    )
    covariance = np.array([m.pose.covariance for _, m in found["/pose"]]).reshape(-1, 6, 6)
    for name, axis in (("sd_x", 0), ("sd_y", 1), ("sd_heading", 5)):
        assert np.array_equal(covariance[:, axis, axis], spread[name] ** 2)


def test_transforms_lead_from_the_map_over_the_odometry_to_the_online_pose(square, exported):
    run, found = read_run(square), messages(exported)
    chain = []
    for (_, tf), (_, odometry) in zip(found["/tf"], found["/odom"], strict=True):
        outer, inner = tf.transforms
        frames = [(t.header.frame_id, t.child_frame_id) for t in (outer, inner)]
        assert frames == [("map", "odom"), ("odom", "base_link")]
        assert (odometry.header.frame_id, odometry.child_frame_id) == ("odom", "base_link")
        assert np.array_equal(pose_of(inner.transform), pose_of(odometry.pose.pose))
        chain.append(compose(pose_of(outer.transform), pose_of(inner.transform)))
    assert_same_poses(np.array(chain), run.online)


def test_twists_lead_from_each_odometry_pose_to_the_next(exported):
    odometry = [m for _, m in messages(exported)["/odom"]]
    pose = np.array([pose_of(m.pose.pose) for m in odometry])
    twist = np.array(
        [[m.twist.twist.linear.x, m.twist.twist.linear.y, m.twist.twist.angular.z] for m in odometry]
    )
    seconds = np.diff([nanoseconds(m.header.stamp) for m in odometry]) / 1e9
    moved = compose(pose[:-1], twist[1:] * seconds[:, None])
    assert np.abs(moved - pose[1:])[:, :2].max() < 1e-9


def test_markers_show_the_graph_and_every_candidate_for_a_closure(square, exported):
    ((_, array),) = messages(exported)["/markers"]
    points = {marker.ns: len(marker.points) for marker in array.markers}
    run = read_run(square)
    pairs, verdicts, _ = read_closure_table(square)
    assert len(pairs) == len(verdicts) > 100
    expected = {"graph/experiences": len(run.nodes), "graph/links": 2 * len(run.links)}
    expected |= {f"closures/{verdict}": 2 * verdicts.count(verdict) for verdict in set(verdicts)}
    assert points == expected


def test_views_are_those_of_the_recording(exported):
    images = [m for _, m in messages(exported)["/view"]]
    assert {(m.height, m.width, m.encoding, m.step) for m in images} == {(3, 6, "mono8", 6)}
    recorded = np.load(ROOT / "tests" / "golden" / "a_square3.npz")["in_view"]
    shown = np.array([list(m.data) for m in images]) / 255
    assert np.abs(shown - recorded).max() <= 0.5 / 255 + 1e-9


def test_whisker_images_and_the_grid_are_in_the_file(copy, tmp_path):
    steps = len(read_run(copy).time)
    pixels = np.random.default_rng(0).integers(0, 256, (steps, 3, 6))
    views = WhiskerViews(pixels / 255, np.ones(pixels.shape, bool), np.zeros(6), np.ones(3), 0.1)
    write_whisker_views(copy / "views.npz", views)
    write_nav2(copy, GRID)
    export_run(copy, tmp_path / "run.mcap")
    found = messages(tmp_path / "run.mcap")
    assert np.array_equal([list(m.data) for _, m in found["/view"]], pixels.reshape(steps, -1))
    ((_, grid),) = found["/map"]
    assert (grid.info.height, grid.info.width, grid.header.frame_id) == (2, 3, "map")
    assert grid.info.resolution == pytest.approx(0.05)
    assert (grid.info.origin.position.x, grid.info.origin.position.y) == (-1.25, 0.5)
    assert list(grid.data) == [0, -1, 100, 0, -1, 100]


def test_a_killed_run_without_truth_is_exported(copy, tmp_path):
    """Only the text files of a run directory stand, and its recording has been moved."""
    kept = ("online.tum", "odometry.tum", "truth.tum", "steps.csv", "config.yaml", "manifest.json")
    (copy / "truth.tum").write_text("")
    for path in copy.iterdir():
        if path.name not in kept:
            path.unlink()
    text = (copy / "config.yaml").read_text(encoding="utf-8")
    (copy / "config.yaml").write_text(text.replace("a_square3.npz", "elsewhere.npz"), encoding="utf-8")
    with (copy / "steps.csv").open("a", encoding="utf-8") as file:
        file.write("1.0,3,no")  # a line that was cut off
    said = []
    export_run(copy, tmp_path / "run.mcap", said.append)
    found = messages(tmp_path / "run.mcap")
    assert set(found) == {"/path/map", "/path/odometry", "/tf", "/odom", "/pose"}
    assert_same_poses(path_of(found, "/path/map"), read_run(copy).online)
    (sentence,) = said
    assert "no views" in sentence
    assert "elsewhere.npz" in sentence
    export_run(copy, tmp_path / "run.tum")
    assert (tmp_path / "run.tum").read_bytes() == (copy / "online.tum").read_bytes()


def test_the_path_of_a_doubted_map_is_the_final_trajectory(copy, tmp_path):
    shutil.copyfile(copy / "odometry.tum", copy / "trajectory.tum")
    export_run(copy, tmp_path / "run.mcap")
    assert_same_poses(path_of(messages(tmp_path / "run.mcap"), "/path/map"), read_run(copy).odometry)
