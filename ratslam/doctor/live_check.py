"""Whether a live session could start: robot, whiskers, clocks, disk and settings; nothing moves."""

from __future__ import annotations

from pathlib import Path

from ratslam.config.run_config import RunConfig
from ratslam.doctor.diagnosis import Diagnosis
from tactile.base.errors import InputError


def diagnose_live(config: RunConfig, name: str, directory: Path) -> Diagnosis:
    """Checks everything that a live session needs, without a motion.

    Args:
        config: of a live session. name: of its file. directory: in which the session would write.
    """
    passed: list[str] = []
    try:
        for line in _checks(config, directory):
            passed.append(line)
    except InputError as error:
        return Diagnosis(f"{name}: a live session that cannot start", (), tuple(passed), (str(error),))
    return Diagnosis(f"{name}: a live session that can start; nothing was moved", (), tuple(passed))
