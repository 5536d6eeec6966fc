"""The views of a session compared with a ground."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np


class Comparison(NamedTuple):
    """The views of n keyframes of a session, in order of time, compared with a ground of N keyframes.

    Attributes:
        gain: [n, S, N] log-likelihood of each view at each sector shift and keyframe less that at a new
            place. shows: [n] bool, whether the view can be compared. match, shift: [n] the keyframe that is
            recalled, -1 for none, and the row of its sector shift. posterior: [n] of the places around it.
    """

    gain: np.ndarray
    shows: np.ndarray
    match: np.ndarray
    shift: np.ndarray
    posterior: np.ndarray

    def gains(self, k: int) -> np.ndarray | None:
        """[S, N] gains of one view, None if it shows nothing."""
        return self.gain[k] if self.shows[k] else None
