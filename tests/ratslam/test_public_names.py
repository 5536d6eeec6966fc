"""The public names: they exist, are typed, are listed, and nothing else is."""

import re
from pathlib import Path

import pytest

import ratslam

USES = Path(__file__).parent / "public_names.py"


def test_every_name_exists() -> None:
    for name in ratslam.__all__:
        found = getattr(ratslam, name)
        assert getattr(found, "__name__", name) == name
        assert found.__doc__
    assert dir(ratslam) == sorted(ratslam.__all__)
    assert len(repr(dir(ratslam))) <= 24 * 80  # a terminal


def test_other_names_do_not_exist() -> None:
    with pytest.raises(AttributeError, match="no attribute 'Pose'"):
        ratslam.Pose  # noqa: B018


def test_the_type_check_uses_every_name() -> None:
    used = set(
        re.findall(r"ratslam\.(\w+)", USES.read_text(encoding="utf-8").split("def use_names_wrongly")[0])
    )
    assert used == set(ratslam.__all__)
