"""Do theta cycles hold samples of a belief, or all of it? A statistic of spikes.

If all hypotheses fire at all times, two spikes of one cycle are as far apart as two of successive cycles. If
each cycle holds one sample (Ujfalussy & Orban 2022, eLife 11: e74058), the spikes of a cycle are of one
hypothesis, and successive cycles differ as far as the hypotheses do.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np


def cycle_contrast(times: Sequence[np.ndarray], place: np.ndarray, cycle: float, start: float) -> float:
    """Logarithm of the mean squared distance between the preferred places of two spikes of successive theta
    cycles over that of two spikes of one cycle: 0 if all of a belief fires at all times, above 0 if cycles
    hold samples of it. NaN without such pairs of spikes.

    Args:
        times: of each of C cells [n], s. place: [C, 2] centre of its field, m. cycle: duration of a cycle, s.
            start: of the first cycle, s.
    """
    number = [np.floor((np.asarray(each) - start) / cycle).astype(int) for each in times]
    count = 1 + max((int(each.max()) for each in number if len(each)), default=0)
    spikes = np.array([np.bincount(each[each >= 0], minlength=count) for each in number], float).T
    total, centre = spikes.sum(axis=1), spikes @ place  # [cycles], [cycles, 2]
    square = spikes @ (place**2).sum(axis=1)
    inside = total * square - (centre**2).sum(axis=1)  # over pairs, each once
    across = total[:-1] * square[1:] + total[1:] * square[:-1] - 2 * (centre[:-1] * centre[1:]).sum(axis=1)
    pairs = total @ (total - 1) / 2, total[:-1] @ total[1:]
    if not (inside.sum() > 0 and across.sum() > 0 and min(pairs) > 0):
        return float("nan")
    return float(np.log(across.sum() / pairs[1]) - np.log(inside.sum() / pairs[0]))
