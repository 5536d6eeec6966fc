"""The record of a metric, its computed `Finding`, and the `Quantity` that a scorecard writes of it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import isfinite
from typing import Any, Literal, NamedTuple

import numpy as np

from tactile.base.settings import Settings

Direction = Literal["low", "high"] | None
"""Direction of better values; None if values have no order."""


class Quantity(Settings):
    """One measured value."""

    label: str
    """Name in words."""
    value: float | int | None
    """The value; None (null in JSON) if undefined, with the reason in `note`."""
    unit: str
    """SI, or degrees as `deg`; '' for a ratio or a count."""
    odometry: float | int | None = None
    """The value for odometry, if defined."""
    note: str = ""
    """Reason for a missing value, or a remark on the value."""

    @staticmethod
    def pool(trials: Sequence[Quantity]) -> Quantity:
        """The mean over trials that have a value; the note tells their spread and how many have none."""
        values = [trial.value for trial in trials if trial.value is not None]
        if not values or len(trials) == 1:
            return trials[0]
        without = [trial.note for trial in trials if trial.value is None]
        parts = [f"sd {np.std(values, ddof=1):.2g}"] if len(values) > 1 else []
        parts += [f"{len(without)} of {len(trials)} trials without: {without[0]}"] if without else []
        return trials[0].model_copy(update={"value": float(np.mean(values)), "note": "; ".join(parts)})


class Finding(NamedTuple):
    """A computed value, the value for odometry and a note; a value may be NaN."""

    value: float | int
    odometry: float | int | None = None
    note: str = ""


MISSING_TRUTH = Finding(np.nan, note="no ground truth")


class Metric(NamedTuple):
    """One metric.

    Attributes:
        name: key in `scorecard.json`. label: in words. unit: SI, `deg`, or ''. direction: of better values.
        section: heading in the table. compute: the finding from a `RunData`; None without the ground truth
            that it needs, and of quantities that are made otherwise.
    """

    name: str
    label: str
    unit: str
    direction: Direction
    section: str
    compute: Callable[[Any], Finding | None] = lambda _: None

    def quantity(self, finding: Finding) -> Quantity:
        """The value as written to a scorecard; NaN becomes None."""
        value = finding.value if isfinite(finding.value) else None
        raw = finding.odometry if finding.odometry is not None and isfinite(finding.odometry) else None
        note = finding.note if value is not None or finding.note else "undefined"
        return Quantity(label=self.label, value=value, unit=self.unit, odometry=raw, note=note)
