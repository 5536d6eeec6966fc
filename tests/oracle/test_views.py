"""Templates of views: preselection, turns."""

from __future__ import annotations

import math

import numpy as np
import pytest

from tests.oracle.plain import Input, PlainTemplates
from tests.oracle.trace import Parameters
from tests.oracle.trace_cases import SETTINGS
from tests.oracle.views import StockTemplates, wrapped


def test_template_gate() -> None:
    """Preselection by the mean misses a shifted match; the plain engine does not preselect."""
    p = Parameters(template_x_size=6, template_y_size=1, vt_shift_match=1, vt_step_match=1)
    first = np.array([[0.0, 0.5, 0.2, 0.6, 0.1, 0.0]])
    second = first.copy()
    second[0, 5] = 0.9
    stock, plain = StockTemplates(p), PlainTemplates(p, SETTINGS)
    stock.see(first)
    plain.see(Input((0.0, 0.0, 0.0), first, None))
    assert stock.see(second).novel
    assert not plain.see(Input((0.0, 0.0, 0.0), second, None)).novel


def test_panoramic_turn() -> None:
    """A view that turned is the same template at an angle."""
    p = Parameters(template_x_size=8, template_y_size=1, vt_panoramic=1, vt_step_match=1)
    view = np.linspace(0.0, 1.0, 8)[None]
    templates = StockTemplates(p)
    templates.see(view)
    match = templates.see(np.roll(view, -2, axis=1))
    assert (match.template, match.relative) == (0, pytest.approx(math.pi / 2))
    assert wrapped(-math.pi) == math.pi
