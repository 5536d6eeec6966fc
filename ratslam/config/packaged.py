"""Configurations and the citation that come with the program, in a checkout and in an installed wheel."""

from __future__ import annotations

import os
import re
from difflib import get_close_matches
from pathlib import Path

from tactile.base.errors import InputError

_PACKAGE = Path(__file__).resolve().parents[1]
FOLDERS = (_PACKAGE / "packaged" / "configs", _PACKAGE.parent / "configs")
"""Where they are: in a wheel (`setup.py` puts them there), in a checkout."""


def packaged_configs() -> dict[str, str]:
    """Name and one line of each packaged configuration, by name.

    The line is the first comment of the file, and the environment variables that must be set for it.
    """
    return {path.stem: _line(path.read_text(encoding="utf-8")) for path in _files()}


def find_config(text: str | os.PathLike[str], folder: Path = Path()) -> Path:
    """The file of a configuration, given by its path or by the name of a packaged one.

    Args:
        text: the path or the name; a file of that path comes before a packaged configuration of that name.
        folder: start of a relative path.

    Raises:
        InputError: there is neither, with a similar name and all names.
    """
    name = os.fspath(text)
    path, files = folder / name, {file.stem: file for file in _files()}
    if os.path.exists(path) and not (name in files and os.path.isdir(path)):
        return path
    if name in files:
        return files[name]
    close = get_close_matches(Path(name).stem.lower(), files, n=1)
    cure = f"did you mean {close[0]!r}?" if close else ""
    raise InputError(str(path), "no such file or packaged configuration", f"one of {', '.join(files)}", cure)


def read_citation() -> str:
    """The content of CITATION.cff: how to cite the program."""
    places = [folder.parent / "CITATION.cff" for folder in FOLDERS]
    return next(path for path in places if path.exists()).read_text(encoding="utf-8")


def _files() -> list[Path]:
    folder = next((folder for folder in FOLDERS if folder.is_dir()), FOLDERS[0])
    return sorted(folder.glob("*.yaml"))


def _line(text: str) -> str:
    line = text.partition("\n")[0].removeprefix("#").strip()
    variables = sorted(set(re.findall(r"\$\{(\w+)\}", text)))
    return f"{line} Needs {' and '.join(variables)}." if variables else line
