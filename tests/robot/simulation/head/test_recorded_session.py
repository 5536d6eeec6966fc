"""Simulated sessions that were recorded or loaded into memory equal the sessions."""

from __future__ import annotations

from collections.abc import Callable
from itertools import product
from pathlib import Path

import pytest

from robot.recordings.mcap_reader import Recording
from robot.recordings.mcap_writer import record_source
from robot.sources.in_memory import load_into_memory
from robot.touch_source import head_config_of, open_touch_source
from tactile.base.errors import InputError
from tactile.base.types import Observation
from tactile.frontend import TouchConfig
from tactile.whisker_geometry import HeadConfig
from tactile.whisker_image import ImageConfig
from tests.robot.simulation.head.session_cases import bits, simulate


@pytest.mark.parametrize(("radial", "raw"), list(product([False, True], repeat=2)))
def test_a_recorded_session_equals_the_session(radial: bool, raw: bool, tmp_path: Path) -> None:
    head = HeadConfig(dead=(2,), rest_deg=70.0)
    session = simulate(head, raw=raw, path={"explore": 6.0 if raw else 60.0})
    record_source(session, tmp_path / "a.mcap")
    again = Recording(tmp_path / "a.mcap")
    assert bits(again) == bits(session)
    assert again.info == session.info
    assert again.info.raw_whiskers
    assert head_config_of(again.info, HeadConfig()) == head
    assert head_config_of(again.info, HeadConfig(dead=(4,))) == head.model_copy(update={"dead": (4,)})
    touch = TouchConfig(head=head, image=ImageConfig(radial=radial))
    seen = [open_touch_source(source, touch) for source in (session, again)]
    assert seen[0].view_shape == seen[1].view_shape == (3, 6, 1 + radial)
    assert bits(seen[0]) == bits(seen[1])
    observed = next(iter(seen[0])).reading
    assert isinstance(observed, Observation)
    assert not observed.alive[2]
    assert open_touch_source(seen[0], touch) is seen[0]


def test_a_session_in_memory_equals_the_session() -> None:
    source = open_touch_source(simulate(HeadConfig(dead=(5,))), TouchConfig())
    log = load_into_memory(source)
    assert (log.length, log.view_shape, log.whiskers) == (source.length, (3, 6, 1), 18)
    assert log.info == source.info
    assert log.info.cell_size == 0.05
    for one, two in zip(source, log, strict=True):
        assert (one.reading.view == two.reading.view).all()
        assert (one.reading.alive == two.reading.alive).all()
        assert one.reading.odometry == two.reading.odometry
        assert (one.truth == two.truth).all()


def test_whisker_readings_are_not_observations(refused: Callable[..., InputError]) -> None:
    refused(lambda: load_into_memory(simulate()), "simulation", "whisker readings")


def test_a_head_that_differs_from_the_recorded_one_is_refused(
    tmp_path: Path, refused: Callable[..., InputError]
) -> None:
    record_source(simulate(path={"explore": 3.0}), tmp_path / "a.mcap")
    source = Recording(tmp_path / "a.mcap")
    refused(
        lambda: open_touch_source(source, TouchConfig(head=HeadConfig(whiskers=5))),
        "touch.head",
        "15 whiskers",
        "18, those of a",
    )
