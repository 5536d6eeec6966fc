"""Refusals of maps that cannot be merged, each with the maps concerned, the reason and a cure."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from pathlib import Path

from ratslam.atlas.overlap import Overlap, overlap, remembered
from ratslam.keyframes.map import KeyframeMap
from ratslam.pipeline.map_archive import digest_of
from ratslam.pipeline.map_settings import assignments
from ratslam.pipeline.saved_map import SavedMap
from ratslam.pipeline.sensor import differences, settings_of_map
from tactile.base.errors import InputError

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
        _check_sensors(maps[0], saved)
    _check_sessions(maps)


def keyframes_of(saved: SavedMap, made: object) -> KeyframeMap:
    """The map restored from a saved one; raises `InputError` if it has no keyframes."""
    if not isinstance(made, KeyframeMap) or not made.kept_keyframes().count:
        found = f"a map of `backend: {saved.config.backend}` without keyframes"
        raise InputError(str(saved.path), found, "a map of `backend: recall` with keyframes")
    return made


def _check_sensors(first: SavedMap, second: SavedMap) -> None:
    different = differences(first.sensor, second.sensor)
    if different:
        clauses = ", ".join(f"{what} is {other} here and {one} there" for what, one, other in different)
        settings, cure = settings_of_map(different), "merge those of each sensor alone"
        other = "another sensor"
        if settings:
            config = second.path.with_name("config.yaml")
            other = "other settings of the sensor"
            cure = f"make it again: `python -m ratslam run {config} {assignments(settings)} -o NEW`"
        found = f"made with {other} than {first.path}: {clauses}"
        raise InputError(str(second.path), found, "maps of one sensor", cure)


def _check_sessions(maps: Sequence[SavedMap]) -> None:
    contents = [digest_of(saved.arrays) for saved in maps]
    for (first, one), (second, other) in combinations(zip(maps, contents, strict=True), 2):
        if one == other:
            raise InputError(str(second.path), f"the same map as {first.path}", OTHERS, "give it once")
    keyframes = [remembered(keyframes_of(saved, saved.open_session().map)) for saved in maps]
    for (first, seen), (second, again) in combinations(zip(maps, keyframes, strict=True), 2):
        common = overlap(seen, again)
        if common is not None:
            found = (
                f"its steps {_span(common.other)} are the session that {first.path} holds in its steps "
                f"{_span(common.one)}: {common.keyframes} keyframes are equal to the bit"
            )
            whole = [len(known.first) == common.keyframes for known in (seen, again)]
            raise InputError(str(second.path), found, OTHERS, _cure(first.path, second, common, whole))
        if first.recording and first.recording == second.recording:
            found = f"its last session is of the same recording ({first.source.name}) as that of {first.path}"
            raise InputError(str(second.path), found, OTHERS, "leave one of them out")


def _cure(first: Path, second: SavedMap, common: Overlap, whole: Sequence[bool]) -> str:
    """How to count a session once.

    Args:
        whole: whether all of the first and of the second map is in the other one.
    """
    if all(whole):
        return "leave one of them out: each holds all of the other"
    for path, contained in zip((first, second.path), whole, strict=True):
        if contained:
            return f"leave out {path}, all of which is in the other map"
    begin, end = common.other
    rest = f"--steps :{begin}" if begin > second.steps - 1 - end else f"--steps {end + 1}:"
    crop = f"ratslam map crop {second.path} {rest} -o rest.npz"
    return f"leave one of them out, or merge the rest of one of them: `{crop}`"


def _span(steps: tuple[int, int]) -> str:
    return f"{steps[0]} to {steps[1]}"
