"""Row: recordings of buildings in two halves, merged, and the second found in the first."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np

from evaluation.metrics.trajectory import align
from evaluation.papers.maps.localisation_metrics import (
    BUILDING,
    aligned_errors,
    exceeds,
    is_revisited,
    localisation_errors,
    nearest_steps,
)
from evaluation.papers.maps.pictures import Panel, PathPanel, draw_panels
from evaluation.papers.maps.row import Line, MapRow, MapTask
from evaluation.papers.maps.sessions import Recipe, Recorded, record
from evaluation.papers.tables.comparison import Record
from evaluation.papers.tables.recordings import metres
from ratslam.runs.settings.packaged import find_config
from ratslam.runs.settings.run_config import load_config
from tactile.base.random_streams import stream
from tactile.base.se2 import between, compose, integrate, inverse, wrap

RECORDINGS = ("intel_laser", "tuc_lecture_hall")
"""Configurations of the recordings; both need `RATSLAM_DATA`."""
RATIO = 1.2
"""Goal: ATE of the merged map, over that of the whole recording."""
FOUND, OFF = 0.8, 0.01
"""Goals: least share of revisited steps at which the robot is found; largest share of found steps that are
off."""


class Halves(NamedTuple):
    """A recording and its two halves."""

    whole: Recipe
    first: Recipe
    second: Recipe


class HalvesFigures(NamedTuple):
    """One recording.

    Attributes:
        name: of its configuration. whole, merged: ATE, m. joined: whether the halves are in one piece.
            revisited: number of steps of the second half that are revisits. found: share of these at which
            the robot was found. off: share of the found steps that are off (`BUILDING`) after the alignment
            of the map. off_by_map: share at which the map itself is, and so would be a perfect localiser.
            off_nearby: as `off`, against the nearest step of the map. shuffled: `found` and `off` with the
            second half's views or labels in random order. reckoned: share of steps that are off by odometry
            that starts at the truth. paths: true positions of the first half; true and found ones of the
            second. error: [T] error after the alignment while found, m, NaN else.
    """

    name: str
    whole: float
    merged: float
    joined: bool
    revisited: int
    found: float
    off: float
    off_by_map: float
    off_nearby: float
    shuffled: tuple[float, float]
    reckoned: float
    paths: tuple[np.ndarray, np.ndarray, np.ndarray]
    error: np.ndarray


def split_recording(name: str) -> Halves:
    """The recording of a configuration in two halves.

    Raises:
        InputError: the recording is missing or has no truth.
    """
    whole = Recipe(load_config(find_config(name)))
    middle = record(whole).log.length // 2
    return Halves(whole, whole._replace(last=middle), whole._replace(first=middle))


def measure_halves(task: MapTask) -> HalvesFigures:
    """One recording."""
    name = RECORDINGS[task.seed]
    recipes = split_recording(name)
    whole, first, second = (task.map_of(recipe) for recipe in recipes)
    recorded, steps = record(recipes.second), first.arrays.steps
    truth = recorded.truth
    with TemporaryDirectory() as folder:
        merged = task.methods.merge([first, second], Path(folder) / "merged").arrays
    localised = task.methods.localise(first, recorded)
    mixed = task.methods.localise(first, _shuffle(recorded))
    again = is_revisited(steps, truth, BUILDING)

    def shares(found: np.ndarray, pose: np.ndarray) -> tuple[float, float]:
        off = exceeds(aligned_errors(steps, pose, truth), BUILDING)
        return float(found[again].mean()), float(off[found].mean()) if found.any() else 0.0

    error = aligned_errors(steps, localised.pose, truth)[:, 0]
    said = compose(align(steps.pose, steps.truth), localised.pose)
    found = shares(localised.found, localised.pose)
    nearby = localisation_errors(steps, localised.pose, truth, BUILDING.distance)
    nearest = nearest_steps(steps, truth, BUILDING.distance)
    perfect = compose(steps.pose[nearest], between(steps.truth[nearest], truth))
    at = localised.found
    return HalvesFigures(
        name=name,
        whole=whole.arrays.ate,
        merged=merged.ate,
        joined=len(np.unique(merged.piece)) == 1,
        revisited=int(again.sum()),
        found=found[0],
        off=found[1],
        off_by_map=shares(at, perfect)[1],
        off_nearby=float(exceeds(nearby, BUILDING)[at].mean()) if at.any() else 0.0,
        shuffled=shares(mixed.found, mixed.pose),
        reckoned=_share_off_by_odometry(recorded),
        paths=(steps.truth[:, :2], truth[:, :2], np.where(localised.found[:, None], said[:, :2], np.nan)),
        error=np.where(localised.found, error, np.nan),
    )


def halves_record(one: HalvesFigures) -> Record:
    """The figures of a recording by name: ATEs, m, and shares."""
    return {
        "not_joined": not one.joined,
        "ate_merged": one.merged,
        "ate_whole": one.whole,
        "found": one.found,
        "off": one.off,
        "off_by_map": one.off_by_map,
        "off_nearby": one.off_nearby,
        "off_by_odometry": one.reckoned,
        "shuffled_found": one.shuffled[0],
        "shuffled_off": one.shuffled[1],
    }


def halves_lines(found: Sequence[HalvesFigures]) -> Iterator[Line]:
    """The lines of each recording."""
    for one in found:
        ratio = f"{metres(one.merged)} m, {one.merged / one.whole:.2f} times"
        joined = "" if one.joined else ", halves not joined"
        yield Line(
            f"{one.name}: ATE of the merged halves",
            f"{RATIO} times",
            ratio + joined,
            f"{metres(one.whole)} m whole",
        )
        yield Line(
            f"{one.name}: found at {one.revisited} revisits",
            f"{FOUND:.0%}",
            f"{one.found:.1%}",
            f"{one.shuffled[0]:.1%} in random order",
        )
        yield Line(
            f"{one.name}: found and off by 2 m or 30 degrees",
            f"{OFF:.0%}",
            f"{one.off:.1%}",
            f"{one.off_by_map:.1%} a perfect localiser there; {one.shuffled[1]:.1%} in random order; "
            f"{one.reckoned:.1%} odometry from the true start",
        )
        yield Line(
            f"{one.name}: the same against the nearest step of the map", "-", f"{one.off_nearby:.1%}", "-"
        )


def draw_halves(found: Sequence[HalvesFigures], png: Path) -> None:
    """Draws the recording in which the robot is found most, and the errors while found in all."""
    one = max(found, key=lambda each: each.found)
    paths = PathPanel(
        f"{one.name}: the second half in the map of the first",
        None,
        {"first half": one.paths[0], "second, true": one.paths[1], "second, found": one.paths[2]},
    )
    curves = {each.name: [each.error[np.linspace(0, len(each.error) - 1, 100).astype(int)]] for each in found}
    limits = {"wrong": BUILDING.distance}
    panel = Panel("error while found, m", "time in the second half, %", curves=curves, limits=limits)
    revisits, off = (
        " and ".join(f"{getattr(each, name):.1%}" for each in found) for name in ("found", "off")
    )
    line = f"Found at {revisits} of the revisits; off by 2 m or 30 degrees at {off} of the found steps."
    draw_panels(png, "Buildings, each recording in two halves", line, paths, panel)


def _shuffle(recorded: Recorded) -> Recorded:
    """The session with its views and place labels in random order."""
    log, label, views = recorded.log, recorded.log.label.copy(), recorded.log.views.copy()
    random = stream(0, "atlas.halves.shuffled")
    seen, given = np.flatnonzero(log.seen), np.flatnonzero(label >= 0)
    views[seen] = views[random.permutation(seen)]
    label[given] = label[random.permutation(given)]
    return Recorded(recorded.config, replace(log, digest=f"{log.digest}+shuffled", views=views, label=label))


def _share_off_by_odometry(recorded: Recorded) -> float:
    """Share of the steps with a true pose that are off by odometry from the first such pose."""
    known = np.isfinite(recorded.truth).all(axis=1)
    truth, path = recorded.truth[known], integrate(recorded.log.motion[:, :3])[known]
    path = compose(compose(truth[0], inverse(path[0])), path)
    error = np.column_stack([np.hypot(*(path - truth)[:, :2].T), np.abs(wrap(path[:, 2] - truth[:, 2]))])
    return float(exceeds(error, BUILDING).mean())


HALVES = MapRow(
    "Buildings in two halves",
    len(RECORDINGS),
    measure_halves,
    halves_record,
    halves_lines,
    draw_halves,
    RECORDINGS,
)
