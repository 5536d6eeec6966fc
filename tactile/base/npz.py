"""Reading of .npz files, with errors that name the file."""

from __future__ import annotations

import zipfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TypeVar

import numpy as np

from tactile.base.errors import InputError

T = TypeVar("T")


def read_npz(
    path: str | Path, names: Sequence[str], parse: Callable[..., T], expected: str, cure: str = ""
) -> T:
    """The result of `parse`, called with the named arrays of a file.

    Args:
        parse: raises ValueError for unsuitable arrays. expected: kind of file. cure: for errors.

    Raises:
        InputError: the file is missing, malformed or lacks an array, or `parse` failed.
    """
    try:
        # Opened here because np.load does not close a malformed file.
        with open(path, "rb") as file, np.load(file, allow_pickle=False) as archive:
            return parse(*(archive[name] for name in names))
    except FileNotFoundError:
        raise InputError(str(path), "no such file", expected, cure) from None
    except (OSError, ValueError, TypeError, LookupError, EOFError, zipfile.BadZipFile) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError(str(path), f"another kind of file ({reason})", expected, cure) from error
