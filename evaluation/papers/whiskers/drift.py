"""Coloured noise, drift and creep of real whiskers, and of the simulator's with `HALL_BASELINE`.

The magnetic whiskers of an arm in clutter are divided: the settings of `HALL_BASELINE` are read off `FIT`
and compared with those of `CHECK`. Beside them stand the simulator's noise with these settings and without
(white), and a whisker read by a camera.

`simulate_stream` makes hours of drifting whiskers from a short record: drift and noise are fitted to its free
whiskers, and its contacts are spliced in at known times.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.ndimage import uniform_filter1d
from scipy.signal import lfilter

from evaluation.papers.figure import Figure
from evaluation.papers.tables.markdown import table_lines
from evaluation.papers.tables.recordings import REACH, require_recordings
from robot.recordings.real_whiskers import read_columns, read_reach
from robot.simulation.head.baseline import HALL_BASELINE, Baseline, BaselineConfig
from tactile.base.random_streams import stream
from tactile.calibration import estimate_drift, estimate_noise
from tactile.contact_stream import find_fixed_contacts

CAMERA = "real_touch/actuated_whisker_purdue/data/airflow/airflowDemoData.csv"
RATE = 200.0
"""Readings per second; the file has no time, the authors assume this rate."""
START = 100
"""First readings, which are free: later ones beyond 20 of their standard deviations are contacts'."""
SETTLING = 0.3
"""Time after a contact in which a whisker swings, s."""


FIT = (4, 5), (0, 1, 3)
"""Whiskers by their place in the record: free ones (left 4 and 5), and those that bend and are free again at
the end (left 0, 1 and 3)."""
CHECK = (6, 7), (8, 9, 10)
"""Left 6 and 7; right 0, 1 and 2."""
LAGS = np.arange(1, 11)
"""Lags of the autocorrelation, in samples."""
COLOURED = 0.1
"""Correlation of neighbours from which on noise is not called white."""
TRACKED = 50
"""Samples whose mean is subtracted where the noise alone is measured."""
SPANS = np.unique(np.geomspace(20, 1600, 25).astype(int))
"""Time spans over which the drift is drawn, in samples."""
GROWTH = 4.0
"""Time over which the growth of the drift is measured, s; a third of the record."""
BLOCK = 100
"""Samples whose mean shows the baseline."""
AXIS = 1
"""The axis into which these whiskers are bent."""
SIMULATED, COPIES = 200, 20
"""Simulated free whiskers, and simulated copies of each real whisker that bends."""


class _FreeFigures(NamedTuple):
    """Figures of free whiskers, pooled over their channels.

    Attributes:
        correlation: at `LAGS`, the median channel. change: rms change over `SPANS`, in noise sds.
        time: in which the correlation falls to 1/e, s, as between neighbours; None for white noise.
        drift: in noise sds per square root of a second. range: least and largest range of the baseline of a
            channel, in noise sds.
    """

    correlation: np.ndarray
    change: np.ndarray
    time: float | None
    drift: float
    range: tuple[float, float]


Creep = tuple[float, np.ndarray, np.ndarray]
"""Of whiskers after their last contact: time of the creep, s; share of each whisker with that time; [K, T]
distance of each whisker from where it settles, as a share of its mean deflection in contact, from its release
on, `RATE` a second."""
DriftResult = tuple[dict[str, _FreeFigures], dict[str, Creep]]
"""Figures of free whiskers and after contacts, by source."""


def _measure_drift(folder: Path) -> DriftResult:
    """The figures of real and simulated whiskers."""
    reach, camera = require_recordings(folder, REACH, CAMERA)
    signal = read_reach(reach).signal
    free: dict[str, _FreeFigures] = {}
    creep: dict[str, Creep] = {}
    for name, (untouched, bending) in (("fitted", FIT), ("checked", CHECK)):
        free[name] = free_figures(signal[:, untouched].reshape(len(signal), -1), RATE)
        creep[name] = creep_figures(signal[:, bending], None if name == "fitted" else creep["fitted"][0])
    for name, config in (("simulated", HALL_BASELINE), ("control: white noise", BaselineConfig())):
        noise = simulate_free(config, len(signal))
        free[name] = free_figures(noise.reshape(len(signal), -1), RATE)
        bent = np.repeat(signal[:, FIT[1] + CHECK[1]], COPIES, axis=1)
        creep[name] = creep_figures(_simulate_bent(config, bent), creep["fitted"][0])
    held, _ = read_columns(camera, ("Time", "dx", "dy"))
    held = held[(held[:, 0] > 19) & (held[:, 0] < 23.5)]  # pressed without moving
    free["camera"] = free_figures(held[:, 1:], len(held) / np.ptp(held[:, 0]))
    return free, creep


def _mean_change(record: np.ndarray, lags: np.ndarray) -> np.ndarray:
    """[L, C] half the mean square change over each lag of records [T, C]."""
    return np.array([((record[lag:] - record[:-lag]) ** 2).mean(axis=0) / 2 for lag in lags])


def free_figures(record: np.ndarray, rate: float) -> _FreeFigures:
    """The figures of whiskers that touch nothing.

    Args:
        record: [T, C] channels. rate: readings per second.
    """
    quick = record - uniform_filter1d(record, TRACKED, axis=0, mode="nearest")
    noise = quick.var(axis=0)
    correlation = np.median(1 - _mean_change(quick, LAGS) / noise, axis=1)
    span = np.array([min(round(GROWTH * rate), len(record) // 2)])
    grown = (2 * _mean_change(record, span)[0] / noise - 2).mean() * rate / span[0]
    level = uniform_filter1d(record, BLOCK, axis=0)[BLOCK // 2 : -BLOCK // 2] / np.sqrt(noise)
    extent, spans = np.ptp(level, axis=0), SPANS[: np.searchsorted(SPANS, len(record) // 2)]
    change = np.sqrt(np.mean(2 * _mean_change(record, spans) / noise, axis=1))
    time = float(-1 / (rate * np.log(correlation[0]))) if correlation[0] > COLOURED else None
    least, largest = float(extent.min()), float(extent.max())
    return _FreeFigures(correlation, change, time, float(np.sqrt(max(grown, 0.0))), (least, largest))


def creep_figures(signal: np.ndarray, time: float | None) -> Creep:
    """The figures of whiskers after their last contact: a fit of creep, level and slope to their free end.

    Args:
        signal: [T, W, 3]. time: of the creep, s; None: the one that fits best.
    """
    touches = find_fixed_contacts(signal[:START], signal)
    times = np.geomspace(0.1, 3, 60) if time is None else np.array([time])
    fits = [[_creep_fit(signal[:, w], touches[:, w], time) for w in range(signal.shape[1])] for time in times]
    misfit = [sum(fit[1] for fit in row) for row in fits]
    best = int(np.argmin(misfit))
    shares = np.array([fit[0] for fit in fits[best]])
    offset = [fit[2] for fit in fits[best]]
    length = min(map(len, offset))
    return float(times[best]), shares, np.array([row[:length] for row in offset])


def _creep_fit(signal: np.ndarray, touches: np.ndarray, time: float) -> tuple[float, float, np.ndarray]:
    """Share, rms misfit in noise sds, and the offset after release of one whisker [T, 3] that touches [T]."""
    noise = signal[:START].std(axis=0)
    deviation = (signal - signal[:START].mean(axis=0)) / noise
    bend = np.where(touches, deviation[:, AXIS], 0.0)
    keep = np.exp(-1 / (RATE * time))
    crept = lfilter([1 - keep], [1, -keep], bend)
    release = int(np.flatnonzero(touches)[-1]) + 1
    rows = np.arange(release + round(SETTLING * RATE), len(signal))
    model = np.column_stack([crept[rows], np.ones(len(rows)), (rows - rows[0]) / RATE])
    weights, _, _, _ = np.linalg.lstsq(model, deviation[rows, AXIS])
    misfit = float(np.sqrt(np.mean((deviation[rows, AXIS] - model @ weights) ** 2)))
    after = np.arange(release, len(signal))
    settled = weights[1] + weights[2] * (after - rows[0]) / RATE
    return float(weights[0]), misfit, (deviation[after, AXIS] - settled) / bend[touches].mean()


def simulate_free(config: BaselineConfig, count: int) -> np.ndarray:
    """[T, W, 2] noise and drift of simulated whiskers that touch nothing, in noise sds."""
    sensor = Baseline(config, 1.0, RATE, SIMULATED, seed=0)
    white = np.random.default_rng(1).standard_normal((1, count, SIMULATED, 2))
    return (sensor.colour(white) + sensor.wander(np.zeros_like(white)))[0]


def _simulate_bent(config: BaselineConfig, signal: np.ndarray) -> np.ndarray:
    """[T, W, 3] simulated whiskers, bent as real ones [T, W, 3] are while they touch, in noise sds."""
    noise = signal[:START].std(axis=0)
    deviation = (signal - signal[:START].mean(axis=0)) / noise
    bend = np.where(find_fixed_contacts(signal[:START], signal), deviation[..., AXIS], 0.0)
    seen = np.zeros(signal.shape)
    seen[..., :2] = np.stack([np.zeros_like(bend), bend], axis=-1)
    sensor = Baseline(config, 1.0, RATE, signal.shape[1], seed=0)
    white = np.random.default_rng(2).standard_normal(seen.shape)
    seen[..., :2] += (sensor.colour(white[None, ..., :2]) + sensor.wander(seen[None, ..., :2]))[0]
    seen[..., 2] = white[..., 2]
    return seen


LABELS = {
    "fitted": "real, fitted: left 4, 5 (free); left 0, 1, 3 (bent)",
    "checked": "real, checked: left 6, 7; right 0, 1, 2",
    "simulated": "simulated with these settings",
    "camera": "control: a whisker read by a camera, held for 4.5 s",
}
COLUMNS = (
    "whiskers", "correlation of neighbours", "its time", "drift, sd / sqrt(s)", "range of the baseline, sd",
    "creep: share of the bend (range)", "its time",
)  # fmt: skip
CAVEATS = (
    "All real noise of the magnetic whiskers is coloured, but two readings apart its correlation is below 0, "
    "where that of the simulator is above. The real drift is smoother than a random walk: the simulator's is "
    "larger over less than 2 s. It ends when the arm stands still; whether it grows on after these 12 s the "
    "recording does not say. The creep of the right array is smaller than that of the left, from which the "
    "setting is taken."
)


def _table_drift(result: DriftResult) -> list[str]:
    """The lines of the table."""
    rows = []
    for name, free in result[0].items():
        cells = [LABELS.get(name, name), f"{free.correlation[0]:.2f}"]
        cells += ["white" if free.time is None else f"{1000 * free.time:.1f} ms", f"{free.drift:.2f}"]
        cells.append("{:.1f}-{:.1f}".format(*free.range))
        if creep := result[1].get(name):
            time, shares, _ = creep
            cells.append(f"{np.median(shares):.3f} ({shares.min():.3f}-{shares.max():.3f})")
            cells.append(f"{time:.2f} s")
        rows.append([*cells, *["-"] * (len(COLUMNS) - len(cells))])
    return table_lines([], COLUMNS, rows, [CAVEATS])


def _draw_drift(result: DriftResult, png: Path) -> None:
    """Draws autocorrelation, drift and creep of real and simulated whiskers."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13, 4.2), layout="constrained")
    colours, drift, creep = figure.subplots(1, 3)
    styles = {
        "fitted": {"color": "tab:blue", "label": "real, fitted"},
        "checked": {"color": "tab:cyan", "label": "real, checked"},
        "simulated": {"color": "tab:red", "label": "simulated"},
        "control: white noise": {"color": "grey", "linestyle": "--", "label": "simulated, white noise"},
    }
    for name, style in styles.items():
        free = result[0][name]
        colours.plot(1000 * LAGS / RATE, free.correlation, marker=".", **style)
        drift.semilogx(SPANS[: len(free.change)] / RATE, free.change, **style)
        offset = 100 * np.median(result[1][name][2], axis=0)
        smooth = np.convolve(offset, np.ones(20) / 20, "valid")
        creep.plot((np.arange(len(smooth)) + 10) / RATE, smooth, **style)
    colours.set(xlabel="lag (ms)", ylabel="autocorrelation", title="Noise of free whiskers")
    drift.set(xlabel="time span (s)", ylabel="rms change (noise sd)", title="Drift of free whiskers")
    creep.axvspan(0, SETTLING, color="0.9", lw=0)
    creep.set(xlim=(0, 3.4), ylim=(-0.5, 2.5), xlabel="time after the last contact (s)")
    creep.set(ylabel="offset (% of the deflection)", title="Creep after a contact (grey: swinging)")
    colours.legend()
    for axes in (colours, drift, creep):
        axes.grid(alpha=0.3)
    figure.savefig(png, dpi=130)


FIGURE = Figure("Noise, drift and creep of whiskers", _measure_drift, _table_drift, _draw_drift)


Decide = Callable[[np.ndarray], np.ndarray]
"""Contact [T, W] bool of the next samples [T, W, K] of a stream."""


Snippet = tuple[np.ndarray, slice]
"""A contact cut out of a record: [S, K] samples from the baseline, with some before and after the contact;
and the samples of the contact."""
Plant = tuple[slice, slice]
"""The samples of a snippet in a block of a stream, and of its contact."""


def fit_free_model(record: np.ndarray) -> np.ndarray:
    """The model of a free channel, a random walk and first-order autoregressive noise: [3, K] standard
    deviation of the noise, correlation of its neighbouring samples, standard deviation of the walk's step.

    Args:
        record: [T, W, K] of whiskers that touch nothing; each figure is the largest of theirs.
    """
    noise = estimate_noise(record)
    difference = np.median(np.diff(record, axis=0) ** 2, axis=0) / 0.45494 / 2
    correlation = np.clip(1 - difference / noise**2, 0.0, 0.95)
    return np.array([each.max(axis=0) for each in (noise, correlation, estimate_drift(record))])


def simulate_stream(
    model: np.ndarray, snippets: Sequence[Snippet], whiskers: int, blocks: int, block: int, seed: int
) -> Iterator[tuple[np.ndarray, list[Plant]]]:
    """A drifting stream in blocks, in each of which every whisker has one contact of a drawn snippet.

    Args:
        model: of `fit_free_model`.

    Yields:
        [block, W, K] samples, and each whisker's contact.
    """
    size, correlations, step = model
    random, shape = stream(seed, "spliced hours"), (block, whiskers, len(size))
    level, memory = np.zeros(shape[1:]), np.zeros(shape[1:])
    white = size * np.sqrt(1 - correlations**2)
    for _ in range(blocks):
        walk = level + np.cumsum(step * random.standard_normal(shape), axis=0)
        level, noise = walk[-1], np.empty(shape)
        push = white * random.standard_normal(shape)
        for channel, correlation in enumerate(correlations):
            start = correlation * memory[None, :, channel]
            noise[..., channel], _ = lfilter([1.0], [1.0, -correlation], push[..., channel], axis=0, zi=start)
        memory = noise[-1]
        planted = []
        for whisker in range(whiskers):
            deviation, contact = snippets[int(random.integers(len(snippets)))]
            first = int(random.integers(block - len(deviation)))
            whole = slice(first, first + len(deviation))
            noise[whole, whisker] = deviation
            planted.append((whole, slice(first + contact.start, first + contact.stop)))
        yield walk + noise, planted


def score_stream(
    rules: Mapping[str, Decide], blocks: Iterable[tuple[np.ndarray, list[Plant]]]
) -> dict[str, np.ndarray]:
    """Scores rules by name on the same stream of planted contacts.

    Returns:
        [5] counts of each rule: planted contacts, each longer than 0.1 s; missed of them, with less than half
        found; stretches found in contact with no snippet at that time; their samples; samples outside
        snippets. Those of several parts of a stream add up.
    """
    scores = dict.fromkeys(rules, np.zeros(5, int))
    for samples, planted in blocks:
        for name, decide in rules.items():
            contact = decide(samples)
            free, missed = np.ones_like(contact), 0
            for whisker, (snippet, touching) in enumerate(planted):
                missed += int(contact[touching, whisker].mean() < 0.5)
                free[snippet, whisker] = False
            wrong = contact & free
            false = np.count_nonzero(np.diff(wrong.astype(np.int8), prepend=0, axis=0) == 1)
            scores[name] = scores[name] + [len(planted), missed, false, wrong.sum(), free.sum()]
    return scores
