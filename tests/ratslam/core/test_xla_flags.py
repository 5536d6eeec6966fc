"""The compiler's flags: all are set, and a user's own value stays."""

from __future__ import annotations

import pytest

from ratslam.core.compilation import FLAGS, add_xla_flags


@pytest.mark.parametrize("given", ["", FLAGS[0], " ".join(FLAGS)])
def test_every_flag_is_set_once(given: str) -> None:
    assert sorted(add_xla_flags(given).split()) == sorted(FLAGS)


def test_a_value_of_the_user_stays() -> None:
    own = "--xla_cpu_multi_thread_eigen=true --xla_dump_to=folder"
    assert add_xla_flags(own).split() == [*own.split(), FLAGS[1]]
