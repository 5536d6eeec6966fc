"""Published recordings and maps of the reference implementation: known errors."""

import numpy as np
import pytest

from evaluation.metrics.energy_metric import read_relations, relation_errors
from evaluation.metrics.trajectory import ate
from tactile.base.se2 import integrate


def dead_reckoning(trace):
    """Raw odometry [N, 3]: a step goes along its new heading, and the first row only sets the clock."""
    dt = np.diff(trace["in_t"], prepend=trace["in_t"][0])
    way, turn = trace["in_v"] * dt, trace["in_w"] * dt
    return integrate(np.stack([way * np.cos(turn), way * np.sin(turn), turn], axis=1))


def final_map(trace):
    """Final position [N, 3] of each row's experience; node 0 before there is any."""
    return trace["map_final"][trace["out_em_exp"].astype(int), 1:4]


@pytest.mark.parametrize(("name", "odometry", "reference", "digit"), [
    ("f_real_intel_laser3x6", 24.16, 9.83, 0.01),
    ("f_real_tuc_lecture_hall", 12.95, 3.03, 0.01),
    ("b_figure8_alias", 0.174, 0.742, 0.001),
    ("a_square3", 0.248, 0.044, 0.001),
    ("e_kidnap", 0.764, 0.432, 0.001),
])  # fmt: skip
def test_ate_of_odometry_and_of_the_reference_map(trace, name, odometry, reference, digit):
    run = trace(name)
    assert ate(dead_reckoning(run), run["truth"]) == pytest.approx(odometry, abs=digit / 2)
    assert ate(final_map(run), run["truth"]) == pytest.approx(reference, abs=digit / 2)


def test_relations_of_the_intel_lab(reference_data, trace):
    relations = read_relations(reference_data / "data" / "intel_relations.csv")
    rows = np.loadtxt(reference_data / "data" / "intel_odom_gt.csv", delimiter=",", skiprows=1)
    time, odometry, truth = rows[:, 0], rows[:, 1:4], rows[:, 4:]
    run = trace("f_real_intel_laser3x6")

    def errors(pose):
        return relation_errors(time, pose, relations)

    assert errors(truth) == pytest.approx((0.126, 4.11, 2983, 1), abs=0.005)
    # raw odometry is the recording's own pose columns; the trace's has lost its lateral part
    assert errors(odometry)[:2] == pytest.approx((7.43, 40.9), abs=0.005)
    assert errors(dead_reckoning(run))[:2] == pytest.approx((7.506, 40.9), abs=0.005)
    assert errors(final_map(run))[:2] == (pytest.approx(1.385, abs=0.001), pytest.approx(25.9, abs=0.05))
