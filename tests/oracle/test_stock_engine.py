"""The stock engine against recorded traces."""

from __future__ import annotations

import pytest

from tests.oracle import compare
from tests.oracle.trace import load
from tests.oracle.trace_cases import GOLDEN, INTEL, LECTURE_HALL, SYNTHETIC, real


@pytest.mark.parametrize("name", SYNTHETIC)
def test_stock_synthetic(name: str) -> None:
    report = compare.stock(load(GOLDEN / f"{name}.npz"))
    assert report.agrees, report.line()
    assert report.knife_edges == 0


def test_stock_intel() -> None:
    report = compare.stock(load(real(INTEL)), steps=600)
    assert report.agrees, report.line()


@pytest.mark.soak
def test_stock_intel_whole() -> None:
    report = compare.stock(load(real(INTEL)))
    assert report.agrees, report.line()


def test_stock_lecture_hall() -> None:
    """At step 235 truncation is ambiguous, and the file decides the cell of the injection."""
    report = compare.stock(load(real(LECTURE_HALL)), steps=400)
    assert report.agrees, report.line()
    assert report.knife_edges == 1


@pytest.mark.soak
def test_stock_lecture_hall_whole() -> None:
    report = compare.stock(load(real(LECTURE_HALL)))
    assert report.agrees, report.line()
    assert report.steps == 13838
