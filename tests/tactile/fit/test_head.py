"""Rest angle and base radii are found again from the contacts of simulated heads in a maze."""

from __future__ import annotations

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


def fitted(true: HeadConfig, walls_of: HeadSimulation | None = None) -> tuple[Any, ...]:
    source = session(true)
    assert source.features is not None
    walls, pose = (walls_of or source).scene.surroundings.walls, source.truth
    contact, touched = source.features.contact, source.features.touched
    return fit_head(
        ASSUMED, contact, touched, lambda config: Surroundings(walls, ur10_head(config)).contact(pose).angle
    )


@pytest.mark.parametrize(("rest", "factor"), [(60, 1.2), (75, 1.0)])
def test_the_geometry_is_found(rest: float, factor: float) -> None:
    true = head(rest, factor)
    (found, _), radii, _, errors = fitted(true)
    assert abs(found - rest - DELAY_DEG) < 0.3
    assert radii[0] is None  # the inner ring touches nothing
    for ring, radius in zip(true.rings[1:], radii[1:], strict=True):
        assert radius is not None
        assert abs(radius[0] / ring.radius - 1) < 0.01
        assert 0 < radius[1] < 0.01 * ring.radius
    assert errors[0] < 0.02
    assert (rest, factor) == (75, 1.0) or errors[1] > 3 * errors[0]  # with the head that was assumed


def test_wrong_walls_fit_badly_and_few_contacts_are_refused() -> None:
    """Control: contacts of one maze, walls of another."""
    *_, (error, _) = fitted(head(60, 1.2), walls_of=session(head(60, 1.2), seed=4))
    assert error > 0.05
    none = np.zeros((5, 18), bool)
    with pytest.raises(InputError, match="0 contacts"):
        fit_head(ASSUMED, none, np.zeros((5, 18)), lambda config: np.zeros((5, 18)))
