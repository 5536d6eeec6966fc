"""Commands of the program, run in this process: what they print, how they refuse, and the run of `square`."""

import fcntl
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from ratslam.cli import main

ROOT = Path(__file__).parents[2]
SQUARE = str(ROOT / "configs" / "square.yaml")


def said(capsys: pytest.CaptureFixture[str], *arguments: object, code: int = 0) -> str:
    """What a command prints that ends with this code."""
    capsys.readouterr()
    assert main([*map(str, arguments)]) == code
    return capsys.readouterr().out


def contents(folder: Path, *without: str) -> dict[str, bytes]:
    """The files in a folder and below it, but those of some names."""
    files = [file for file in folder.rglob("*") if file.is_file() and file.name not in without]
    return {str(file.relative_to(folder)): file.read_bytes() for file in files}


def refused(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    """The errors of a command that ends with code 2, each a line without its beginning."""
    capsys.readouterr()
    try:
        code: object = main([*map(str, arguments)])
    except SystemExit as ended:  # of the parser
        code = ended.code
    lines = capsys.readouterr().err.splitlines()
    assert code == 2
    assert not any(line.startswith("Traceback") for line in lines)
    errors = [line.split("error: ", 1)[1] for line in lines if "error: " in line]
    assert errors
    return "\n".join(errors)


def copy_square_run(directory: Path) -> Path:
    """A copy of the finished run of `configs/square.yaml`, which the workers of a test session make once."""
    folder = Path(os.environ["RATSLAM_TEST_FOLDER"])
    made = folder / "square"
    with (folder / "square.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not made.exists():
            partial = folder / "square.partial"
            shutil.rmtree(partial, ignore_errors=True)
            # The name of the directory is the title of its pictures.
            assert main(["run", SQUARE, "-o", str(partial / "run")]) == 0
            partial.rename(made)
    return Path(shutil.copytree(made / "run", directory))


def start(*arguments: object) -> subprocess.Popen[str]:
    """The program in a process group of its own; it heeds the interrupts that background programs ignore."""
    code = (
        "import signal, sys; from ratslam.__main__ import main; "
        "signal.signal(signal.SIGINT, signal.default_int_handler); sys.exit(main(sys.argv[1:]))"
    )
    return subprocess.Popen(
        [sys.executable, "-c", code, *map(str, arguments)], cwd=ROOT, stdout=subprocess.PIPE,
        stderr=subprocess.PIPE, text=True, start_new_session=True,
    )  # fmt: skip
