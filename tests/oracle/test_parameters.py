"""Parameters of traces, read from text."""

from __future__ import annotations

from tests.oracle.trace import Parameters


def test_parameters_are_read_from_text() -> None:
    """Strings, with the defaults of the specification."""
    parameters = Parameters.from_strings(
        {"pc_dim_xy": "11", "exp_initial_em_deg": "-26.5", "camera_hz": "10"}
    )
    assert (parameters.pc_dim_xy, parameters.exp_initial_em_deg) == (11, -26.5)
    assert (parameters.vt_shift_match, parameters.exp_loops, parameters.pc_w_i_var) == (25, 10, 2)
