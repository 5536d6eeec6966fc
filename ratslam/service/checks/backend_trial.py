"""A backend under test: its sessions on walks with repeated places, shared by the checks."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cached_property
from typing import Any

import jax
import numpy as np

from ratslam.core.backend import Backend, Map
from ratslam.core.session import Session, Step
from ratslam.methods.method_registry import BackendEntry, Sensors
from tactile.base.errors import InputError
from tactile.base.types import Observation, Odometry, observation
from tactile.whiskers.planar_whiskers import PlanarWhiskers

VIEW = (3, 6, 1)
WHISKERS, REACH = 18, 0.2
"""Number and length (m) of the whiskers, which point in all directions from the robot's centre."""
STEPS, CAPACITY = 340, 256
"""Steps of the longest walk: a backend that stores every step grows once in it, from `CAPACITY`."""
CIRCUIT = 17
"""Places of the circuit."""

_bearing = np.arange(WHISKERS) * 2 * np.pi / WHISKERS
_around = np.stack([np.cos(_bearing), np.sin(_bearing)], axis=1)
FEELERS = PlanarWhiskers(np.zeros((WHISKERS, 2)), _around, np.full(WHISKERS, REACH))
SENSORS = {"with whiskers": Sensors(VIEW, FEELERS), "without whiskers": Sensors(VIEW)}


class BackendTrial:
    """A method with settings, and what its checks share.

    Args:
        settings: an instance of the entry's `config_class`.
    """

    def __init__(self, entry: BackendEntry, settings: Any) -> None:
        self.entry, self.settings = entry, settings

    def build(self, dtype: Any = np.float64) -> Backend:
        """A new backend for the first sensors that suit it."""
        return self.entry.build(self.settings, self.sensors, np.dtype(dtype))

    @cached_property
    def _built(self) -> dict[str, Backend | str]:
        """For each kind of sensors: the backend, or the text of the `InputError` that refuses them."""
        found: dict[str, Backend | str] = {}
        for name, sensors in SENSORS.items():
            try:
                found[name] = self.entry.build(self.settings, sensors, np.dtype(np.float64))
            except InputError as error:
                found[name] = str(error)
        return found

    @property
    def refusals(self) -> dict[str, str]:
        """For sensors that the method refuses with an `InputError`: its text."""
        return {name: made for name, made in self._built.items() if isinstance(made, str)}

    @cached_property
    def sensors(self) -> Sensors:
        """The sensors of the walks: with whiskers, unless the method refuses them."""
        return next(sensors for name, sensors in SENSORS.items() if name not in self.refusals)

    def walk(self, count: int, seed: int = 0) -> list[Observation]:
        """The first observations of a walk."""
        return list(walk(count, seed, 0 if self.sensors.feelers is None else WHISKERS))

    @property
    def backend(self) -> Backend:
        """The backend for these sensors; all checks share it."""
        return next(made for made in self._built.values() if not isinstance(made, str))

    @cached_property
    def types(self) -> tuple[Any, Any, Any, Any]:
        """Shapes and dtypes: the initial state, and state, estimate and evidence after a step."""
        key = jax.random.key(0)
        state = jax.eval_shape(lambda key: self.backend.init(key, CAPACITY), key)
        return state, *jax.eval_shape(self.backend.kernel, state, self.walk(1)[0])

    @cached_property
    def session(self) -> Session:
        return Session(self.backend)

    def fresh(self) -> Session:
        """The session of `backend` at its start; all checks share its compiled function."""
        self.session.restart()
        return self.session

    @cached_property
    def _replayed(self) -> tuple[list[Step], dict[str, np.ndarray], Map]:
        session = self.fresh()
        return list(session.replay(self.walk(STEPS))), session.arrays(), session.map

    @property
    def steps(self) -> list[Step]:
        """The steps of a replay of `walk(STEPS)`."""
        return self._replayed[0]

    @property
    def arrays(self) -> dict[str, np.ndarray]:
        """The arrays of the session after this replay."""
        return self._replayed[1]

    @property
    def map(self) -> Map:
        """The map of this replay."""
        return self._replayed[2]

    @cached_property
    def single(self) -> tuple[Session, list[Step]]:
        """A session in single precision, and its steps in `walk(200)`."""
        session = Session(self.build(np.float32), precision="float32")
        return session, list(session.replay(self.walk(200)))


def walk(count: int, seed: int = 0, whiskers: int = WHISKERS) -> Iterator[Observation]:
    """Laps of a small circuit with repeated views; some steps have no view, and in some the whiskers are in
    contact."""
    stream, touch = np.random.default_rng(seed), np.random.default_rng([seed, 1])
    places = stream.random((CIRCUIT, *VIEW))
    for k in range(count):
        turn = 2 * np.pi / CIRCUIT + stream.normal(0, 0.01)
        odometry = Odometry(0.05 + stream.normal(0, 0.002), stream.normal(0, 0.002), turn, 0.1)
        seen, place = stream.random() > 0.1, k % CIRCUIT
        o = observation(
            odometry,
            places[place] if seen else None,
            view_shape=VIEW,
            label=place if seen else -1,
            whiskers=whiskers,
        )
        contact = touch.random(WHISKERS)[:whiskers] < (0.2 if k % 5 == 0 else 0.0)
        yield o._replace(contact=contact, point=np.where(contact[:, None], REACH * _around[:whiskers], 0.0))
