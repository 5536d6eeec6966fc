"""Sources of a taxel array and of a force-torque sensor, fed from the contacts of a simulated whisker head.

The head whisks as in `HeadSimulation`; a whisker that its drive pushes beyond the angle of contact presses
with `STIFFNESS` per radian. Both sensors sample these forces at a rate of their own, with noise. Odometry is
that of the head, in equal parts for the samples between two whisks.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from pydantic import NonNegativeFloat, PositiveFloat, PositiveInt

from robot.simulation.head.simulated_session import HeadSimulation, SimulationConfig
from robot.sources.in_memory import InMemorySource, digest_of_document, wrap_headings
from robot.sources.source import SourceEntry
from robot.touch_source import TouchEntry
from robot.world.scene import poses_at
from tactile.base.random_streams import stream
from tactile.base.se2 import compose
from tactile.base.settings import Settings
from tactile.base.types import Observation, Odometry, observation
from tactile.whisker_geometry import Head, shaft_points
from tactile.whisking import whisk_phase

ROWS, COLUMNS = 3, 22
"""Taxels: a row for each ring of whiskers, evenly spread around the head."""
STIFFNESS = 1.0
"""Force of a whisker per angle of push, N/rad."""


class ArrayConfig(Settings):
    """A sensor in place of the whiskers."""

    simulation: SimulationConfig = SimulationConfig()
    """The head in its maze."""
    rate: PositiveFloat = 50.0
    """Samples per second."""
    noise: NonNegativeFloat = 0.01
    """Standard deviation of a force, N; of a torque a tenth of it, N m."""


class _Contacts(NamedTuple):
    """Contacts of N whisks: angle [N, W] rad, and place along the shaft [N, W], m; NaN angles without one."""

    angle: np.ndarray
    along: np.ndarray


def taxel_pressures(head: Head, push: np.ndarray, contacts: _Contacts) -> np.ndarray:
    """[N, 3, 22, 1] forces on taxels, N, of whiskers that push [N, W], N; one between two presses both."""
    columns = head.shape[1]
    azimuth, middle = np.arctan2(*head.rest[:columns, 1::-1].T), 2 * np.pi * np.arange(COLUMNS) / COLUMNS
    apart = np.abs((azimuth[:, None] - middle + np.pi) % (2 * np.pi) - np.pi)
    share = np.clip(1 - apart * COLUMNS / (2 * np.pi), 0, 1)  # [C, 22]
    rings = push.reshape(len(push), ROWS, columns)
    return (rings @ share)[..., None]


def wrenches(head: Head, push: np.ndarray, contacts: _Contacts) -> np.ndarray:
    """[N, 1, 6, 1] force (N) and torque (N m) about base_link of whiskers that push [N, W], N."""
    angle = np.nan_to_num(contacts.angle)
    ahead = np.cos(angle)[..., None] * head.swing - np.sin(angle)[..., None] * head.rest
    force = -push[..., None] * ahead
    torque = np.cross(shaft_points(head, angle, contacts.along), force)
    return np.concatenate([force.sum(axis=1), torque.sum(axis=1)], axis=1)[:, None, :, None]


Response = Callable[[Head, np.ndarray, _Contacts], np.ndarray]


def _open(config: ArrayConfig, name: str, response: Response, scale: Any, whiskers: int) -> InMemorySource:
    made = HeadSimulation(config.simulation)
    assert made.features is not None, "the kinematic fidelity"
    rate = config.simulation.whisking.rate
    count = round(config.rate / rate)
    whisk = np.arange(1, made.length).repeat(count)
    later = made.time[whisk - 1] + np.tile(np.arange(1, count + 1), made.length - 1) / config.rate
    time = np.concatenate([made.time[:1], later])
    cycle = np.clip(((time - made.start[0]) * rate + 1e-9).astype(int), 0, made.length - 1)
    touched, contact, reach = made.features.touched, made.features.contact, made.features.reach
    contacts = _Contacts(np.where(contact, touched, np.nan)[cycle], (reach * made.head.length)[cycle])
    whisking = config.simulation.whisking
    command = np.radians(whisking.amplitude_deg) * whisk_phase(whisking, time % (1 / rate))
    push = STIFFNESS * np.maximum(np.nan_to_num(command[:, None] - contacts.angle, nan=0.0), 0.0)
    views = response(made.head, push, contacts)
    views += scale * config.noise * stream(config.simulation.seed, name).standard_normal(views.shape)
    motion = np.zeros((len(time), 4))
    motion[1:] = split_motions(made.odometry[1:], count)
    yes, label = np.ones(len(time), bool), np.full(len(time), -1, np.int32)
    return InMemorySource(
        name=name, digest=digest_of_document({"array": name, "settings": config.model_dump(mode="json")}),
        time=time, motion=motion, moved=yes, views=views, seen=yes.copy(), label=label,
        truth=wrap_headings(poses_at(made.scene.path, time)), alive=np.ones(whiskers, bool),
        info=made.info.model_copy(update={"head": None, "simulation": None, "provenance": {}}),
    )  # fmt: skip


def split_motions(motion: np.ndarray, parts: int) -> np.ndarray:
    """[N x parts, 4] motions in equal parts along an arc, of motions [N, 4] (m, m, rad, s)."""

    def chord(turn: np.ndarray) -> np.ndarray:
        small = np.abs(turn) < 1e-9
        safe = np.where(small, 1.0, turn)
        return np.where(small, 1.0 + 0.5j * turn, (np.exp(1j * safe) - 1) / (1j * safe))

    turn = motion[:, 2]
    way = (motion[:, 0] + 1j * motion[:, 1]) / parts * chord(turn / parts) / chord(turn)
    part = np.column_stack([way.real, way.imag, turn / parts, motion[:, 3] / parts])
    return part.repeat(parts, axis=0)


TAXELS = SourceEntry(ArrayConfig, lambda c, warn: _open(c, "taxels", taxel_pressures, 1.0, ROWS * COLUMNS))
"""A taxel array; its readings are forces, N."""
WRENCH_SCALE = np.array([1.0, 1.0, 1.0, 0.1, 0.1, 0.1])[:, None]
WRENCH = SourceEntry(ArrayConfig, lambda c, warn: _open(c, "wrench", wrenches, WRENCH_SCALE, 0))
"""A force-torque sensor; its readings are wrenches, N and N m."""


class WrenchConfig(Settings):
    frames: PositiveInt = 50
    """Samples whose mean makes one view."""
    force: PositiveFloat = 2.0
    """Largest force, N."""
    torque: PositiveFloat = 0.2
    """Largest torque, N m."""


class WrenchFrontend:
    """The mean wrench over some samples as a view of 1 x 6; 0.5 is none."""

    view_shape, whiskers = (1, 6, 1), 0

    def __init__(self, config: WrenchConfig) -> None:
        self.frames, self.full = config.frames, np.repeat([config.force, config.torque], 3)[:, None]
        self._clear()

    def _clear(self) -> None:
        self._motion, self._dt, self._sum, self._count = np.zeros(3), 0.0, np.zeros(self.view_shape), 0

    def observe(self, reading: Observation) -> Observation | None:
        """The mean, after the last of its samples."""
        self._motion = compose(self._motion, np.array(reading.odometry[:3]))
        self._dt += reading.odometry.dt
        self._sum += reading.view
        self._count += 1
        if self._count < self.frames:
            return None
        view = np.clip(0.5 + self._sum / self._count / (2 * self.full), 0, 1)
        made = observation(Odometry(*self._motion, self._dt), view)
        self._clear()
        return made


WRENCH_FRONTEND = TouchEntry(WrenchConfig, lambda config, info: WrenchFrontend(config))
