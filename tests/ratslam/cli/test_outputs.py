"""Outputs: checked before the work, named in errors as the user gave them, and never in another's place."""

from __future__ import annotations

import os
import resource
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from ratslam.cli import build_parser, main
from ratslam.cli.common import CommandParser, Commands
from ratslam.runs.map_care import map_info
from ratslam.runs.saved_map import read_map
from tests.helpers.square_run import copy_square_run

FILE = Path(__file__).parents[2] / "data" / "maps" / "ratslam-map-1.npz"
LONG = "n" * 250 + ".npz"


def refused(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    capsys.readouterr()
    assert main(list(map(str, arguments))) == 2
    errors = capsys.readouterr().err
    assert errors.count("\n") == 1
    return errors.removeprefix("ratslam: error: ")


@contextmanager
def full_disk() -> Iterator[None]:
    """A limit on the file size makes writes fail as a full disk does; kernels have to be compiled before,
    since they are cached in files."""
    before = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (10, limits[1]))
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        signal.signal(signal.SIGXFSZ, before)


Words = tuple[str, ...]


def programs(commands: Commands, words: Words = ()) -> Iterator[tuple[Words, CommandParser]]:
    """The commands that run, each by its words."""
    for name, parser in commands.parsers.items():
        if parser.commands is None:
            yield (*words, name), parser
        else:
            yield from programs(parser.commands, (*words, name))


PROGRAMS = dict(programs(build_parser().commands))
READ = {"--against", "--continue", "--localise", "--recording", "--relations", "--like"}
"""Options that name a file to be read; all others of a path are outputs."""


def test_every_output_is_called_o() -> None:
    options = {
        action.option_strings[0]
        for parser in PROGRAMS.values()
        for action in parser.arguments
        if action.type is Path and action.option_strings
    }
    assert options - READ == {"-o"}


@pytest.mark.parametrize("words", [key for key, parser in PROGRAMS.items() if " -o" in parser.format_help()])
def test_no_command_writes_over_what_is_there(words: Words, tmp_path: Path, capsys) -> None:
    more: list[object] = []
    for action in PROGRAMS[words].arguments:
        if not action.option_strings or (action.required and "-o" not in action.option_strings):
            more += [*action.option_strings[:1], next(iter(action.choices or "1"))]
    if words == ("map", "crop"):
        more += ["--piece", 0]
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
    for path in there.values():
        if words[0] != "path" or path != there["device"]:  # no picture by its name
            assert refused(capsys, *words, *more, "-o", path).startswith(f"{path}: ")
    assert {path: path.lstat().st_ino for path in there.values()} == before
    assert there["file"].read_text() == (there["folder"] / "a").read_text() == "theirs"
    assert {*tmp_path.iterdir(), there["device"]} == set(before)
    list(map(os.close, terminal))


def test_a_page_and_a_schema_replace_their_like(tmp_path: Path, capsys) -> None:
    run, page, schema = copy_square_run(tmp_path / "run"), tmp_path / "a.html", tmp_path / "a.json"
    for _ in range(2):
        assert main(["report", str(run), "-o", str(page)]) == 0
        assert main(["tools", "schema", "-o", str(schema)]) == 0
    for path in (page, schema):
        path.write_text(f"x{path.read_text()}")
    assert refused(capsys, "report", run, "-o", page).startswith(f"{page}: exists already")
    assert refused(capsys, "tools", "schema", "-o", schema).startswith(f"{schema}: exists already")


def sequence(path: Path) -> int:
    return map_info(read_map(path))["accepted_sequences"][0]["sequence"]


@pytest.mark.parametrize(
    "command",
    [
        ("merge", FILE, FILE),
        ("map", "crop", FILE, "--piece", 0),
        ("map", "undo", FILE, 0),
        ("export", FILE.parent),
    ],
    ids=lambda command: command[0] + str(command[1]) * (command[0] == "map"),
)
def test_an_output_that_cannot_be_made_is_refused_before_the_work(
    command: tuple, tmp_path: Path, capsys, monkeypatch
) -> None:
    for module in ("ratslam.runs.merge", "ratslam.runs.map_care", "ratslam.runs.saved_map"):
        __import__(module)
    monkeypatch.setattr("ratslam.runs.saved_map.read_map", lambda *_: pytest.fail("work"))
    link = tmp_path / "link.npz"
    link.symlink_to("nowhere")
    for output in (link, tmp_path / LONG, tmp_path / "none" / "new.npz"):
        said = refused(capsys, *command, "-o", output)
        assert said.startswith((f"{output}: ", f"{output.parent}: no such folder"))
        assert "complete" not in said
    assert list(tmp_path.iterdir()) == [link]


def test_a_full_disk_names_the_output(tmp_path: Path, capsys) -> None:
    run, number = copy_square_run(tmp_path / "run"), sequence(FILE)
    new = tmp_path / "new"
    new.mkdir()
    for command, name in (
        (("map", "crop", FILE, "--piece", 0), "a.npz"),
        (("map", "undo", FILE, number), "a.npz"),
        (("export", run), "a.g2o"),
        (("export", run), "bag"),
    ):
        assert main([*map(str, command), "-o", str(tmp_path / f"{command[1]}-{name}".replace("/", ""))]) == 0
        with full_disk():
            said = refused(capsys, *command, "-o", new / name)
        assert said == f"{new / name}: File too large; free some space or choose another folder with -o\n"
        assert list(new.iterdir()) == []


def test_a_full_disk_leaves_the_run_whose_map_is_undone(tmp_path: Path, capsys) -> None:
    run = copy_square_run(tmp_path / "run")
    before = {file.name: file.read_bytes() for file in run.iterdir()}
    number = sequence(run)
    assert main(["map", "undo", str(run), str(number), "-o", str(tmp_path / "undone.npz")]) == 0
    with full_disk():
        said = refused(capsys, "map", "undo", run, number)
    assert said.startswith(f"{run / 'map.npz'}: File too large; ")
    assert {file.name: file.read_bytes() for file in run.iterdir()} == before


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
    assert main(["map", "undo", str(link), str(number)]) == 0
    assert link.is_symlink()
    assert path.read_bytes() != before
    assert path.stat().st_mode & 0o777 == 0o640


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full")
def test_an_output_that_takes_no_text_is_one_error() -> None:
    with open("/dev/full", "w") as full:
        found = subprocess.run(
            [sys.executable, "-m", "ratslam", "map", "info", str(FILE)],
            stdout=full, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
    assert found.returncode == 2
    assert found.stderr.startswith("ratslam: error: the output: No space left on device; ")
    assert found.stderr.count("\n") == 1
