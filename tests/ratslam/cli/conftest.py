"""A finished run, a copy for each module."""

import pytest

from tests.helpers.square_run import copy_square_run


@pytest.fixture(scope="module")
def square(tmp_path_factory):
    return copy_square_run(tmp_path_factory.mktemp("square") / "run")
