"""The bench checks of an arm and of its whisker head: what they do above the start of a route, by themselves
and within five minutes, and the records of it."""

from __future__ import annotations

import base64
import io
import zipfile
from collections.abc import Callable
from itertools import chain
from math import ceil
from typing import Any, NamedTuple, TypeVar

import numpy as np

from robot.drivers.head.usb_protocol import frame_values, to_radians
from robot.drivers.processes import urgent
from robot.live.arm_route import arm_routes, check_targets, plan_path
from robot.live.live_config import LiveConfig
from robot.live.live_rig import ArmRig, Rig
from robot.live.poke_loop import FreePokes, record_free_pokes
from robot.live.polling import OperatorStop, SessionFault
from robot.live.selftest import find_devices, start_and_check
from robot.live.whisk_loop import follow_route, record_free_whisks
from tactile.base.errors import InputError
from tactile.base.types import Cycle, Odometry
from tactile.pokes import PokeConfig
from tactile.whisker_geometry import HeadConfig, ur10_head

TRIALS = 10
"""Pokes, or whisks."""
_Rig = TypeVar("_Rig", bound=ArmRig)
_Record = TypeVar("_Record", bound=NamedTuple)


class FreeWhisks(NamedTuple):
    """F whisks in free air, with their N samples of W whiskers one after the other.

    Attributes:
        samples: [F] number of each that arrived. whole: samples that a whisk has. time: [N] s. values: [N, W,
            3] counts of angle and deflections. late: [F] time from the end of each to its last sample, s.
            bad: damaged samples meanwhile. residual: of the head's clock, s.
    """

    samples: np.ndarray
    whole: np.ndarray
    time: np.ndarray
    values: np.ndarray
    late: np.ndarray
    bad: np.ndarray
    residual: np.ndarray

    def cycles(self) -> list[Cycle]:
        """The whisks."""
        still, ends = Odometry(0.0, 0.0, 0.0, 0.0), np.cumsum(self.samples)[:-1]
        return [
            Cycle(time, *to_radians(values), still)
            for time, values in zip(np.split(self.time, ends), np.split(self.values, ends), strict=True)
        ]


def poke_in_air(
    config: LiveConfig, head: HeadConfig, pokes: PokeConfig, stopped: Callable[[], bool],
    say: Callable[[str], object], trials: int = TRIALS,
) -> FreePokes:  # fmt: skip
    """Pokes above the start of the route, evenly spread over all directions.

    Args:
        head: whose path it is. stopped: whether the operator has requested the end. say: called with each
            step. trials: number of pokes, even.

    Raises:
        InputError: a device is not ready, a fault ended the check, or the centre is at the border of the box.
        KeyboardInterrupt: the operator ended it.
    """

    def poke(rig: ArmRig) -> FreePokes:
        say(f"arm: {trials} pokes of {pokes.reach:g} m in free air")
        return record_free_pokes(rig, pokes.model_copy(update={"directions": trials}))

    return _above_start(ArmRig(config, stopped), head, say, poke)


def whisk_in_air(
    config: LiveConfig, head: HeadConfig, stopped: Callable[[], bool], say: Callable[[str], object],
    trials: int = TRIALS,
) -> FreeWhisks:  # fmt: skip
    """Whisks above the start of the route, without feedback, at least as many as a session's calibration.

    For the arguments and errors see `poke_in_air`.
    """
    plan = config.plan
    trials = max(trials, ceil(plan.calibration.min_duration * plan.whisking.rate))

    def whisk(rig: Rig) -> FreeWhisks:
        say(f"head: {trials} whisks in free air")
        rig.driver.whisk(plan.whisking.model_copy(update={"mode": "open"}))
        late, before = list[float](), rig.head.decoder.counts.bad
        cycles = record_free_whisks(rig, trials, late)
        assert rig.head.identity is not None
        time, angle, deflection = (
            np.concatenate([getattr(cycle, name) for cycle in cycles])
            for name in ("time", "angle", "deflection")
        )
        return FreeWhisks(
            samples=np.array([len(cycle.time) for cycle in cycles]),
            whole=np.array(round(rig.head.identity.rate / plan.whisking.rate)),
            time=time,
            values=frame_values(angle, deflection),
            late=np.array(late),
            bad=np.array(rig.head.decoder.counts.bad - before),
            residual=np.array(rig.stream.clock.residual),
        )

    return _above_start(Rig(config, head, stopped), head, say, whisk)


def _above_start(
    rig: _Rig, head: HeadConfig, say: Callable[[str], object], measure: Callable[[_Rig], _Record]
) -> _Record:
    """Tests the devices, moves above the start of the route, measures there and leaves the arm at rest."""
    path = plan_path(rig.config, ur10_head(head))
    check_targets(rig.config, path)
    try:
        with urgent(), rig:
            for line in chain(find_devices(rig), start_and_check(rig)):
                say(line)
            try:
                say("arm: moving above the start of the route")
                follow_route(rig, arm_routes(rig.config, path)[0])
                return measure(rig)
            finally:
                rig.rest()
    except SessionFault as error:
        fault = error.fault
        expected = "free air above the start of the route, and devices that work"
        raise InputError(fault.outcome.name.lower(), fault.detail, expected, fault.outcome.value) from None
    except OperatorStop:
        raise KeyboardInterrupt from None


def record_to_text(record: NamedTuple) -> str:
    """A record of arrays as text: npz in base64."""
    file = io.BytesIO()
    np.savez_compressed(file, **record._asdict())
    return base64.b64encode(file.getvalue()).decode()


def record_of_text(kind: Callable[..., _Record], text: Any) -> _Record:
    """The record of `record_to_text`.

    Raises:
        ValueError, KeyError, TypeError: it is none of this kind.
    """
    try:
        with np.load(io.BytesIO(base64.b64decode(text, validate=True)), allow_pickle=False) as arrays:
            record = kind(**arrays)
    except (zipfile.BadZipFile, EOFError) as error:
        raise ValueError(str(error)) from None
    return record
