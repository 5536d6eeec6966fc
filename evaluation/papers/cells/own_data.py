"""Recorded cells through an NWB file: scores beside other packages, decoded places, and the time it takes.

Sessions are simulated cells of known tuning, Poisson spikes on a random walk: no path that the program comes
with has spikes. The file is written by pynwb alone, as a lab would, and read as any other.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from evaluation.cells import rate_map
from evaluation.cells.analysis import analyse_cells, control_scores
from evaluation.cells.cell_comparison import compare_cells
from evaluation.cells.decoding import decode_positions
from evaluation.cells.recording import CellRecording, record_spikes
from evaluation.papers.cells.agreement import GOAL, compare_sums, difference_of, load_package, quiet
from evaluation.papers.cells.costs import on_one_core
from evaluation.papers.cells.panels import time_call
from evaluation.papers.figure import Figure, Task
from evaluation.papers.tables.markdown import table_lines
from ratslam.service.export_formats import EPOCH
from ratslam.service.own_cells import read_own_cells
from robot.simulation.rat.simulated_session import RandomWalkConfig, RatSimulation, RatSimulationConfig
from tactile.base.random_streams import stream
from tactile.base.se2 import wrap

RATE, SECONDS = 25.0, 600.0
"""Of the tracker, Hz, and of a session, s."""
PEAK, FIELD, SHARPNESS = 15.0, (0.1, 0.16), 3.0
"""Rate in the middle of a field, Hz; width of the fields, m; sharpness of headings of every other cell."""
EDGES = np.linspace(0.0, 1.0, 21)
"""Of the bins of place, m."""


class OwnSession(NamedTuple):
    """A session. Attributes: time: [T] s. truth: [T, 3] m, m, rad. spikes: of each cell its times, s."""

    time: np.ndarray
    truth: np.ndarray
    spikes: list[np.ndarray]


def draw_session(
    cells: int,
    seed: int,
    seconds: float = SECONDS,
    sharpness: float = SHARPNESS,
    wider: float = 1.0,
    turn: float = 0.0,
) -> OwnSession:
    """Poisson cells with a place field each on a random walk in a box of 1 m.

    Every other one has a preferred direction of the head, which wags about the direction of motion.

    Args:
        sharpness: of the directions; 0: no cell has one. wider: factor of the width of the fields. turn: of
            all fields and directions in the second half, round the middle of the box, rad.
    """
    walk = RatSimulation(
        RatSimulationConfig(walk=RandomWalkConfig(), seconds=seconds, rate_hz=RATE, seed=seed)
    )
    draw = stream(seed, "own cells")
    wag = 0.4 * np.sin(2 * np.pi * 0.7 * walk.time)
    truth = np.column_stack([walk.truth[:, :2], wrap(walk.truth[:, 2] + wag)])
    turned = np.where(np.arange(len(truth)) < len(truth) // 2, 0.0, turn)
    cos, sin, (x, y) = np.cos(turned), np.sin(turned), (truth[:, :2] - 0.5).T
    place, heading = np.column_stack([cos * x + sin * y, cos * y - sin * x]) + 0.5, truth[:, 2] - turned
    spikes = []
    for cell in range(cells):
        apart = place - draw.random(2)
        rate = PEAK * np.exp(-(apart**2).sum(axis=1) / (2 * (wider * draw.uniform(*FIELD)) ** 2))
        preferred = draw.uniform(-np.pi, np.pi)
        if cell % 2:
            rate *= np.exp(sharpness * (np.cos(heading - preferred) - 1))
        count = draw.poisson(rate / RATE)
        times = np.repeat(walk.time, count) + draw.uniform(-0.5, 0.5, count.sum()) / RATE
        spikes.append(np.sort(times))
    return OwnSession(walk.time, truth, spikes)


def write_session(path: Path, session: OwnSession) -> None:
    """Writes a session as a laboratory does: a position, a compass and units, by pynwb."""
    pynwb = load_package("pynwb")
    file = pynwb.NWBFile("cells of known tuning", "own", EPOCH)
    make, module = pynwb.behavior.SpatialSeries, file.create_processing_module("behavior", "tracking")
    position = make(name="position", data=session.truth[:, :2], timestamps=session.time, unit="meters")
    heading = make(name="heading", data=session.truth[:, 2], timestamps=session.time, unit="radians")
    module.add(pynwb.behavior.Position(spatial_series=position))
    module.add(pynwb.behavior.CompassDirection(spatial_series=heading))
    for times in session.spikes:
        file.add_unit(spike_times=times)
    with quiet(), pynwb.NWBHDF5IO(path, "w") as output:
        output.write(file)


_Found = list[tuple[str, str, int, float, float]]
"""Score, package, number of values, largest difference, largest value of ours."""
CELLS, SHUFFLES = 100, 100
"""Cells whose scores are compared; shuffles of the row of time."""


def compare_through_nwb(task: Task, seconds: float = SECONDS) -> _Found:
    """Maps and scores of the units of an NWB file: by us, and by three packages from the same file.

    Args:
        task: its sessions are the number of cells. seconds: of the session.

    Raises:
        InputError: a package is not installed.
    """
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "own.nwb"
        write_session(path, draw_session(task.sessions or CELLS, task.first, seconds))
        cells = read_own_cells(path).recording
        sums = rate_map.bin_activity(cells.time, cells.truth, cells.activity, EDGES, EDGES, 36)
        found: _Found = []
        for what, package, mine, theirs in _maps(path, cells, sums):
            found.append((what, package, *difference_of(mine.reshape(-1), theirs.reshape(-1))))
        return [*found, *compare_sums(sums)]


def _maps(
    path: Path, cells: CellRecording, sums: rate_map.BinnedSums
) -> Iterator[tuple[str, str, np.ndarray, np.ndarray]]:
    """What is mapped, the package, our map and theirs, without smoothing."""
    maps = rate_map.rate_maps(sums, 0.0, 1e-6)
    curves = sums.heading / np.where(sums.heading_seconds > 0, sums.heading_seconds, np.nan)
    nap = load_package("pynapple")
    with quiet():
        data = nap.load_file(str(path))
        units, position, heading = data["units"], data["position"], data["heading"]
        whole = nap.IntervalSet(position.t[0] - 0.5 / RATE, position.t[-1] + 0.5 / RATE)
        keys: dict[str, Any] = {"epochs": whole, "fs": RATE}
        place = nap.compute_tuning_curves(units, position, bins=[EDGES, EDGES], **keys)
        turned = nap.Tsd(
            t=heading.t, d=(np.asarray(heading.d) + np.pi / 36) % (2 * np.pi)
        )  # its bins begin at 0
        turn = nap.compute_tuning_curves(units, turned, bins=[np.linspace(0, 2 * np.pi, 37)], **keys)
    seen = place.attrs["occupancy"]
    yield "seconds in a bin", "pynapple", sums.seconds, seen.T / RATE
    theirs = np.where(seen > 0, np.asarray(place), np.nan)
    yield "rate map, no smoothing", "pynapple", maps, theirs.transpose(0, 2, 1)
    yield "tuning to heading", "pynapple", curves, np.asarray(turn)
    box = load_package("opexebo").analysis
    inside = {"bin_edges": (EDGES, EDGES), "limits": (0.0, 1.0, 0.0, 1.0)}
    with quiet():
        occupancy = box.spatial_occupancy(cells.time, cells.truth.T[:2], 1.0, **inside)[0]
        rates = []
        for each in np.rint(cells.activity.T / RATE).astype(int):
            tracked = np.repeat(np.column_stack([cells.time, cells.truth[:, :2]]), each, axis=0).T
            rates.append(box.rate_map(occupancy, tracked, 1.0, **inside).filled(np.nan))
    yield "seconds in a bin", "opexebo", sums.seconds, occupancy.filled(0.0)
    yield "rate map, no smoothing", "opexebo", maps, np.array(rates)
    bins = load_package("ratinabox.utils").bin_data_for_histogramming
    counted = {"extent": [0, 1, 0, 1], "dx": 0.05, "norm_by_bincount": True}
    theirs = np.array([bins(cells.truth[:, :2], weights=each, **counted)[::-1] for each in cells.activity.T])
    yield "rate map, no smoothing", "RatInABox", np.nan_to_num(maps), theirs


def _table_agreement(result: _Found) -> list[str]:
    note = (
        "Units of one NWB file in 20 x 20 place and 36 heading bins. Of maps each package reads the file or "
        "gets its spikes and positions; of scores each gets the same maps, in its own convention "
        "(`evaluation/cells/README.md`). RatInABox has 0 for bins without a visit; pynapple's first heading "
        "bin begins at 0, ours is centred there: it got headings half a bin on."
    )
    rows = (
        [*names, f"{difference:.1e}", f"{GOAL:.0e}", f"{largest:.3g}"]
        for *names, difference, largest in result
    )
    columns = ("score", "package", "values", "largest difference", "goal", "largest value")
    return table_lines([note], columns, rows)


AGREEMENT = Figure("Scores through an NWB file", compare_through_nwb, _table_agreement, None)

DECODED, WINDOW, APART, SEEDS = 64, 0.2, 5.0, 5
"""Cells; time over which spikes are counted and between samples, s; sessions."""
BINS, SMOOTHING = 30, 2.0
"""Bins a side, and the width of the Gaussian in bins, 6.7 cm."""
REGIONS = {0.5: (0.45, 0.55), 0.9: (0.85, 0.95)}
"""Regions of the posterior, and the goals of the shares of truths in them."""


def decode_sessions(task: Task, seconds: float = SECONDS) -> list[tuple[float, float, np.ndarray]]:
    """Of each session the median error and that of the shifted control, m, and the levels [n] of samples
    `APART` s apart.

    Args:
        seconds: of a session.
    """
    results = []
    for seed in task.seeds(SEEDS):
        cells = record_spikes(*draw_session(DECODED, seed, seconds, sharpness=0.0))
        found = decode_positions(cells, window=WINDOW, bins=BINS, smoothing=SMOOTHING, seed=seed)
        apart = np.unique(found.time // APART, return_index=True)[1]
        results.append((found.median, float(np.median(found.control)), found.level[apart]))
    return results


def _table_decoding(result: list[tuple[float, float, np.ndarray]]) -> list[str]:
    levels = [level for *_, level in result]
    rows = []
    for region, (low, high) in REGIONS.items():
        each = [100 * np.mean(level < region) for level in levels]
        pooled = 100 * np.mean(np.concatenate(levels) < region)
        own = ", ".join(f"{share:.0f}" for share in each)
        rows.append(
            (f"{100 * region:.0f} %", f"{pooled:.1f} %", f"{100 * low:.0f} to {100 * high:.0f} %", own)
        )
    error, control = (np.median([found[k] for found in result]) for k in (0, 1))
    note = (
        f"{DECODED} Poisson cells on a random walk, {WINDOW:g} s of spikes, samples {APART:g} s apart, "
        f"{len(levels)} sessions with {sum(map(len, levels))} samples; maps of the other nine tenths. "
        f"Median error {error:.3f} m, shifted by time {control:.3f} m."
    )
    return table_lines([note], ("region", "truths in it", "goal", "of each session"), rows)


DECODING = Figure("Regions of the decoded place", decode_sessions, _table_decoding, None)

COMPARED, PAIRS, PAIR_SHUFFLES = 40, 20, 20
"""Cells of a session, pairs of sessions of a kind, and shuffles of each cell."""
KINDS: Mapping[str, Mapping[str, float]] = {
    "alike": {},
    "fields 1.3 times as wide": {"wider": 1.3},
    "cues turn by 90 degrees": {"turn": np.pi / 2},
}
"""How the second session of a pair differs from the first."""


def compare_kinds(task: Task, seconds: float = SECONDS) -> list[tuple[str, str, float, float, float]]:
    """What `compare_cells` says of pairs of sessions of known tuning: the kind, what is asked, the median of
    the answers, the share of the pairs or scores whose answer is right, and the share that is expected, NaN
    where that depends on the number of cells.

    Args:
        seconds: of a session.
    """
    found = []
    for kind, changed in KINDS.items():
        rows = []
        for seed in task.seeds(PAIRS):
            pair = (
                record_spikes(*draw_session(COMPARED, seed, seconds)),
                record_spikes(*draw_session(COMPARED, seed + 500, seconds, **changed)),
            )
            compared = compare_cells(*pair, (seconds / 2, seconds / 2), PAIR_SHUFFLES, draws=500, seed=seed)
            rows.append({row.score: row for row in compared})
        if kind == "alike":
            each = [row.difference for pairs in rows for row in pairs.values()]
            held = [low <= 0 <= high for _, low, high in each if np.isfinite(low)]
            found.append((kind, "intervals of differences that hold 0", np.nan, float(np.mean(held)), 0.95))
            continue
        if "wider" in changed:
            answers = [pairs["field_area"].difference for pairs in rows]
            right = [low > 0 for _, low, _ in answers]
            asked, expected = "field area, m², is larger beyond the interval", np.nan
        else:
            answers = [pairs["best turn of maps, rad"].difference for pairs in rows]
            right = [low - 0.1 <= np.pi / 2 <= high + 0.1 for _, low, high in answers]
            asked, expected = "turn of maps, rad, within 0.1 of the interval", 1.0
        middle = float(np.median([first for first, *_ in answers]))
        found.append((kind, asked, middle, float(np.mean(right)), expected))
    return found


def _table_comparison(result: list[tuple[str, str, float, float, float]]) -> list[str]:
    note = (
        f"Pairs of sessions of {COMPARED} Poisson cells of known tuning, {PAIR_SHUFFLES} shuffles of each; a "
        "pair has two walks, two draws of cells and two of spikes. Intervals are over cells."
    )
    rows = []
    for kind, asked, middle, *shares in result:
        shown = ["-" if np.isnan(share) else f"{100 * share:.0f} %" for share in shares]
        rows.append([kind, asked, "-" if np.isnan(middle) else f"{middle:.3g}", *shown])
    return table_lines([note], ("second session", "asked", "median answer", "right", "expected"), rows)


COMPARISON = Figure("Recorded cells beside others", compare_kinds, _table_comparison, None)

COST_CELLS = 500


def measure_scoring(task: Task, seconds: float = SECONDS, shuffles: int = SHUFFLES) -> tuple[str, list[Any]]:
    """What is measured, as a sentence; processor and wall time, s, of reading an NWB file, of all scores, and
    of all shuffled controls.

    Args:
        task: its sessions are the number of cells. seconds: of the session. shuffles: of each cell.
    """
    count = task.sessions or COST_CELLS
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "own.nwb"
        write_session(path, draw_session(count, task.first, seconds))
        cells = read_own_cells(path).recording
        with on_one_core() as found:
            calls: dict[str, Callable[[], object]] = {
                "reading the NWB file": partial(read_own_cells, path),
                "all scores": partial(analyse_cells, cells),
                "all controls": partial(control_scores, cells, shuffles),
            }
            times = [(name, *(f"{taken:.1f}" for taken in time_call(call))) for name, call in calls.items()]
    note = (
        f"{count} units, a session of {seconds:.0f} s at {RATE:g} Hz, {shuffles} shuffles of each. {found[0]}"
    )
    return note, times


SCORING = Figure(
    "What scoring one's own cells costs",
    measure_scoring,
    lambda result: table_lines([result[0]], ("part", "processor s", "wall s"), result[1]),
    None,
)
