"""How whiskers are driven: a sinusoid, and what contact makes of its amplitude.

One pure law, for simulated and real heads alike. The command is a protraction
    amplitude (1 - cos(2 pi rate t)) / 2,
which starts at rest in every cycle; feedback lowers the amplitude only, so the start stays where it is
(Salman & Pearson 2016, III-E).
"""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import Field, NonNegativeFloat, PositiveFloat

from tactile.settings import Settings
from tactile.types import Array


class WhiskingConfig(Settings):
    """One whisker's drive."""

    mode: Literal["open", "rcp", "spread"] = "rcp"
    """`open`: the sinusoid; `rcp`: contact lowers the amplitude (rapid cessation of protraction); `spread`:
    and whiskers of a column follow the one of them that touched (spread reduction)."""
    rate: PositiveFloat = 1.0
    """Whisks per second."""
    amplitude_deg: Annotated[float, Field(gt=0, le=180)] = 65.0
    """Of the protraction."""
    gain: NonNegativeFloat = 4.0
    """Amplitude taken off for each unit of deflection above the contact threshold, rad per rad."""


def phase(config: WhiskingConfig, time: Array) -> np.ndarray:
    """Share of the amplitude commanded at each time, s: 0 at rest, 1 at full protraction."""
    return (1 - np.cos(2 * np.pi * config.rate * np.asarray(time, float))) / 2
