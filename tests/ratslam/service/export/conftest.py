"""A finished run, its copy for a test, and its MCAP file."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from ratslam.cli import main
from tests.helpers.square_run import copy_square_run


@pytest.fixture(scope="module")
def square(tmp_path_factory):
    """A finished run with closures, views, and a truth that is known at two of three steps."""
    path = copy_square_run(tmp_path_factory.mktemp("square") / "run")
    lines = (path / "truth.tum").read_text().splitlines(keepends=True)
    (path / "truth.tum").write_text("".join(line for k, line in enumerate(lines) if k % 3))
    return path


@pytest.fixture
def copy(square, tmp_path):
    return Path(shutil.copytree(square, tmp_path / "copy"))


@pytest.fixture(scope="module")
def exported(square, tmp_path_factory):
    """The run as an MCAP file."""
    path = tmp_path_factory.mktemp("mcap") / "square.mcap"
    assert main(["export", str(square), "-o", str(path)]) == 0
    return path
