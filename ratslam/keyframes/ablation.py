"""Parts of the keyframe map that a study can turn off, to measure what each contributes."""

from __future__ import annotations

from typing import NamedTuple


class Ablation(NamedTuple):
    """Which parts are on.

    Attributes:
        verify: closure sequences are tested against the map's covariance before they count. robust: sequences
            that disagree with the map lose weight. heading_bias: the map solves for the heading bias.
    """

    verify: bool = True
    robust: bool = True
    heading_bias: bool = True


FULL = Ablation()
"""Nothing turned off."""
