"""Copies of a finished run."""

import pytest

from tests.helpers.commands import copy_square_run


@pytest.fixture(scope="module")
def square(tmp_path_factory):
    return copy_square_run(tmp_path_factory.mktemp("square") / "run")


@pytest.fixture
def run(tmp_path):
    """One that a test may spoil."""
    return copy_square_run(tmp_path / "run")
