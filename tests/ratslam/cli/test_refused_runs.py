"""The command run refuses configurations, recordings, directories and checkpoints."""

from __future__ import annotations

import os
import shutil
import socket

import numpy as np
import pytest

from ratslam.cli import main
from tests.ratslam.cli.run_cases import ROOT, SQUARE, refuses


@pytest.mark.parametrize(
    ("text", "messages"),
    [
        ("", ["config.yaml"]),
        (
            "recording: {file: a.npz}\nattractor: {excite_sigm: 1}\n",
            ["did you mean 'excite_sigma'", "config.yaml:2:"],
        ),
        ("recording: {file: a.npz}\nattractor: {excite_sigma: -1}\n", ["attractor.excite_sigma"]),
        ("recording: {file: a.npz}\nattractor: {excite_width: 6}\n", ["odd"]),
        ("recording: {file: a.npz}\ntemplates: {threshold: high}\n", ["templates.threshold"]),
        ("recording: {file: a.npz}\nrecording: {file: b.npz}\n", ["recording"]),
        ("recording: {file: missing.npz}\n", ["missing.npz"]),
        ("recording: {file: '${RATSLAM_NOT_SET}/a.npz'}\n", ["RATSLAM_NOT_SET"]),
        ("recording: {file: a.npz\n", [":"]),
        ("pose_cells: {}\nplaces: {radius: 0}\n", ["recording", "places.radius"]),
        (
            "touch: {}\n",
            ["neither recording, simulation, create_simulation, rat_simulation, source nor live"],
        ),
        ("recording: {file: a.npz}\nsimulation: {}\n", ["recording and simulation; give one"]),
        ("simulation: {sed: 1}\n", ["did you mean 'seed'"]),
        ("simulation: {path: {circuits: CA, explore: 3}}\n", ["circuits and explore", "exactly one"]),
        ("simulation: {maze: {file: none.txt}}\n", ["none.txt"]),
        ("simulation: {whisking: {amplitude_deg: 75}}\n", ["simulation.whisking.amplitude_deg"]),
        ("simulation: {}\ntouch: {head: {dead: [18]}}\n", ["touch.head", "0 to 17"]),
        ("simulation: {maze: {loop: 7}}\n", ["simulation.maze.loop"]),
    ],
)
def test_a_faulty_config_is_refused(capsys, tmp_path, text, messages):
    config = tmp_path / "config.yaml"
    config.write_text(text)
    refuses(capsys, ["run", config, "-o", tmp_path / "run"], *messages)
    assert not (tmp_path / "run").exists()


MADE = {
    "a.csv": b"t,x\n", "a.mcap": b"", "clip.mp4": b"", "bare": b"\x89MCAP0\r\n", "old.bag": b"",
    "db": b"SQLite format 3\0", "bag/metadata.yaml": b"rosbag2_bagfile_information:\n", "bag/a.db3": b"",
    "page.html": b"<!doctype html>\n", "run/manifest.json": b"{}", "both/map.npz": b"", "none/a": b"",
}  # fmt: skip


@pytest.mark.parametrize(
    ("name", "message"),
    [
        *((name, "a recording; expected a configuration") for name in [*list(MADE)[:6], "bag"]),
        ("bag/metadata.yaml", "the description of a bag; expected a configuration"),
        ("page.html", "a page (HTML); "),
        ("run", "a run directory; expected a configuration (YAML); `doctor "),
        ("both", "a map; expected a configuration (YAML); `map info "),
        ("none", "a folder; expected a configuration"),
        ("fifo", "a FIFO or a device; "),
        ("/dev/zero", "a FIFO or a device; "),
        ("map.npz", "a map; expected a configuration (YAML); `map info "),
        ("trace.npz", "a recording; expected a configuration (YAML); `python -m ratslam doctor "),
    ],
)
@pytest.mark.parametrize("command", ["run", "live", "study"])
def test_what_is_no_configuration_is_named_with_what_reads_it(capsys, tmp_path, command, name, message):
    for file, content in MADE.items():
        (tmp_path / file).parent.mkdir(exist_ok=True)
        (tmp_path / file).write_bytes(content)
    os.mkfifo(tmp_path / "fifo")
    shutil.copy(ROOT / "tests" / "data" / "maps" / "ratslam-map-1.npz", tmp_path / "map.npz")
    shutil.copy(ROOT / "tests" / "golden" / "a_square3.npz", tmp_path / "trace.npz")
    refuses(capsys, [command, tmp_path / name], f"error: {tmp_path / name}: {message}")


def test_an_emulator_listens_on_loopback_and_where_nothing_does(capsys, tmp_path, loopback, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for device, config in (("ur10", "live_maze"), ("head", "live_maze"), ("create", "live_create")):
        for host in ("0.0.0.0", "192.0.2.1"):
            command = ["emulate", device, config, "--host", host]
            refuses(capsys, command, f"'{host}': an address that others may reach", "--open-to-network")
        refuses(capsys, [*command, "--open-to-network"], "192.0.2.1:30", "cannot listen")
    for device, port in (("ur10", 30004), ("head", 30100)):
        with socket.create_server((loopback, port)):
            words = f"{loopback}:{port}: something listens there already"
            refuses(capsys, ["emulate", device, "live_maze", "--host", loopback], words)


def test_a_seed_of_a_simulation_is_not_for_a_recording(capsys):
    refuses(
        capsys, ["run", SQUARE, "--set", "simulation.seed=3"], "this configuration has recording", "a seed"
    )


def test_names_and_contents_are_printed_without_control_characters(capsys, tmp_path):
    name = tmp_path / "a\x1b[31m\x85\u202eb\udcff.yaml"
    name.write_text('recording: {file: "\\e]0;x\\a"}\n')
    (tmp_path / "scores.csv").write_bytes(b"t,id,x,y,theta\n" + bytes(4000) + b"\n")
    for arguments in (["run", name], ["score", tmp_path / "scores.csv"], ["score", f"{name}x"]):
        capsys.readouterr()
        assert main([str(argument) for argument in arguments]) == 2
        said = capsys.readouterr().err
        assert said.replace("\n", "").isprintable()
        assert said.count("\n") == said.count("ratslam: error: ") == 1
        assert len(said) < 1000


def changed(tmp_path, **changes):
    """A golden stream with some arrays changed."""
    with np.load(ROOT / "tests" / "golden" / "a_square3.npz") as archive:
        arrays = dict(archive)
    for name, change in changes.items():
        arrays[name] = change(arrays[name].copy())
    np.savez(tmp_path / "changed.npz", **arrays)
    return tmp_path / "changed.npz"


def put(row, value):
    def change(array):
        array[row] = value
        return array

    return change


@pytest.mark.parametrize(
    ("changes", "messages"),
    [
        ({"in_w": lambda w: w * 180 / np.pi}, "deg"),
        ({"in_v": lambda v: v * 1000}, "m"),
        ({"in_v": put(7, np.nan)}, "row 7"),
        ({"in_t": put(9, 0.0)}, "row 9"),
        ({"in_view": lambda view: view * 255}, "0..1"),
        ({"in_view": lambda view: view[:, :5]}, "in_view"),
    ],
    ids=["degrees", "millimetres", "nan", "backwards", "bytes", "shape"],
)
def test_a_faulty_recording_is_refused(capsys, tmp_path, changes, messages):
    file = changed(tmp_path, **changes)
    refuses(capsys, ["run", SQUARE, "-o", tmp_path / "run", "--set", f"recording.file={file}"], messages)
    assert not (tmp_path / "run").exists()


def test_cut_and_empty_recordings_are_refused(capsys, tmp_path):
    whole = (ROOT / "tests" / "golden" / "a_square3.npz").read_bytes()
    for name, content in (("cut.npz", whole[:5000]), ("empty.npz", b""), ("noise.mcap", b"noise" * 99)):
        (tmp_path / name).write_bytes(content)
        file = f"recording.file={tmp_path / name}"
        refuses(capsys, ["run", SQUARE, "-o", tmp_path / "run", "--set", file], name)


def test_wrong_checkpoints_are_refused(capsys, square, tmp_path):
    again = ["run", SQUARE, "-o", tmp_path / "run", "--continue"]
    refuses(capsys, [*again, square / "map.npz"], "already")
    refuses(capsys, [*again, square / "steps.csv"], "not a map")
    refuses(capsys, [*again, tmp_path / "none.npz"], "none.npz")
    refuses(
        capsys, [*again, square / "map.npz", "--set", "pose_cells.cells_heading=40"],
        "map.npz: made with other settings: pose_cells.cells_heading is 40 and was 36 when the map was made;",
        "; expected a map made with this configuration; `--set pose_cells.cells_heading=36` takes those of",
    )  # fmt: skip
    assert not (tmp_path / "run").exists()


def test_a_folder_that_cannot_be_made_is_refused(capsys, tmp_path):
    (tmp_path / "file").write_text("in the way")
    refuses(capsys, ["run", SQUARE, "-o", tmp_path / "file" / "run"], f"{tmp_path}/file: not a folder")
