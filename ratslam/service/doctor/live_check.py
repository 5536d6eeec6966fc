"""Whether a live session could start: robot, whiskers, clocks, disk and settings; nothing moves."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from ratslam.runs.settings.run_config import RunConfig
from ratslam.service.doctor.diagnosis import Diagnosis
from robot.live.create_selftest import check_create
from robot.live.polling import SessionFault
from robot.live.selftest import check_arm_session
from tactile.base.errors import InputError


def diagnose_live(config: RunConfig, name: str, directory: Path) -> Diagnosis:
    """Checks everything that a live session needs, without a motion.

    Args:
        name: of the configuration. directory: in which the session would make its run directory.

    Raises:
        InputError: it is not the configuration of a live session.
    """
    if config.live is None:
        raise InputError(name, "no section `live`", "the configuration of a live session")
    passed: list[str] = []
    try:
        for line in _checks(config, directory):
            passed.append(line)  # those before a failure count
    except (InputError, SessionFault) as error:
        return Diagnosis(f"{name}: the live session cannot start", (), tuple(passed), (str(error),))
    return Diagnosis(f"{name}: the live session can start; nothing was moved", (), tuple(passed))


def _checks(config: RunConfig, directory: Path) -> Iterator[str]:
    live = config.live
    assert live is not None
    yield f"settings: backend {config.backend}, {'a Create' if live.create is not None else 'an arm'}"
    if live.create is not None:
        yield from check_create(live, directory)
    else:
        yield from check_arm_session(live, config.touch.head, directory)
