"""Commands of the program, run in this process: what they print, and how they refuse."""

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
