"""Cells of a model beside recorded ones: distributions of their scores, and how their maps turn with cues.

Intervals are percentile bootstraps over cells, of 95 %. Cells of one animal or one network are no independent
sample of animals or networks: the intervals say what other cells of the same two would give.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from evaluation.cells.analysis import CONTROLLED, CORRECTED, LOWER, analyse_cells, control_scores
from evaluation.cells.head_direction import mean_vector_length, preferred_direction
from evaluation.cells.rate_map import arena_edges, bin_activity, correlate, rate_maps, tuning_curves
from evaluation.cells.recording import BinnedSums, CellRecording
from tactile.base.errors import InputError
from tactile.base.random_streams import stream
from tactile.base.se2 import wrap

LEAST_SPIKES = 50
"""Spikes from which a cell is compared, unless another number is given."""
TURNS = np.radians(np.arange(0, 360, 10))
"""Turns of maps that are tried."""
PLAIN = ("mean_rate", "field_area", "fields")
"""Scores that are compared as they are; the others beside their shuffles too."""
TUNED = 0.3
"""Mean vector length, before and after cues turn, from which a preferred direction counts."""

UNITS = {
    "mean_rate": "Hz", "field_area": "m²", "coherence": "z", "information, corrected": "bits/spike",
    "heading_information, corrected": "bits/spike",
}  # fmt: skip
"""Of scores that have one."""

Interval = tuple[float, float, float]
"""A statistic, and the ends of its interval; NaN where there are no cells."""
_Statistic = Callable[[np.ndarray], float]
_Described = dict[str, tuple[_Statistic, np.ndarray]]
"""By name a statistic, and the values [n, ...] of the cells that have them."""


class ComparedScore(NamedTuple):
    """One line of a comparison.

    Attributes:
        score: its name. cells: of the model and of the data that have it. model, data: the statistic of each.
            difference: data minus model; of angles on the circle. above: probability that a cell of the data
            has more of it than one of the model (0.5: alike); NaN for shares and turns. values: of the cells
            of the model and of the data, as far as known.
    """

    score: str
    cells: tuple[int, int]
    model: Interval
    data: Interval
    difference: Interval
    above: Interval
    values: tuple[np.ndarray, np.ndarray]

    @property
    def label(self) -> str:
        """The name with its unit."""
        return f"{self.score}, {UNITS[self.score]}" if self.score in UNITS else self.score


def compare_cells(
    model: CellRecording,
    data: CellRecording,
    turns: tuple[float | None, float | None] = (None, None),
    shuffles: int = 100,
    least: int = LEAST_SPIKES,
    draws: int = 1000,
    seed: int = 0,
) -> list[ComparedScore]:
    """Compares the cells of two recordings in spikes/s (`recording.record_spikes`).

    Of each score the medians, of those with shuffled controls also the share of cells beyond the 95th
    percentile of their shuffles (`analysis.LOWER`: below the 5th). Information is without its bias
    (`ShuffledScores.corrected`).

    Args:
        turns: times at which cues turned in the model's session and in the data's, s on their clocks; None:
            not at all. shuffles: of each cell. least: spikes of a cell that is compared. draws: of the
            bootstrap. seed: of shuffles and draws.

    Raises:
        InputError: no cell has so many spikes, or a session is too short (`control_scores`).
    """
    sides = [
        _describe(each, turn, shuffles, least, seed) for each, turn in zip((model, data), turns, strict=True)
    ]
    nothing: tuple[_Statistic, np.ndarray] = np.median, np.zeros(0)
    rows = []
    for name in dict.fromkeys([*sides[0], *sides[1]]):
        statistic = next(side[name][0] for side in sides if name in side)
        values = [side.get(name, nothing)[1] for side in sides]
        random = stream(seed, f"comparison {name}")
        drawn = (
            _bootstrap(values[0], statistic, draws, random),
            _bootstrap(values[1], statistic, draws, random),
        )
        apart = drawn[1] - drawn[0]
        above = np.full(draws + 1, np.nan)
        if statistic is np.median and all(map(len, values)):
            above = _above(values[0], values[1], draws, random)
        is_angle = name.endswith("rad")
        rows.append(
            ComparedScore(
                name,
                (len(values[0]), len(values[1])),
                _interval(drawn[0], is_angle),
                _interval(drawn[1], is_angle),
                _interval(apart, is_angle),
                _interval(above),
                (values[0], values[1]),
            )
        )
    return rows


def _describe(
    recording: CellRecording, turn: float | None, shuffles: int, least: int, seed: int
) -> _Described:
    """What is compared of a recording."""
    step = np.diff(recording.time, prepend=recording.time[0])
    spikes = step @ recording.activity
    kept = spikes >= least
    if not kept.any():
        found = f"{len(spikes)} cells with at most {spikes.max(initial=0):.0f} spikes"
        cure = "record longer or more cells, raise --peak-rate of a model, or lower --least"
        raise InputError("cells", found, f"a cell with {least} spikes", cure)
    chosen = recording._replace(cell=recording.cell[kept], activity=recording.activity[:, kept])
    scores = analyse_cells(chosen)._asdict()
    controls = control_scores(chosen, shuffles, seed)
    described: _Described = {name: (np.median, scores[name]) for name in PLAIN}
    for name in (each for names in CONTROLLED.values() for each in names if each in controls):
        value = controls[name].corrected if name in CORRECTED else controls[name].score
        described[f"{name}, corrected" if name in CORRECTED else name] = np.median, value
        known = np.isfinite(controls[name].percentile)
        beyond = value < controls[name].low_percentile if name in LOWER else controls[name].above
        described[f"{name}, share beyond shuffles"] = np.mean, beyond[known].astype(float)
    if turn is not None:
        described |= _turned(chosen, turn)
    return {
        name: (statistic, values[np.isfinite(values).all(axis=tuple(range(1, values.ndim)))])
        for name, (statistic, values) in described.items()
    }


def _turned(recording: CellRecording, turn: float) -> _Described:
    """How maps and preferred directions before a time compare with those after it."""
    time, truth = recording.time, recording.truth
    early, edges = time < turn, arena_edges(truth)
    if not np.isfinite(truth[early]).all(axis=1).any() or not np.isfinite(truth[~early]).all(axis=1).any():
        found = f"a turn of cues at {turn:g} s in a session from {time[0]:g} to {time[-1]:g} s"
        raise InputError("turn", found, "a time with known places before and after it")
    middle = np.array([(each[0] + each[-1]) / 2 for each in edges])

    def sums_of(part: np.ndarray, angle: float = 0.0) -> BinnedSums:
        """Of a part of the session, its places turned back by an angle round the middle of the box."""
        back = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        place = (truth[part, :2] - middle) @ back + middle
        return bin_activity(
            time[part], np.column_stack([place, truth[part, 2]]), recording.activity[part], *edges
        )

    halves, first = (sums_of(early), sums_of(~early)), time < (time[early][0] + turn) / 2
    before = rate_maps(halves[0])
    alike = np.stack([correlate(before, rate_maps(sums_of(~early, angle))) for angle in TURNS], axis=1)
    best = _best_turn(alike[np.isfinite(alike).all(axis=1)])
    after = rate_maps(sums_of(~early, 0.0 if np.isnan(best) else best))
    other_cell = np.roll(after, 1, axis=0)
    curves = [(tuning_curves(half), half.heading_seconds) for half in halves]
    one, other = (preferred_direction(*each) for each in curves)
    tuned = np.minimum(*(np.nan_to_num(mean_vector_length(*each)) for each in curves)) >= TUNED
    parts = [rate_maps(sums_of(part)) for part in (first, early & ~first)]
    return {
        "map correlation, halves of the time before": (np.median, correlate(*parts)),
        "map correlation, before and after": (np.median, alike[:, 0]),
        "map correlation, turned back by the best turn": (np.median, correlate(before, after)),
        "map correlation, so turned, with another cell": (np.median, correlate(before, other_cell)),
        "best turn of maps, rad": (_best_turn, alike),
        "turn of preferred directions, rad": (
            lambda angle: float(np.angle(np.exp(1j * angle).sum())),
            wrap(other - one)[tuned],
        ),
    }


def _best_turn(alike: np.ndarray) -> float:
    """The turn, rad in -pi to pi, with the largest median of the correlations [n, turns]."""
    return float(wrap(TURNS[np.argmax(np.median(alike, axis=0))])) if len(alike) else np.nan


def _bootstrap(
    values: np.ndarray, statistic: _Statistic, draws: int, random: np.random.Generator
) -> np.ndarray:
    """[1 + draws] a statistic of the values [n, ...] and of draws of them with repeats; NaN without any."""
    if not len(values):
        return np.full(1 + draws, np.nan)
    at = random.integers(0, len(values), (draws, len(values)))
    return np.array([statistic(values), *(statistic(values[each]) for each in at)])


def _above(model: np.ndarray, data: np.ndarray, draws: int, random: np.random.Generator) -> np.ndarray:
    """[1 + draws] the probability that one of the data [n] exceeds one of the model [m], ties as half."""

    def share(lower: np.ndarray, upper: np.ndarray) -> float:
        ordered = np.sort(lower)
        ranks = [np.searchsorted(ordered, upper, side) for side in ("left", "right")]
        return float(np.mean(ranks) / len(lower))

    drawn = (
        share(*(each[random.integers(0, len(each), len(each))] for each in (model, data)))
        for _ in range(draws)
    )
    return np.array([share(model, data), *drawn])


def _interval(drawn: np.ndarray, is_angle: bool = False) -> Interval:
    """The first of the values, and the ends of the 95 % interval of the others; angles about the first."""
    first, rest = float(drawn[0]), drawn[1:]
    if is_angle:
        first = float(wrap(first))
        rest = first + wrap(rest - first)
    low, high = np.quantile(rest, [0.025, 0.975]).tolist()
    return first, low, high
