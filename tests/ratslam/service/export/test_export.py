"""Exported files hold what the run holds, and are read back by the tools that they are for."""

import csv
import json
import shutil
import sys
from pathlib import Path

import networkx
import numpy as np
import pytest
import yaml
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader

from evaluation.artifacts import run_reader
from evaluation.artifacts.grid_files import read_nav2, write_nav2
from evaluation.artifacts.run_reader import read_closure_table, read_run, write_pieces
from evaluation.metrics.occupancy_grid import OccupancyGrid
from evaluation.metrics.trajectory import align, read_tum, write_tum
from ratslam.service.export_formats import export_run
from tactile.base.errors import InputError
from tactile.base.se2 import compose, wrap
from tests.helpers.commands import ROOT, copy_square_run
from tests.helpers.g2o import read_g2o

FRAMES = [("map", "odom"), ("odom", "base_link")]
GRID = OccupancyGrid(np.array([[0.0, 0.3, 1.0], [0.1, 0.5, 0.7]]), np.array([-1.25, 0.5]), 0.05)


@pytest.fixture(scope="module")
def square(tmp_path_factory):
    """A finished run with closures, views, and a truth that is known at two of three steps."""
    path = copy_square_run(tmp_path_factory.mktemp("square") / "run")
    lines = (path / "truth.tum").read_text().splitlines(keepends=True)
    (path / "truth.tum").write_text("".join(line for k, line in enumerate(lines) if k % 3))
    return path


@pytest.fixture
def copy(square, tmp_path):
    return Path(shutil.copytree(square, tmp_path / "copy"))


def messages(path):
    """Messages of an MCAP file by topic, decoded by mcap-ros2-support: (time in ns, message)."""
    found = {}
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        assert reader.get_header().profile == "ros2"
        for _, channel, message, decoded in reader.iter_decoded_messages():
            found.setdefault(channel.topic, []).append((message.log_time, decoded))
    return found


@pytest.fixture(scope="module")
def exported(square, tmp_path_factory):
    path = tmp_path_factory.mktemp("mcap") / "square.mcap"
    export_run(square, path)
    return path, messages(path)


def pose_of(pose):
    """[3] x, y, heading of a Pose or Transform."""
    is_pose = hasattr(pose, "position")
    place, turn = (pose.position, pose.orientation) if is_pose else (pose.translation, pose.rotation)
    return np.array([place.x, place.y, 2 * np.arctan2(turn.z, turn.w)])


def path_of(found, name):
    return np.array([pose_of(stamped.pose) for stamped in found[name][0][1].poses])


def assert_same_poses(found, expected):
    assert found.shape == expected.shape
    difference = found - expected
    difference[:, 2] = wrap(difference[:, 2])
    assert np.abs(difference).max() < 1e-12


def nanoseconds(header):
    return header.stamp.sec * 10**9 + header.stamp.nanosec


def test_paths_and_poses_are_those_of_the_run(square, exported):
    run, found = read_run(square), exported[1]
    assert_same_poses(path_of(found, "/path/map"), run.final)
    assert_same_poses(path_of(found, "/path/odometry"), run.odometry)
    known = np.isfinite(run.truth).all(axis=1)
    assert 200 < known.sum() < len(known)
    truth = path_of(found, "/path/truth")
    assert_same_poses(compose(align(run.final[known], run.truth[known]), truth), run.truth[known])
    assert_same_poses(np.array([pose_of(m.pose.pose) for _, m in found["/pose"]]), run.online)
    stamps = [round(float(t) * 10**9) for t in run.time]
    assert [time for time, _ in found["/pose"]] == stamps
    assert [nanoseconds(m.header) for _, m in found["/pose"]] == stamps
    steps = csv.DictReader((square / "steps.csv").read_text().splitlines())
    spread = np.array([[float(row[name]) for name in ("sd_x", "sd_y", "sd_heading")] for row in steps])
    assert np.array_equal(np.array([m.pose.covariance for _, m in found["/pose"]])[:, [0, 7, 35]], spread**2)


def test_transforms_and_twists_lead_over_the_odometry_to_the_online_pose(square, exported):
    found, chain = exported[1], []
    for (_, tf), (_, odometry) in zip(found["/tf"], found["/odom"], strict=True):
        outer, inner = tf.transforms
        assert [(t.header.frame_id, t.child_frame_id) for t in (outer, inner)] == FRAMES
        assert (odometry.header.frame_id, odometry.child_frame_id) == FRAMES[1]
        assert np.array_equal(pose_of(inner.transform), pose_of(odometry.pose.pose))
        chain.append(compose(pose_of(outer.transform), pose_of(inner.transform)))
    assert_same_poses(np.array(chain), read_run(square).online)
    odometry = [m for _, m in found["/odom"]]
    pose = np.array([pose_of(m.pose.pose) for m in odometry])
    speeds = [m.twist.twist for m in odometry]
    twist = np.array([[one.linear.x, one.linear.y, one.angular.z] for one in speeds])
    seconds = np.diff([nanoseconds(m.header) for m in odometry]) / 1e9
    assert np.abs(compose(pose[:-1], twist[1:] * seconds[:, None]) - pose[1:])[:, :2].max() < 1e-9


def test_markers_show_the_graph_and_candidates_for_closures_and_views_are_the_recording_s(square, exported):
    ((_, array),) = exported[1]["/markers"]
    run = read_run(square)
    pairs, verdicts, _ = read_closure_table(square)
    assert len(pairs) == len(verdicts) > 100
    expected = {"graph/experiences": len(run.nodes), "graph/links": 2 * len(run.links)}
    expected |= {f"closures/{verdict}": 2 * verdicts.count(verdict) for verdict in set(verdicts)}
    assert {marker.ns: len(marker.points) for marker in array.markers} == expected
    images = [m for _, m in exported[1]["/view"]]
    assert {(m.height, m.width, m.encoding, m.step) for m in images} == {(3, 6, "mono8", 6)}
    recorded = np.load(ROOT / "tests" / "golden" / "a_square3.npz")["in_view"]
    assert np.abs((np.array([list(m.data) for m in images]) / 255) - recorded).max() <= 0.5 / 255 + 1e-9


def test_a_bag_is_read_by_rosbags(square, exported, tmp_path):
    path, theirs = exported
    export_run(square, tmp_path / "bag")
    assert sorted(path.name for path in (tmp_path / "bag").iterdir()) == ["bag_0.mcap", "metadata.yaml"]
    assert (tmp_path / "bag" / "bag_0.mcap").read_bytes() == path.read_bytes()
    with AnyReader([tmp_path / "bag"]) as reader:
        assert {c.topic: c.msgcount for c in reader.connections} == {t: len(m) for t, m in theirs.items()}
        durability = {c.topic: c.ext.offered_qos_profiles[0].durability.name for c in reader.connections}
        assert {t for t, kept in durability.items() if kept == "TRANSIENT_LOCAL"} == {
            "/path/map", "/path/odometry", "/path/truth", "/markers"
        }  # fmt: skip
        poses = []
        for connection, stamp, raw in reader.messages():
            message = reader.deserialize(raw, connection.msgtype)
            if connection.topic == "/pose":
                assert stamp == nanoseconds(message.header)
                poses.append(pose_of(message.pose.pose))
    assert_same_poses(np.array(poses), read_run(square).online)


def test_whisker_images_and_the_grid_are_in_the_file_and_as_nav2_reads_it(copy, tmp_path):
    steps = len(read_run(copy).time)
    pixels = np.random.default_rng(0).integers(0, 256, (steps, 3, 6))
    views = run_reader.WhiskerViews(pixels / 255, np.ones(pixels.shape, bool), np.zeros(6), np.ones(3), 0.1)
    run_reader.write_whisker_views(copy / "views.npz", views)
    write_nav2(copy, GRID)
    export_run(copy, tmp_path / "run.mcap")
    found = messages(tmp_path / "run.mcap")
    assert np.array_equal([list(m.data) for _, m in found["/view"]], pixels.reshape(steps, -1))
    ((_, grid),) = found["/map"]
    assert (grid.info.height, grid.info.width, grid.header.frame_id) == (2, 3, "map")
    assert grid.info.resolution == pytest.approx(0.05)
    assert (grid.info.origin.position.x, grid.info.origin.position.y) == (-1.25, 0.5)
    assert list(grid.data) == [0, -1, 100, 0, -1, 100]
    np.savez(copy / "grid.npz", **GRID._asdict())
    export_run(copy, tmp_path / "hall: 1.yaml")
    assert yaml.safe_load((tmp_path / "hall: 1.yaml").read_text())["image"] == "hall: 1.pgm"
    assert read_nav2(tmp_path / "hall: 1.yaml").cell.tolist() == [[0, -1, 100], [0, -1, 100]]


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
    told = []
    export_run(copy, tmp_path / "run.mcap", told.append)
    found = messages(tmp_path / "run.mcap")
    assert set(found) == {"/path/map", "/path/odometry", "/tf", "/odom", "/pose"}
    assert_same_poses(path_of(found, "/path/map"), read_run(copy).online)
    (sentence,) = told
    assert "no views" in sentence
    assert "elsewhere.npz" in sentence
    export_run(copy, tmp_path / "run.tum")
    assert (tmp_path / "run.tum").read_bytes() == (copy / "online.tum").read_bytes()


def test_pieces_stand_beside_each_other_and_come_with_the_piece_of_each_pose(copy, tmp_path):
    run, told = read_run(copy), []
    later = np.arange(len(run.time)) >= (len(run.time) + 1) // 2
    for name, path in (("trajectory.tum", run.final), ("online.tum", run.online)):
        write_tum(copy / name, run.time, np.where(later[:, None], path + [1000.0, 0.0, 0.0], path))
    (copy / "truth.tum").write_text("")
    write_pieces(copy / "pieces.csv", run.time, later.astype(int))
    export_run(copy, tmp_path / "run.mcap", told.append)
    assert any("several pieces" in one and "beside each other" in one for one in told)
    shown = path_of(messages(tmp_path / "run.mcap"), "/path/map")[:, :2]
    own = run.final[:, :2]
    assert shown[~later, 0].max() < shown[later, 0].min()
    assert np.ptp(shown[:, 0]) < 3 * np.ptp(own[:, 0])
    assert np.allclose(np.diff(shown[later], axis=0), np.diff(own[later], axis=0))
    told.clear()
    export_run(copy, tmp_path / "square.tum", told.append)
    assert (tmp_path / "square.pieces.csv").read_bytes() == (copy / "pieces.csv").read_bytes()
    (sentence,) = told
    assert "cannot be compared" in sentence


def test_a_trajectory_is_read_by_numpy_and_by_us_and_a_pose_graph_too(square, tmp_path):
    for name in ("a.tum", "a.g2o"):
        export_run(square, tmp_path / name)
    run, table = read_run(square), np.loadtxt(tmp_path / "a.tum")
    assert np.array_equal(table[:, :3], np.column_stack([run.time, run.final[:, :2]]))
    assert np.array_equal(read_tum(tmp_path / "a.tum")[1], run.final)
    poses, edges = read_g2o(tmp_path / "a.g2o")
    text = (square / "map.g2o").read_text()
    assert (len(poses), len(edges.i)) == (text.count("VERTEX_SE2"), text.count("EDGE_SE2"))


def test_experiences_are_read_by_networkx_and_equal_runs_give_equal_bytes(square, tmp_path):
    for name in ("a.json", "a.graphml", "b.graphml"):
        export_run(square, tmp_path / name)
    linked = networkx.node_link_graph(json.loads((tmp_path / "a.json").read_text()), edges="edges")
    marked = networkx.read_graphml(tmp_path / "a.graphml", node_type=int)
    assert len(linked) == len(read_run(square).nodes) > 0
    assert dict(linked.nodes(data=True)) == dict(marked.nodes(data=True))
    first, second = ({(a, b): d for a, b, d in graph.edges(data=True)} for graph in (linked, marked))
    assert first == second
    assert (tmp_path / "a.graphml").read_bytes() == (tmp_path / "b.graphml").read_bytes()


def test_times_beyond_ros_stamps_and_a_missing_library_are_refused(copy, tmp_path, monkeypatch):
    lines = (copy / "online.tum").read_text().splitlines(keepends=True)
    for row, time in ((0, "-1.0"), (-1, "2147483648.0")):
        changed = lines.copy()
        changed[row] = " ".join([time, *lines[row].split(" ")[1:]])
        (copy / "online.tum").write_text("".join(changed))
        with pytest.raises(InputError, match="the range of ROS 2 stamps"):
            export_run(copy, tmp_path / "a.mcap")
    monkeypatch.setitem(sys.modules, "rosbags.typesys", None)
    with pytest.raises(InputError, match=r"pip install 'ratslam\[ros\]'"):
        export_run(copy, tmp_path / "a.mcap")
    assert list(tmp_path.iterdir()) == [copy]
