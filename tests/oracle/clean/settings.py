"""What the quirk-free engine can be told and a stream's parameters do not say."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Settings:
    """Defaults are the engine's own.

    Attributes:
        recent: how many of the newest templates do not inject.
        settle_steps: steps after an injection in which the packet's lag is not measured.
        column_angle: how far a column of a shifted view lies from the next, rad.
    """

    recent: int = 10
    settle_steps: int = 10
    column_angle: float = 0.0
