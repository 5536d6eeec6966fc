"""Spikes of recorded cells: NWB files that pynwb accepts, and NumPy files."""

from __future__ import annotations

import importlib
import os
import subprocess
import sys

import numpy as np
import pytest

from evaluation.cells.analysis import analyse_cells
from evaluation.cells.recording import write_recording
from ratslam.classic.config import NetworkConfig
from ratslam.cli import main
from ratslam.service.export_formats import EPOCH, export_run, write_nwb
from ratslam.service.spikes import SpikeConfig, cell_poses, draw_spikes, read_spikes, settled_peak
from tactile.base.errors import InputError
from tests.ratslam.service.rats.recordings import drawn_recording

CELLS = [5, 1, 300]
CONFIG = "recording: {file: none.bag}\npose_cells: {cells_xy: 7, cells_heading: 8}\n"


@pytest.fixture(scope="module")
def pynwb():
    """The package, which takes seconds to import."""
    return importlib.import_module("pynwb")


@pytest.fixture
def recording():
    """Three cells, of which the last is silent; the true pose is unknown at one step."""
    made = drawn_recording(0, CELLS)
    made.activity[:, 2] = 0.0
    made.truth[3] = np.nan
    return made


@pytest.fixture
def run(recording, tmp_path):
    """A run directory with what an export of spikes reads."""
    directory = tmp_path / "run"
    directory.mkdir()
    (directory / "config.yaml").write_text(CONFIG)
    write_recording(directory / "cells.npz", recording)
    return directory


def test_the_validator_accepts_the_file_and_it_holds_all(run, recording, tmp_path, pynwb):
    assert main(["export", str(run), "-o", str(tmp_path / "run.nwb"), "--peak-rate", "30"]) == 0
    assert pynwb.validate(path=str(tmp_path / "run.nwb")) == []
    network = NetworkConfig(cells_xy=7, cells_heading=8)
    spikes = draw_spikes(recording, settled_peak(network), SpikeConfig(peak_rate=30))
    assert sum(map(len, spikes.times)) > 100
    with pynwb.NWBHDF5IO(tmp_path / "run.nwb", "r") as source:
        file = source.read()
        assert file.session_start_time == EPOCH
        assert len(file.identifier) == 64
        units = file.units
        for k, times in enumerate(spikes.times):
            np.testing.assert_array_equal(units.get_unit_spike_times(k), times)
            np.testing.assert_array_equal(units.get_unit_obs_intervals(k), [[spikes.start, spikes.stop]])
        np.testing.assert_array_equal(units["cell"][:], CELLS)
        poses = np.stack([units[name][:] for name in ("x", "y", "heading")], axis=1)
        np.testing.assert_array_equal(poses, cell_poses(recording.shape, 0.1, np.array(CELLS)))
        behaviour = file.processing["behavior"]
        position, heading = behaviour["Position"]["position"], behaviour["CompassDirection"]["heading"]
        np.testing.assert_array_equal(position.data, recording.truth[:, :2])
        np.testing.assert_allclose(heading.data, recording.truth[:, 2], atol=1e-12)
        packet = behaviour["PacketPosition"]["packet_position"]
        np.testing.assert_allclose(packet.data, 0.1 * recording.packet[:, :2])
        np.testing.assert_array_equal(packet.timestamps, recording.time)
        angle = behaviour["PacketDirection"]["packet_heading"].data[:]
        np.testing.assert_allclose(np.exp(1j * angle), np.exp(2j * np.pi / 8 * recording.packet[:, 2]))
        np.testing.assert_array_equal(file.acquisition["activity"].data, recording.activity)
        assert len(file.acquisition["injected_energy"].data) == len(recording.time)


@pytest.mark.soak
def test_equal_runs_give_equal_bytes_in_every_process(run, recording, tmp_path):
    for name in ("a.nwb", "a.npz"):
        export_run(run, tmp_path / name)
    code = (
        "import sys\n"
        "from ratslam.__main__ import main\n"
        "for name in sys.argv[2:]:\n"
        "    assert main(['export', sys.argv[1], '-o', name]) == 0\n"
    )
    files = ("b.nwb", "b.npz")
    command = [sys.executable, "-c", code, str(run), *(str(tmp_path / name) for name in files)]
    subprocess.run(command, env=os.environ | {"PYTHONHASHSEED": "7"}, check=True)
    for name in files:
        assert (tmp_path / name).read_bytes() == (tmp_path / name.replace("b", "a", 1)).read_bytes()


def test_numpy_spikes_are_those_of_the_settings(run, recording, tmp_path):
    options = ["--peak-rate", "5", "--spike-seed", "3"]
    assert main(["export", str(run), "-o", str(tmp_path / "spikes.npz"), *options]) == 0
    spikes = read_spikes(tmp_path / "spikes.npz")
    network = NetworkConfig(cells_xy=7, cells_heading=8)
    again = draw_spikes(recording, settled_peak(network), SpikeConfig(peak_rate=5, seed=3))
    for one, other in zip(spikes.times, again.times, strict=True):
        np.testing.assert_array_equal(one, other)


def test_cells_without_any_spike_are_valid(recording, tmp_path, pynwb):
    recording.activity[:] = 0.0
    write_nwb(tmp_path / "silent.nwb", recording, draw_spikes(recording, 1.0), "digest")
    assert pynwb.validate(path=str(tmp_path / "silent.nwb")) == []


@pytest.mark.parametrize("suffix", [".nwb", ".npz"])
def test_a_run_without_cells_names_the_setting(run, tmp_path, suffix, capsys):
    (run / "cells.npz").unlink()
    assert main(["export", str(run), "-o", str(tmp_path / f"run{suffix}")]) == 2
    said = capsys.readouterr().err
    assert "cells.npz: no such file; expected a run with recorded pose cells" in said
    assert "add `cells: {chosen: 64}` to the configuration" in said
    assert not (tmp_path / f"run{suffix}").exists()


def test_a_run_with_sums_alone_names_the_setting(run, recording, tmp_path):
    none = recording._replace(cell=recording.cell[:0], activity=recording.activity[:, :0])
    write_recording(run / "cells.npz", none)
    with pytest.raises(InputError, match=r"no chosen cells.*add `cells: {chosen: 64}`"):
        export_run(run, tmp_path / "run.nwb")


@pytest.mark.parametrize(
    ("option", "value", "words"),
    [("--peak-rate", "0", "must be a number above 0"), ("--peak-rate", "x", "must be a number above 0"),
     ("--spike-seed", "-1", "must be an integer from 0"), ("--spike-seed", "x", "must be an integer from 0")],
)  # fmt: skip
def test_wrong_options_are_refused(run, tmp_path, capsys, option, value, words):
    with pytest.raises(SystemExit, match="2"):
        main(["export", str(run), "-o", str(tmp_path / "run.nwb"), option, value])
    assert words in capsys.readouterr().err


def test_spikes_of_other_cells_are_refused(recording, tmp_path):
    spikes = draw_spikes(drawn_recording(0, [1, 2]), 1.0)
    with pytest.raises(InputError, match="other cells than those of the recording"):
        write_nwb(tmp_path / "run.nwb", recording, spikes, "digest")


def test_a_missing_library_is_named(recording, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pynwb", None)
    with pytest.raises(InputError, match=r"pip install 'ratslam\[nwb\]'"):
        write_nwb(tmp_path / "run.nwb", recording, draw_spikes(recording, 1.0), "digest")
    assert list(tmp_path.iterdir()) == []


def test_scores_are_a_line_for_each_cell_in_hz(run, recording, tmp_path):
    recording.truth[:] = np.random.default_rng(1).random(recording.truth.shape)
    write_recording(run / "cells.npz", recording)
    assert main(["export", str(run), "-o", str(tmp_path / "cells.csv"), "--peak-rate", "30"]) == 0
    table = np.genfromtxt(tmp_path / "cells.csv", delimiter=",", names=True)
    network = NetworkConfig(cells_xy=7, cells_heading=8)
    gain = 30 / settled_peak(network)
    scores = analyse_cells(recording, gain)
    np.testing.assert_array_equal(table["cell"], CELLS)
    np.testing.assert_array_equal(table["mean_rate"], scores.mean_rate)
