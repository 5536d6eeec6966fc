"""What ends a command with code 2: a wrong path, argument, configuration or recording, which its error names;
an output that is there already, or a disk that is full."""

import os
import resource
import shlex
import shutil
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest

from evaluation.report import page
from ratslam.cli import build_parser
from ratslam.cli.common import CommandParser, Commands
from ratslam.runs.map_care import map_info
from ratslam.runs.saved_map import read_map
from tests.helpers.commands import ROOT, SQUARE, contents, copy_square_run, refused, said

FILE = ROOT / "tests" / "data" / "maps" / "ratslam-map-1.npz"
Words = tuple[str, ...]


def programs(commands: Commands, words: Words = ()) -> Iterator[tuple[Words, CommandParser]]:
    for name, parser in commands.parsers.items():
        if parser.commands is None:
            yield (*words, name), parser
        else:
            yield from programs(parser.commands, (*words, name))


PROGRAMS = dict(programs(build_parser().commands))


def more_arguments(words: Words, value: str = "1") -> list[str]:
    """All arguments that a command needs beside `-o`; a path and a text is this value."""
    more = []
    for action in PROGRAMS[words].arguments:
        if not action.option_strings or (action.required and "-o" not in action.option_strings):
            given = value if action.type is Path else "1"
            more += [*action.option_strings[:1], str(next(iter(action.choices or [given])))]
    return more + ["--piece", "0"] * (words == ("map", "crop"))


@contextmanager
def full_disk(size: int = 10) -> Iterator[None]:
    """A limit on the file size makes writes fail as a full disk does; kernels have to be compiled before,
    since they are cached in files."""
    before, limits = signal.signal(signal.SIGXFSZ, signal.SIG_IGN), resource.getrlimit(resource.RLIMIT_FSIZE)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, limits[1]))
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        signal.signal(signal.SIGXFSZ, before)


@pytest.mark.parametrize(
    "words", [key for key, parser in PROGRAMS.items() if " -o" in parser.format_help()], ids=" ".join
)
def test_no_command_writes_over_what_is_there(words: Words, tmp_path: Path, capsys) -> None:
    """The output is checked first: the inputs are not there either."""
    there = {name: tmp_path / f"{name}.png" for name in ("file", "link", "dangling", "fifo", "folder")}
    there["file"].write_text("theirs")
    there["folder"].mkdir()
    (there["folder"] / "a").write_text("theirs")
    there["link"].symlink_to("file.png")
    there["dangling"].symlink_to("nowhere.png")
    os.mkfifo(there["fifo"])
    terminal = os.openpty()
    there["device"] = Path(os.ttyname(terminal[1]))
    before = {path: path.lstat().st_ino for path in there.values()}
    for path in (*there.values(), tmp_path / f"{'n' * 250}.png"):
        if words[0] != "path" or path != there["device"]:  # no picture by its name
            assert refused(capsys, *words, *more_arguments(words), "-o", path).startswith(f"{path}: ")
    assert {path: path.lstat().st_ino for path in there.values()} == before
    assert there["file"].read_text() == (there["folder"] / "a").read_text() == "theirs"
    assert {*tmp_path.iterdir(), there["device"]} == set(before)
    list(map(os.close, terminal))


def test_a_page_and_a_schema_replace_their_like(run: Path, tmp_path: Path, capsys) -> None:
    made, schema, again = tmp_path / "a.html", tmp_path / "a.json", tmp_path / "again.html"
    (tmp_path / "empty").mkdir()
    for _ in range(2):
        said(capsys, "report", run, run, "-o", made)
        said(capsys, "tools", "schema", "-o", schema)
    said(capsys, "report", run, run, "-o", again)
    assert again.read_bytes() == made.read_bytes()
    assert "no run in this folder" in refused(capsys, "report", run, tmp_path / "empty", "-o", made)
    assert again.read_bytes() == made.read_bytes()
    for path in (made, schema):
        path.write_text(f"x{path.read_text()}")
    assert refused(capsys, "report", run, "-o", made).startswith(f"{made}: exists already")
    assert refused(capsys, "tools", "schema", "-o", schema).startswith(f"{schema}: exists already")


def test_a_report_without_its_libraries_begins_nothing(tmp_path: Path, monkeypatch, capsys) -> None:
    monkeypatch.setattr(page, "find_spec", lambda name: None if name == "plotly" else find_spec(name))
    for command in (["report", tmp_path, "-o", tmp_path / "a.html"],
                    ["run", SQUARE, "-o", tmp_path / "run", "--report"]):  # fmt: skip
        error = refused(capsys, *command)
        assert "plotly not installed" in error
        assert "pip install 'ratslam[report]'" in error
    assert list(tmp_path.iterdir()) == []


def sequence(path: Path) -> int:
    return map_info(read_map(path))["accepted_sequences"][0]["sequence"]


def test_a_full_disk_names_the_output_and_leaves_a_run(run: Path, tmp_path: Path, capsys) -> None:
    (new := tmp_path / "new").mkdir()
    for command, name in (
        (("map", "crop", FILE, "--piece", 0), "crop.npz"),
        (("map", "undo", FILE, sequence(FILE)), "undo.npz"),
        (("export", run), "a.g2o"),
        (("export", run), "bag"),
    ):
        said(capsys, *command, "-o", tmp_path / name)
        with full_disk():
            error = refused(capsys, *command, "-o", new / name)
        assert error == f"{new / name}: File too large; free some space or choose another folder with -o"
        assert list(new.iterdir()) == []
    before, number = contents(run), sequence(run)
    said(capsys, "map", "undo", run, number, "-o", tmp_path / "undone.npz")
    with full_disk():
        assert refused(capsys, "map", "undo", run, number).startswith(f"{run / 'map.npz'}: File too large; ")
    assert contents(run) == before
    with full_disk(20_000):
        assert "File too large; free some space" in refused(capsys, "run", SQUARE, "-o", new / "run")
    said(capsys, "score", new / "run")
    assert '"running"' in (new / "run" / "manifest.json").read_text()


def test_an_output_that_appears_during_the_work_stays(tmp_path: Path, capsys, monkeypatch) -> None:
    output = tmp_path / "new.npz"
    from ratslam.runs import map_care

    write_map = map_care.write_map

    def write(*arguments: Any, **named: Any) -> None:
        write_map(*arguments, **named)
        output.write_text("theirs")

    monkeypatch.setattr(map_care, "write_map", write)
    for command in (("crop", FILE, "--piece", 0), ("undo", FILE, sequence(FILE))):
        assert "meanwhile" in refused(capsys, "map", *command, "-o", output)
        assert output.read_text() == "theirs"
        output.unlink()


def test_undo_does_not_replace_a_read_only_map_and_follows_a_link(tmp_path: Path, capsys) -> None:
    path, link, run = tmp_path / "map.npz", tmp_path / "link.npz", tmp_path / "run"
    shutil.copy(FILE, path)
    link.symlink_to(path.name)
    path.chmod(0o444)
    number, before = sequence(path), path.read_bytes()
    assert refused(capsys, "map", "undo", path, number).startswith(f"{path}: read-only; ")
    assert path.read_bytes() == before
    path.chmod(0o640)
    run.mkdir()
    (run / "map.npz").symlink_to(path)
    assert f"a link to {path}" in refused(capsys, "map", "undo", run, number)
    said(capsys, "map", "undo", link, number)
    assert link.is_symlink()
    assert path.read_bytes() != before
    assert path.stat().st_mode & 0o777 == 0o640


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full")
def test_an_output_that_takes_no_text_is_one_error() -> None:
    command = [sys.executable, "-m", "ratslam", "tools", "version"]
    with open("/dev/full", "w") as full:
        found = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True)
    assert found.returncode == 2
    assert found.stderr.startswith("ratslam: error: the output: No space left on device; ")
    assert found.stderr.count("\n") == 1


FILES = {
    "taken": "mine", "taken.rrd": "mine", "taken.mcap": "mine", "empty/.keep": "",
    "begun/manifest.json": "{}", "log.csv": "t,id\n0,1\n", "empty.mcap": "",
    "lab_truth.csv": "t,x,y,heading\n0,0,0,0\n1,1,0,0\n",
    **dict.fromkeys(("notes.txt", "drive.csv"), "t,distance,turn\n0,0,0\n1,1,0\n"),
    "two_errors.yaml": "pose_cells: {}\nplaces: {radius: 0}\n",
    "whisker_reach.yaml": "source: {plugin: whisker_reach, settings: {file: log.csv}}\n",
    "blank.yaml": "source: {plugin: whisker_stage, settings: {file: empty.mcap}}\n",
}  # fmt: skip
REFUSED = {
    "path MAP --to inf,0": "--to: 'inf,0' X,Y",
    "path MAP --from 0,nan --to 1": "--from: '0,nan' X,Y",
    "path MAP --to 1,2,3": "--to: '1,2,3' X,Y",
    "path MAP --to 1 -o way.txt": "way.txt .png",
    "path MAP --to --json": "--to",
    "score empty": "online.tum",
    "score log.csv": "log.csv",
    "score log.csv --base -1": "--base: -1",
    "watch taken": "taken: no",
    "watch run --every 0": "--every",
    "watch run --patience inf": "--patience",
    "map info empty": "no such file",
    "map crop MAP --steps 9000: -o part.npz": "no keyframe remains",
    "map crop MAP --piece 7 -o part.npz": "no keyframe remains",
    "map crop MAP --steps 1,2 -o part.npz": "--steps A:B",
    "map crop MAP --steps 1:-2 -o part.npz": "--steps A:B",
    "map crop MAP --box 1,2,3 -o part.npz": "--box four",
    "map crop MAP --box 0,1,1,1 -o part.npz": "--box Y0 < Y1",
    "map crop MAP --box 1,0,1,1 -o part.npz": "--box X0 < X1",
    "run two_errors.yaml": "recording places.radius",
    "run SQUARE --set simulation.seed=3": "recording seed",
    "run SQUARE --set recording.file=empty.mcap": "empty.mcap: is empty",
    "run SQUARE --set backend=localise": "localise.map: missing",
    "run SQUARE -o taken/run": "taken: not a folder",
    "run SQUARE --continue run/steps.csv": "run/steps.csv: not a map",
    "run SQUARE --continue run/map.npz": "already",
    **{f"run SQUARE --rerun {target}": "--rerun loopback"
       for target in ("192.168.1.5:9876", "0.0.0.0:9876", "square", "127.0.0.1:0", "127.0.0.1:65536")},
    "run SQUARE --rerun 127.0.0.1:1": "no viewer rerun --bind 127.0.0.1",
    "run SQUARE --rerun missing/view.rrd": "missing: no such folder",
    "run SQUARE --rerun taken.rrd": "taken.rrd: exists",
    "simulate SQUARE -o a.mcap": "simulation: missing",
    "live SQUARE": "live: missing",
    "doctor notes.txt": "no reader for '.txt'",
    "doctor drive.csv --set seed=1": "--set",
    "doctor SQUARE": "doctor --live",
    "doctor begun": "the manifest of a run",
    "fit drive.csv -o absent/rig.yaml": "absent: no such folder",
    "fit drive.csv --seed -1": "--seed: -1",
    "fit lab_truth.csv": "doctor lab_truth.csv",
    "fit empty.mcap": "empty.mcap: is empty",
    "fit whisker_reach.yaml": "log.csv",
    "fit blank.yaml": "empty.mcap",
    "tools recover LICENSE -o x.mcap": "LICENSE",
    "report run empty -o page.html": "empty: no run",
    "report run -o missing/page.html": "missing: no such folder",
    "report run begun -o page.html": "begun no such file",
    "export run -o a.bag": "suffix '.bag'",
    "export run -o a.yaml": "occupancy grid",
    "export run -o taken.mcap": "taken.mcap: exists",
    "export run -o a.npz": "cells.npz: no such file cells: {chosen: 64}",
    "export empty -o a.mcap": "online.tum: no such file",
    "export run -o a.npz --peak-rate 0": "--peak-rate above 0",
    "export run -o a.npz --peak-rate inf": "--peak-rate above 0",
    "export run -o a.npz --spike-seed -1": "--spike-seed from 0",
    "check source file --samples 0": "--samples positive",
    "emulate create live_maze": "live: that of an arm `live_create`",
    "emulate head live_create": "live: that of a Create `live_maze`",
    "emulate create live_create --set live.create.touch=light": "touch: light create1 `model: create2`",
    "emulate head live_poke": "live.arm.touch: force head ur10",
    "localise empty SQUARE": "map.npz: no such file",
    "runn": "'runn'",
}  # fmt: skip


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("refused")
    for name, text in FILES.items():
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_text(text)
    copy_square_run(folder / "run")
    return folder


@pytest.mark.parametrize(("command", "words"), REFUSED.items(), ids=REFUSED)
def test_a_refused_command_names_the_fault_and_writes_nothing(command, words, folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    before, places = contents(folder), {"MAP": FILE, "SQUARE": SQUARE, "LICENSE": ROOT / "LICENSE"}
    error = refused(capsys, *(places.get(word, word) for word in shlex.split(command)))
    assert [word for word in words.split() if word not in error] == [], error
    assert contents(folder) == before


def reads_a_path(parser: CommandParser) -> bool:
    return any(one.type is Path and not one.option_strings for one in parser.arguments)


@pytest.mark.parametrize("words", [key for key, one in PROGRAMS.items() if reads_a_path(one)], ids=" ".join)
def test_a_path_that_is_not_there_is_an_error_of_every_command(words, tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    new = "new.png" if words in {("path",), ("cells", "compare")} else "new.npz"
    output = ["-o", new] if " -o" in PROGRAMS[words].format_help() else []
    assert "none.npz" in refused(capsys, *words, *more_arguments(words, "none.npz"), *output)
    assert list(tmp_path.iterdir()) == []


MADE = {
    "a.csv": b"t,x\n", "a.mcap": b"", "clip.mp4": b"", "bare": b"\x89MCAP0\r\n", "old.bag": b"",
    "db": b"SQLite format 3\0", "bag/metadata.yaml": b"rosbag2_bagfile_information:\n", "bag/a.db3": b"",
    "page.html": b"<!doctype html>\n", "run/manifest.json": b"{}", "both/map.npz": b"", "none/a": b"",
}  # fmt: skip
NO_CONFIG = {
    **dict.fromkeys([*list(MADE)[:6], "bag", "trace.npz"], "a recording"),
    "bag/metadata.yaml": "the description of a bag", "page.html": "a page (HTML)",
    "run": "a run directory", "both": "a map", "map.npz": "a map", "none": "a folder",
    "fifo": "a FIFO or a device", "/dev/zero": "a FIFO or a device",
}  # fmt: skip
CURES = {"run": "`doctor ", "both": "`map info ", "map.npz": "`map info ", "trace.npz": "ratslam doctor "}


@pytest.mark.parametrize("command", ["run", "live", "study"])
def test_what_is_no_configuration_is_named_with_what_reads_it(command: str, tmp_path: Path, capsys) -> None:
    for file, content in MADE.items():
        (tmp_path / file).parent.mkdir(exist_ok=True)
        (tmp_path / file).write_bytes(content)
    os.mkfifo(tmp_path / "fifo")
    shutil.copy(FILE, tmp_path / "map.npz")
    shutil.copy(ROOT / "tests" / "golden" / "a_square3.npz", tmp_path / "trace.npz")
    for name, what in NO_CONFIG.items():
        error = refused(capsys, command, tmp_path / name)
        assert error.startswith(f"{tmp_path / name}: {what}; ")
        assert CURES.get(name, "a configuration") in error


def test_an_emulator_listens_on_loopback_and_where_nothing_does(tmp_path, loopback, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for device, config in (("ur10", "live_maze"), ("head", "live_maze"), ("create", "live_create")):
        for host in ("0.0.0.0", "192.0.2.1"):
            command = ["emulate", device, config, "--host", host]
            error = refused(capsys, *command)
            assert f"'{host}': an address that others may reach" in error
            assert "--open-to-network" in error
        error = refused(capsys, *command, "--open-to-network")
        assert "192.0.2.1:30" in error
        assert "cannot listen" in error
    for device, port in (("ur10", 30004), ("head", 30100)):
        with socket.create_server((loopback, port)):
            error = refused(capsys, "emulate", device, "live_maze", "--host", loopback)
            assert f"{loopback}:{port}: something listens there already" in error


def test_names_and_contents_are_printed_without_control_characters(tmp_path: Path, capsys) -> None:
    name = tmp_path / "a\x1b[31m\x85\u202eb\udcff.yaml"
    name.write_text('recording: {file: "\\e]0;x\\a"}\n')
    (tmp_path / "scores.csv").write_bytes(b"t,id,x,y,theta\n" + bytes(4000) + b"\n")
    for arguments in (["run", name], ["score", tmp_path / "scores.csv"], ["score", f"{name}x"]):
        error = refused(capsys, *arguments)
        assert error.isprintable()
        assert len(error) < 1000
