"""The figure of theta cycles: one belief, and spikes of two hypotheses about how it is held.

A robot stands in one of two rooms that look alike, until a difference tells them apart. The belief of the
network is the same for both hypotheses: place cells fire by all of it at all times, or each theta cycle
holds one sample of it (Ujfalussy & Orban 2022, eLife 11: e74058). The mean over cycles is the same, so rate
maps cannot tell them apart; `evaluation.cells.theta_cycles` can, while there are two packets.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from evaluation.cells.recording import CellRecording
from evaluation.cells.theta_cycles import cycle_contrast
from evaluation.papers.cells import belief_world as worlds
from evaluation.papers.cells.belief_rows import DIFFERENCE, alike_rooms
from evaluation.papers.cells.panels import name_panel, panel_grid, spread_dots
from evaluation.papers.figure import Figure, Task
from evaluation.papers.tables.markdown import table_lines
from evaluation.plots import style
from ratslam.service.spikes import SpikeConfig, draw_spikes, sample_cycles

THETA, UPDATE = 8.0, 0.5
"""Cycles per second; duration of an update, s."""
FIELD = 0.1
"""Standard deviation of the fields of the place cells, m."""
CYCLES, LEAST = 10_000, 0.01
"""Cycles from one held belief; share of it from which a bin counts."""
SAMPLED, HELD = "one sample a cycle", "all of the belief at all times"
TWO, ONE = "two packets", "one packet (control)"
COLOURS = {SAMPLED: style.VERMILLION, HELD: style.BLUE}


class _Theta(NamedTuple):
    """contrast: [n] of n sessions by stretch and by hypothesis. divergence: [n] nats, of the mean of `CYCLES`
    cycles from the belief that they were drawn from, over its bins of at least `LEAST`."""

    contrast: Mapping[str, Mapping[str, np.ndarray]]
    divergence: np.ndarray


def measure_theta(task: Task) -> _Theta:
    """The contrast of successive cycles under both hypotheses, and how well cycles hold the belief."""
    rows: dict[str, dict[str, list[float]]] = {stretch: {SAMPLED: [], HELD: []} for stretch in (TWO, ONE)}
    divergence = []
    for seed in task.seeds(20):
        world = alike_rooms(seed)
        belief = worlds.network(world)[:, :-1]
        divergence.append(cycle_divergence(belief[DIFFERENCE - 1], seed))
        for stretch, shown in ((TWO, belief[:DIFFERENCE]), (ONE, belief[DIFFERENCE + 12 :])):
            for name in rows[stretch]:
                rows[stretch][name].append(_contrast(world.poses[:, :2], shown, name == SAMPLED, seed))
    contrast = {
        stretch: {name: np.array(each) for name, each in names.items()} for stretch, names in rows.items()
    }
    return _Theta(contrast, np.array(divergence))


def cycle_divergence(belief: np.ndarray, seed: int, cycles: int = CYCLES) -> float:
    """Kullback-Leibler divergence of the mean of so many cycles, drawn from a belief [N] that is held, from
    that belief, over its bins of at least `LEAST`, nats."""
    drawn = sample_cycles(np.arange(cycles) / THETA, np.tile(belief, (cycles, 1)), THETA, seed)
    mean = np.bincount(drawn[drawn >= 0], minlength=len(belief)) / cycles
    large = belief >= LEAST
    shares = [each[large] / each[large].sum() for each in (belief, np.maximum(mean, 1 / cycles))]
    return float(np.sum(shares[0] * np.log(shares[0] / shares[1])))


def _contrast(place: np.ndarray, belief: np.ndarray, sampled: bool, seed: int) -> float:
    """The contrast of cycles of place cells at all view cells [N, 2] that read a belief [T, N]."""
    steps = round(UPDATE * THETA)  # one for each cycle
    held = np.repeat(belief, steps, axis=0)
    time = np.arange(len(held) + 1) / THETA
    held = np.vstack([held, held[-1:]])
    apart = ((place[:, None] - place[None]) ** 2).sum(axis=2)
    tuning = np.exp(-apart / (2 * FIELD**2))
    if sampled:
        drawn = sample_cycles(time, held, THETA, seed)
        held = (drawn[:, None] == np.arange(len(place))).astype(float)
    count, unknown = len(time), np.full((len(time), 3), np.nan)
    recording = CellRecording(
        (len(place), 1, 1), 1.0, time, unknown, unknown, np.zeros(count), np.zeros(count, np.int32),
        np.arange(len(place)), held @ tuning, None,
    )  # fmt: skip
    spikes = draw_spikes(recording, 1.0, SpikeConfig(seed=seed))
    return cycle_contrast(spikes.times, place, 1 / THETA, 0.0)


def separation(sampled: np.ndarray, held: np.ndarray) -> float:
    """Area under the curve of hits over false alarms: the probability that a session of the first kind has
    the larger contrast, a tie counting half."""
    return float(((sampled[:, None] > held) + 0.5 * (sampled[:, None] == held)).mean())


def _table_theta(result: _Theta) -> list[str]:
    columns = ("belief", f"contrast, {SAMPLED}", HELD, "AUC")
    rows = []
    for stretch, names in result.contrast.items():
        spread = (f"{np.median(each):.2f} ({each.min():.2f} to {each.max():.2f})" for each in names.values())
        rows.append([stretch, *spread, f"{separation(names[SAMPLED], names[HELD]):.3f}"])
    above = [
        f"{len(result.divergence)} pairs of rooms; {THETA:g} cycles a second, place cells of {FIELD:g} m at"
        " all view cells. Contrast: log of the mean squared distance between fields of two spikes of"
        " successive cycles over that of one cycle; median, lowest and highest. Goal: AUC of at least 0.95"
        " while there are two packets.",
        f"The mean of {CYCLES:,} cycles is the belief they were drawn from: divergence at most"
        f" {result.divergence.max():.4f} nats over bins of at least {LEAST:.0%} (goal: 0.01).",
    ]
    below = "Not shown: real spikes; sweeps within a cycle, refractory periods and other noise lower it."
    return table_lines(above, columns, rows, [below])


def _draw_theta(result: _Theta, png: Path) -> None:
    """The contrast of each session."""
    auc = separation(*(result.contrast[TWO][name] for name in (SAMPLED, HELD)))
    line = f"Contrast of successive cycles; AUC {auc:.3f} while there are two packets. Dots: sessions."
    figure, axes = panel_grid("Is a theta cycle one sample of the belief?", line, 1, 2, height=2.4)
    for panel, (stretch, names) in zip(axes[0], result.contrast.items(), strict=True):
        for at, (name, values) in enumerate(names.items()):
            spread_dots(panel, [at], [values.tolist()], COLOURS[name])
        panel.set(xlim=(-0.5, 1.5), xticks=[0, 1], xticklabels=["one sample", "all"])
        name_panel(panel, stretch, "", "contrast")
    figure.savefig(png)


FIGURE = Figure("Theta cycles: samples of the belief, or all of it", measure_theta, _table_theta, _draw_theta)
