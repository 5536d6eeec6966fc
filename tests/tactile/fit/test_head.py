"""Rest angle and base radii are found again from the contacts of simulated heads in a maze."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from robot.simulation.head.simulated_session import HeadSimulation, SimulationConfig
from robot.world.walls import Surroundings
from tactile.base.errors import InputError
from tactile.rig_signals import fit_head
from tactile.whisker_geometry import HeadConfig, ur10_head

ASSUMED = HeadConfig()
DELAY_DEG = np.degrees(0.015)
"""Dead zone of the simulated sensors, which delays contacts."""


def head(rest: float, factor: float) -> HeadConfig:
    rings = tuple(ring.model_copy(update={"radius": factor * ring.radius}) for ring in ASSUMED.rings)
    return HeadConfig(rest_deg=rest, rings=rings)


def session(true: HeadConfig, seed: int = 3) -> HeadSimulation:
    settings = {"path": {"explore": 100}, "maze": {"heights": [0.03, 0.05]}, "seed": seed}
    return HeadSimulation(SimulationConfig.model_validate(settings), true)


def predictor(source: HeadSimulation) -> Callable[[HeadConfig], np.ndarray]:
    walls, pose = source.scene.surroundings.walls, source.truth
    return lambda config: Surroundings(walls, ur10_head(config)).contact(pose).angle


def fitted(true: HeadConfig, assumed: HeadConfig = ASSUMED) -> tuple[Any, ...]:
    source = session(true)
    assert source.features is not None
    return fit_head(assumed, source.features.contact, source.features.touched, predictor(source))


@pytest.mark.parametrize(("rest", "factor"), [(60, 1.2), (75, 1.0), (75, 0.8)])
def test_the_geometry_is_found(rest: float, factor: float) -> None:
    true = head(rest, factor)
    (found, _), radii, _, errors = fitted(true)
    assert abs(found - rest - DELAY_DEG) < 0.3
    for ring, radius in zip(true.rings[1:], radii[1:], strict=True):
        assert radius is not None
        assert abs(radius[0] / ring.radius - 1) < 0.01
        assert 0 < radius[1] < 0.01 * ring.radius
    assert errors[0] < 0.02
    if (rest, factor) != (75, 1.0):
        assert errors[1] > 3 * errors[0]  # with the head that was assumed


def test_an_upright_head_is_found_less_exactly() -> None:
    """At 90 degrees the longest whiskers meet few edges."""
    (found, _), (_, radius, *_), *_ = fitted(head(90, 0.8))
    assert abs(found - 90 - DELAY_DEG) < 1.0
    assert abs(radius[0] / (0.8 * ASSUMED.rings[1].radius) - 1) < 0.03


def test_a_ring_that_touches_nothing_is_unknown() -> None:
    """The whiskers of the inner ring do not reach the walls."""
    assert fitted(head(75, 1.0))[1][0] is None


def test_wrong_walls_fit_badly() -> None:
    """Control: contacts of one maze, walls of another."""
    source, other = session(head(60, 1.2)), session(head(60, 1.2), seed=4)
    assert source.features is not None
    walls, pose = other.scene.surroundings.walls, source.truth
    *_, (error, _) = fit_head(
        ASSUMED, source.features.contact, source.features.touched,
        lambda config: Surroundings(walls, ur10_head(config)).contact(pose).angle,
    )  # fmt: skip
    assert error > 0.05


def test_few_contacts_are_refused() -> None:
    none = np.zeros((5, 18), bool)
    with pytest.raises(InputError, match="0 contacts"):
        fit_head(ASSUMED, none, np.zeros((5, 18)), lambda config: np.zeros((5, 18)))
