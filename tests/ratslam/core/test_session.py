"""The session: precision, and starting again."""

from __future__ import annotations

import subprocess
import sys

import jax
import numpy as np
import pytest

from ratslam.core.session import Session
from tactile.base.types import Odometry, observation
from tests.ratslam.backends.dead_reckoning import DeadReckoning


def test_float64_without_64_bit_types_is_refused():
    with jax.enable_x64(False), pytest.raises(ValueError, match="prepare_precision"):
        Session(DeadReckoning())


def test_importing_ratslam_changes_no_jax_setting():
    code = (
        "import jax; before = dict(jax.config.values)\n"
        "import ratslam.core.session\n"
        "assert dict(jax.config.values) == before"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_a_restarted_session_repeats_itself_without_compiling_again():
    session = Session(DeadReckoning())
    walk = [observation(Odometry(0.1, 0.0, 0.1 * k, 0.1)) for k in range(20)]
    first = [step.pose for step in session.replay(walk)]
    session.restart()
    assert session.steps == 0
    assert len(session.map.trajectory()) == 0
    assert np.array_equal(first, [step.pose for step in session.replay(walk)])
    assert session.compilations() == 1
