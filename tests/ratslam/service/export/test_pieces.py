"""Maps in several pieces are exported."""

from __future__ import annotations

import numpy as np

from evaluation.artifacts.run_reader import read_run, write_pieces
from evaluation.metrics.trajectory import write_tum
from ratslam.service.export_formats import export_run
from tests.ratslam.service.export.export_cases import messages, path_of


def test_pieces_stand_beside_each_other(copy, tmp_path):
    run = read_run(copy)
    later = np.arange(len(run.time)) >= (len(run.time) + 1) // 2
    for name, path in (("trajectory.tum", run.final), ("online.tum", run.online)):
        write_tum(copy / name, run.time, np.where(later[:, None], path + [1000.0, 0.0, 0.0], path))
    (copy / "truth.tum").write_text("")
    write_pieces(copy / "pieces.csv", run.time, later.astype(int))
    said = []
    export_run(copy, tmp_path / "run.mcap", said.append)
    (sentence,) = (one for one in said if "several pieces" in one)
    assert "beside each other" in sentence
    shown = np.array(path_of(messages(tmp_path / "run.mcap"), "/path/map"))[:, :2]
    own = run.final[:, :2]
    assert shown[~later, 0].max() < shown[later, 0].min()
    assert np.ptp(shown[:, 0]) < 3 * np.ptp(own[:, 0])
    assert np.allclose(np.diff(shown[later], axis=0), np.diff(own[later], axis=0))


def test_a_trajectory_in_pieces_comes_with_the_piece_of_each_pose(copy, tmp_path):
    time = read_run(copy).time
    write_pieces(copy / "pieces.csv", time, (np.arange(len(time)) > 5).astype(int))
    said = []
    export_run(copy, tmp_path / "square.tum", said.append)
    assert (tmp_path / "square.pieces.csv").read_bytes() == (copy / "pieces.csv").read_bytes()
    assert len(said) == 1
    assert "cannot be compared" in said[0]
