"""Contact on an arm in clutter: 14 magnetic whiskers that drift, and a dirty free record.

Settings were chosen on the first half of the rows and confirmed on the second.
"""

from __future__ import annotations

from itertools import islice
from pathlib import Path

import numpy as np
from scipy.ndimage import uniform_filter1d

from ratslam.experiments.real.annotations import FOLDER, Label, merge_marks, read_annotators, score_contacts
from ratslam.experiments.real.contact_page import ContactResult, MarkResult, draw_contacts, list_contacts
from ratslam.experiments.real.figure import REACH, RealFigure, require_recordings
from ratslam.experiments.real.spliced_hours import (
    Decide,
    Snippet,
    StreamScore,
    add_scores,
    fit_free_model,
    score_stream,
    simulate_stream,
)
from robot.recordings.whiskers.reach import WHISKERS, ReachConfig, read_reach
from tactile.base.samples import true_runs
from tactile.features.contact_stream import (
    StreamState,
    Touch,
    date_back,
    find_contacts,
    find_fixed_contacts,
    start_stream,
)
from tactile.features.free_record import FreeBaseline, calibrate_free

CONTACT_SDS = 20.0
"""Departure that makes a contact of the record one to find in the spliced hours: the paper's."""
SHORTEST = 20
"""Rows of the shortest contact that must be found: 0.1 s."""
SETTLING = 60
"""Rows after a contact in which the whisker still rings."""
RULES = ("tracked", "20 sd")
HOURS = (1, 5, 20)
BLOCK = 2400
"""Rows in which every whisker has one contact, in the spliced hours: 12 s."""


def measure_contacts(data: Path) -> ContactResult:
    """Contacts of the record, by the tracked baseline and by the 20-sd rule.

    Raises:
        InputError: the record or an annotation is missing or damaged.
    """
    config = ReachConfig(file=require_recordings(data, REACH)[0])
    record = read_reach(config.file)
    signal, first = record.signal, record.signal[: config.free_rows]
    free = calibrate_free(config.free, first)
    touch, baseline = _follow(config, free, signal)
    fixed = find_fixed_contacts(first, signal)
    dirty = np.array([any(w == one.whisker for one in free.dirty) for w in range(len(WHISKERS))])
    away = np.abs(signal - free.mean).max(axis=0) / free.noise
    never = (away < CONTACT_SDS).all(axis=1)
    contact = touch == Touch.CONTACT
    marks = read_annotators(FOLDER, WHISKERS, len(signal))
    return ContactResult(
        whiskers=WHISKERS,
        config=config,
        record=record,
        free=free,
        away=away.max(axis=1),
        contact=contact,
        bent=(touch == Touch.BENT).any(axis=0),
        fixed=fixed,
        baseline=baseline,
        never=never,
        tripled={name: _score_tripled(config, free, signal, contact, name) for name in RULES},
        hours=_score_hours(config, free, signal, never, dirty),
        marks=_score_marks(marks, {"tracked": contact, "20 sd": fixed}, ~never & ~dirty),
    )


def _follow(config: ReachConfig, free: FreeBaseline, signal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """[T, W] states, each contact from its first row on, and the baselines [T, W, K]."""
    plan, state = start_stream(config.contact, free, config.rate)
    parts, baselines = [], []
    for first in range(0, len(signal), plan.block):
        baselines.append(np.repeat(state.baseline[None], len(signal[first : first + plan.block]), axis=0))
        state, touch = find_contacts(plan, state, signal[first : first + plan.block])
        parts.append(touch)
    return date_back(plan, np.concatenate(parts)), np.concatenate(baselines)


def _decide(config: ReachConfig, free: FreeBaseline, name: str) -> Decide:
    """A rule by name, for a stream whose baseline and noise are known at its start."""
    if name == "20 sd":
        return lambda samples: (np.abs(samples - free.mean) > CONTACT_SDS * free.noise).any(axis=-1)
    plan, start = start_stream(config.contact, free, config.rate)
    states: list[StreamState] = [start]

    def decide(samples: np.ndarray) -> np.ndarray:
        states[0], touch = find_contacts(plan, states[0], samples)
        return touch == Touch.CONTACT

    return decide


def _score_tripled(
    config: ReachConfig, free: FreeBaseline, signal: np.ndarray, contact: np.ndarray, name: str
) -> StreamScore:
    """Contacts of the record with each whisker's baseline times 3, against those of the record as it is."""
    drift = np.stack([baseline_of(signal[:, w], contact[:, w]) for w in range(signal.shape[1])], axis=1)
    found = _decide(config, free, name)(signal + 2 * (drift - drift[0]))
    contacts = missed = false = wrong = 0
    for whisker in range(signal.shape[1]):
        real, seen = contact[:, whisker], found[:, whisker]
        long = [run for run in true_runs(real) if run[1] - run[0] >= SHORTEST]
        contacts += len(long)
        missed += sum(bool(seen[first:last].mean() < 0.5) for first, last in long)
        near = np.convolve(real, np.ones(2 * SHORTEST + 1), "same") > 0
        false += sum(not near[first:last].any() for first, last in true_runs(seen))
        wrong += int((seen & ~near).sum())
    return StreamScore(contacts, missed, false, wrong, int((~contact).sum()))


def baseline_of(signal: np.ndarray, contact: np.ndarray) -> np.ndarray:
    """[T, K] low-passed baseline of one whisker: a mean over a second, straight across its contacts.

    Args:
        signal: [T, K]. contact: [T] bool.
    """
    disturbed = np.convolve(contact, np.ones(SETTLING), "full")[: len(contact)] > 0
    rows = np.arange(len(signal))
    free = rows[~disturbed]
    across = np.stack([np.interp(rows, free, channel[free]) for channel in signal.T], axis=1)
    return uniform_filter1d(across, 200, axis=0, mode="nearest")


def _score_hours(
    config: ReachConfig, free: FreeBaseline, signal: np.ndarray, never: np.ndarray, dirty: np.ndarray
) -> dict[int, dict[str, StreamScore]]:
    """The rules' scores after each number of `HOURS` of one stream."""
    model = fit_free_model(signal[:, never])
    touching = np.flatnonzero(~never & ~dirty)
    snippets = [snippet for w in touching for snippet in _cut(signal[:, w], free.mean[w], free.noise[w])]
    whiskers = signal.shape[1]
    known = FreeBaseline(np.zeros(signal.shape[1:]), np.tile(model.noise, (whiskers, 1)), ())
    ends = [round(hours * 3600 * config.rate / BLOCK) for hours in HOURS]
    made = simulate_stream(model, snippets, whiskers, ends[-1], BLOCK, seed=1)
    rules = {name: _decide(config, known, name) for name in RULES}
    scores: dict[int, dict[str, StreamScore]] = {}
    total = dict.fromkeys(RULES, StreamScore(0, 0, 0, 0, 0))
    for hours, first, last in zip(HOURS, (0, *ends), ends, strict=False):
        part = score_stream(rules, islice(made, last - first))
        total = scores[hours] = {name: add_scores(total[name], part[name]) for name in RULES}
    return scores


def _cut(signal: np.ndarray, mean: np.ndarray, noise: np.ndarray) -> list[Snippet]:
    """The contacts of one whisker after which it is let go, as departures from the baseline before each."""
    smooth = uniform_filter1d(signal - mean, 4, axis=0)
    runs = true_runs((np.abs(smooth) > CONTACT_SDS * noise).any(axis=1))
    found = []
    for k, (first, last) in enumerate(runs):
        after = runs[k + 1][0] - SHORTEST if k + 1 < len(runs) else len(signal)
        if last - first >= SHORTEST and last + SETTLING <= after:
            level = signal[first - 30 : first - 10].mean(axis=0)
            part = signal[first - 15 : last + SETTLING] - level
            found.append(Snippet(part, 15, 15 + last - first))
    return found


def _score_marks(
    marks: dict[str, np.ndarray], contacts: dict[str, np.ndarray], touching: np.ndarray
) -> MarkResult | None:
    """Scores against the marks of two annotators; None unless there are two."""
    if len(marks) != 2:
        return None
    one, other = marks.values()
    agreed = merge_marks(one, other)
    return MarkResult(
        annotators=tuple(marks),
        agreement=float((one == other).mean()),
        unclear=float((agreed == Label.UNCLEAR).mean()),
        whiskers={
            name: [score_contacts(contact[:, w], agreed[:, w]) for w in range(contact.shape[1])]
            for name, contact in contacts.items()
        },
        pooled={
            name: score_contacts(contact[:, touching], agreed[:, touching])
            for name, contact in contacts.items()
        },
    )


FIGURE = RealFigure(
    "Contact on an arm in clutter, 14 whiskers", measure_contacts, list_contacts, draw_contacts
)
