"""Merges saved maps of one sensor into one, and refuses maps that hold the same session."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from evaluation.artifacts.run_reader import MERGE_REPORT as REPORT
from ratslam.core.session import Session
from ratslam.mapping.map import KeyframeMap
from ratslam.methods.map_file import NAME, digest_of
from ratslam.methods.recall import RecallBackend
from ratslam.places.difference import overlap, remembered
from ratslam.places.joining import Stretches, join_all
from ratslam.places.map_views import MapViews
from ratslam.places.union import renew_experiences, unite
from ratslam.runs.estimate import START
from ratslam.runs.map_results import write_merged_results
from ratslam.runs.map_settings import assignments, differing_settings, settings_of_map
from ratslam.runs.saved_map import SavedMap, read_map, write_map
from ratslam.runs.settings.strict_yaml import dump
from tactile.base.errors import InputError
from tactile.base.files import make_new_file, new_folder


def merge_maps(
    paths: Sequence[Path], output: Path, report: Callable[[str], None] = lambda _: None
) -> dict[str, Any]:
    """Writes one map of several sessions with one sensor; the order of `paths` does not matter.

    Args:
        output: a new map file (`.npz`), or a new folder for it with its trajectory and graph. It appears
            complete, at the end. report: called with sentences about the progress.

    Returns:
        what was merged, as JSON. maps: the inputs in the order of their steps in the merged map. steps: of
        each. joins: what joined pieces, in order (`Join`), with the numbers of the maps that had them.
        pieces: for each piece of the merged map the numbers of the maps with steps in it. keyframes: not
        merged, of the merged map; keyframes_before: of all maps together. settings: of the method, by name,
        that are not the same in all maps, with the value in each; those of the first were taken.

    Raises:
        InputError: a map cannot be read or merged, or the output exists.
    """
    maps = sorted((read_map(path, report) for path in paths), key=lambda one: one.digest)
    check_mergeable(maps)
    session = maps[0].open_session()
    made, backend = _keyframes_of(maps[0], session.map), session.backend
    assert isinstance(backend, RecallBackend)
    before, owner = made.state.count, [0] * _stretches(made)
    tried: set[tuple[Stretches, Stretches]] = set()
    joins: list[dict[str, Any]] = []

    def join() -> None:
        for found in join_all(made, MapViews(backend, made.state), tried, report):
            measured = found._asdict()
            pieces = measured.pop("stretches")
            maps_of = [sorted({owner[stretch] for stretch in piece}) for piece in pieces]
            numbers = {name: np.asarray(value).tolist() for name, value in measured.items()}
            joins.append({"maps": maps_of} | numbers)

    join()
    for number, saved in enumerate(maps[1:], 1):
        other = _keyframes_of(saved, saved.open_session().map)
        before += other.state.count
        owner += [number] * _stretches(other)
        made = unite(made, other, backend.new_map())
        report(f"adding {saved.path}")
        join()
    renew_experiences(made)
    session.map, kept, steps = made, made.state, [saved.steps for saved in maps]
    session.change_rows(kept.count, sum(steps), partial(backend.remember, kept))
    piece, owners = made.pieces(), np.repeat(np.arange(len(maps)), steps)
    found = {
        "maps": [str(saved.path) for saved in maps],
        "steps": steps,
        "joins": joins,
        "pieces": [np.unique(owners[piece == k]).tolist() for k in range(int(piece.max()) + 1)],
        "keyframes": made.state.count,
        "keyframes_before": before,
        "settings": differing_settings([saved.config for saved in maps]),
    }
    _write(output, session, maps, found)
    return found


def describe_merge(report: Mapping[str, Any]) -> str:
    """Which maps were joined where, and what stayed apart, as text, of a report of `merge_maps`."""
    lines = [
        f"{number}  {path}, {steps} steps"
        for number, (path, steps) in enumerate(zip(report["maps"], report["steps"], strict=True), 1)
    ]
    for join in report["joins"]:
        one, other = map(_names, join["maps"])
        (x, y, heading), (sd_x, sd_y, sd_heading) = join["start"], join["sd"]
        lines.append(
            f"{other} joined to {one}, where it begins at {x:.2f} m, {y:.2f} m, "
            f"{np.degrees(heading):.1f} degrees (sd {sd_x:.3f} m, {sd_y:.3f} m, "
            f"{np.degrees(sd_heading):.1f} degrees); log-odds {join['log_odds'][0]:.0f} and "
            f"{join['log_odds'][1]:.0f} (needed {join['needed'][0]:.0f}); {join['closures']} closures"
        )
    pieces = [_names(piece) for piece in report["pieces"]]
    if not report["joins"]:
        lines.append("Nothing in the views joins these maps: they stay pieces of the merged map.")
    if len(pieces) > 1:
        lines.append(f"{len(pieces)} pieces, of maps " + "; ".join(pieces))
    lines.append(f"{report['keyframes']} keyframes of {report['keyframes_before']}")
    if report["settings"]:
        lines.append(f"Made with different settings; the merged map has those of {report['maps'][0]}:")
    for name, (taken, *others) in report["settings"].items():
        values = (f"map {k}: {value}" for k, value in enumerate(others, 2) if value != taken)
        lines.append(f"{name} {taken} ({', '.join(values)})")
    return "\n".join(lines)


def _names(maps: Sequence[int]) -> str:
    """Maps by their numbers from 1."""
    return " + ".join(str(number + 1) for number in maps)


def _stretches(made: KeyframeMap) -> int:
    return int(made.state.begins.rows.sum()) + 1


def _write(output: Path, session: Session, maps: Sequence[SavedMap], report: Mapping[str, Any]) -> None:
    """Writes the map file, or a folder with it, its settings, trajectory, graph and the report."""
    made, first = session.map, maps[0]
    source = replace(first.source, name=" + ".join(dict.fromkeys(saved.source.name for saved in maps)))
    estimate = START._replace(pose=made.trajectory()[-1])
    write = partial(write_map, session=session, config=first.config, source=source, estimate=estimate)
    if output.suffix == ".npz":
        make_new_file(output, write)
        return
    with new_folder(output) as folder:
        write(folder / NAME)
        (folder / "config.yaml").write_text(dump(first.config), encoding="utf-8")
        (folder / REPORT).write_text(json.dumps(report, indent=2) + "\n", encoding="utf-8")
        write_merged_results(folder, made, output.name, report["steps"])


OTHERS = "maps of different sessions"


def check_mergeable(maps: Sequence[SavedMap]) -> None:
    """Raises `InputError` if maps cannot be merged: fewer than two, of another method, without keyframes, of
    different sensors, or with a session that another one of them holds too."""
    if len(maps) < 2:
        raise InputError("merge", "one map", "two or more maps")
    for saved in maps:
        if saved.config.backend != "recall":
            reason = "has no keyframes whose views could be compared"
            found = f"a map of `backend: {saved.config.backend}`, which {reason}"
            raise InputError(str(saved.path), found, "maps of `backend: recall`")
        different = maps[0].sensor.differences(saved.sensor)
        if different:
            clauses = ", ".join(f"{what} is {other} here and {one} there" for what, one, other in different)
            settings, cure = settings_of_map(different), "merge those of each sensor alone"
            other = "another sensor"
            if settings:
                config = saved.path.with_name("config.yaml")
                other = "other settings of the sensor"
                cure = f"make it again: `python -m ratslam run {config} {assignments(settings)} -o NEW`"
            found = f"made with {other} than {maps[0].path}: {clauses}"
            raise InputError(str(saved.path), found, "maps of one sensor", cure)
    _check_sessions(maps)


def _keyframes_of(saved: SavedMap, made: object) -> KeyframeMap:
    """The map restored from a saved one; raises `InputError` if it has no keyframes."""
    if not isinstance(made, KeyframeMap) or not made.state.count:
        found = f"a map of `backend: {saved.config.backend}` without keyframes"
        raise InputError(str(saved.path), found, "a map of `backend: recall` with keyframes")
    return made


def _check_sessions(maps: Sequence[SavedMap]) -> None:
    contents = [digest_of(saved.arrays) for saved in maps]
    for (first, one), (second, other) in combinations(zip(maps, contents, strict=True), 2):
        if one == other:
            raise InputError(str(second.path), f"the same map as {first.path}", OTHERS, "give it once")
    keyframes = [remembered(_keyframes_of(saved, saved.open_session().map)) for saved in maps]
    for (first, seen), (second, again) in combinations(zip(maps, keyframes, strict=True), 2):
        common = overlap(seen, again)
        if common is not None:
            count, held, repeated = common
            found = (
                f"its steps {_span(repeated)} are the session that {first.path} holds in its steps "
                f"{_span(held)}: {count} keyframes are equal to the bit"
            )
            whole = [len(first) == count for first, _ in (seen, again)]
            raise InputError(str(second.path), found, OTHERS, _cure(first.path, second, repeated, whole))
        if first.recording and first.recording == second.recording:
            found = f"its last session is of the same recording ({first.source.name}) as that of {first.path}"
            raise InputError(str(second.path), found, OTHERS, "leave one of them out")


def _cure(first: Path, second: SavedMap, span: tuple[int, int], whole: Sequence[bool]) -> str:
    """How to count a session once.

    Args:
        span: its first and last step in the second map. whole: whether all of the first and of the second map
            is in the other one.
    """
    if all(whole):
        return "leave one of them out: each holds all of the other"
    for path, contained in zip((first, second.path), whole, strict=True):
        if contained:
            return f"leave out {path}, all of which is in the other map"
    begin, end = span
    rest = f"--steps :{begin}" if begin > second.steps - 1 - end else f"--steps {end + 1}:"
    crop = f"ratslam map crop {second.path} {rest} -o rest.npz"
    return f"leave one of them out, or merge the rest of one of them: `{crop}`"


def _span(steps: tuple[int, int]) -> str:
    return f"{steps[0]} to {steps[1]}"
