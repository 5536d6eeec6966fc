"""Exported files are read back by the tools that they are for."""

from __future__ import annotations

import json

import networkx
import numpy as np
import pytest
import yaml
from rosbags.highlevel import AnyReader

from evaluation.artifacts.grid_files import read_nav2
from evaluation.artifacts.run_reader import read_run
from evaluation.metrics.trajectory import read_tum
from ratslam.service.export_formats import export_run
from tests.helpers.g2o import read_g2o
from tests.ratslam.service.export.export_cases import GRID, assert_same_poses, messages, nanoseconds, pose_of


def test_a_bag_is_read_by_rosbags(square, exported, tmp_path):
    export_run(square, tmp_path / "bag")
    assert sorted(path.name for path in (tmp_path / "bag").iterdir()) == ["bag_0.mcap", "metadata.yaml"]
    assert (tmp_path / "bag" / "bag_0.mcap").read_bytes() == exported.read_bytes()
    theirs = messages(exported)
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
                assert stamp == nanoseconds(message.header.stamp)
                poses.append(pose_of(message.pose.pose))
    assert_same_poses(np.array(poses), read_run(square).online)


def test_rerun_loads_the_file(exported):
    from rerun.chunk import McapReader

    store = McapReader(exported).stream().collect()
    rows = {}
    for chunk in store.stream():
        rows[chunk.entity_path] = rows.get(chunk.entity_path, 0) + chunk.num_rows
    found = messages(exported)
    for topic in ("/odom", "/pose", "/view", "/path/map", "/markers"):
        assert rows.get(topic, 0) >= len(found[topic]), topic
    columns = {str(column) for column in store.schema().component_columns()}
    assert any("/view:DepthImage:buffer" in column for column in columns)  # so it shows pictures in grey
    assert any("/tf:Transform3D:translation" in column for column in columns)


def test_equal_runs_give_equal_bytes(square, exported, tmp_path):
    for suffix in ("mcap", "graphml"):
        export_run(square, tmp_path / f"one.{suffix}")
        export_run(square, tmp_path / f"two.{suffix}")
        assert (tmp_path / f"one.{suffix}").read_bytes() == (tmp_path / f"two.{suffix}").read_bytes()
    assert (tmp_path / "one.mcap").read_bytes() == exported.read_bytes()


def test_a_trajectory_is_read_by_numpy_and_by_us(square, tmp_path):
    export_run(square, tmp_path / "a.tum")
    run = read_run(square)
    assert np.array_equal(
        np.loadtxt(tmp_path / "a.tum")[:, :3], np.column_stack([run.time, run.final[:, :2]])
    )
    assert np.array_equal(read_tum(tmp_path / "a.tum")[1], run.final)


def test_a_pose_graph_is_read_by_us(square, tmp_path):
    export_run(square, tmp_path / "a.g2o")
    poses, edges = read_g2o(tmp_path / "a.g2o")
    text = (square / "map.g2o").read_text()
    assert (len(poses), len(edges.i)) == (text.count("VERTEX_SE2"), text.count("EDGE_SE2"))


def test_a_pose_graph_is_read_by_gtsam(square, tmp_path):
    gtsam = pytest.importorskip("gtsam", reason="of the extra [anchor]")
    export_run(square, tmp_path / "a.g2o")
    _, values = gtsam.readG2o(str(tmp_path / "a.g2o"), False)
    assert values.size() == len(read_g2o(tmp_path / "a.g2o")[0])


def test_experiences_are_read_by_networkx(square, tmp_path):
    export_run(square, tmp_path / "a.json")
    export_run(square, tmp_path / "a.graphml")
    linked = networkx.node_link_graph(json.loads((tmp_path / "a.json").read_text()), edges="edges")
    marked = networkx.read_graphml(tmp_path / "a.graphml", node_type=int)
    assert len(linked) == len(read_run(square).nodes) > 0
    assert dict(linked.nodes(data=True)) == dict(marked.nodes(data=True))
    assert {(a, b): d for a, b, d in linked.edges(data=True)} == {
        (a, b): d for a, b, d in marked.edges(data=True)
    }


def test_a_grid_is_read_as_nav2_reads_it(copy, tmp_path):
    np.savez(copy / "grid.npz", **GRID._asdict())
    export_run(copy, tmp_path / "hall: 1.yaml")
    assert yaml.safe_load((tmp_path / "hall: 1.yaml").read_text())["image"] == "hall: 1.pgm"
    assert read_nav2(tmp_path / "hall: 1.yaml").cell.tolist() == [[0, -1, 100], [0, -1, 100]]
