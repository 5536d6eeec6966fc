"""Localisation of a recording in a saved map: the run of a configuration with `backend: localise`."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

from evaluation.artifacts.run_reader import CHANGES, read_changes
from evaluation.metrics.scorecard import Scorecard
from ratslam.core.estimates import Localisation
from ratslam.methods.config import Start
from ratslam.methods.method_registry import LOCALISING
from ratslam.runs.map_settings import check_same_fov
from ratslam.runs.run import run
from ratslam.runs.runner import Observer
from ratslam.runs.saved_map import SavedMap, is_map
from ratslam.runs.settings.run_config import RunConfig, SourceConfig
from ratslam.runs.settings.strict_yaml import (
    FOLDER,
    RECORDING,
    dump,
    override,
    parse,
    refuse_other_files,
    validate,
)
from robot.recordings.recording_config import RecordingConfig
from tactile.base.errors import InputError

NOT_LOCALISED = {
    "classic": "whose view templates say which view is nearest, and not how likely it is of another place",
    **dict.fromkeys(LOCALISING.values(), "which is a session in another map, and no map of its own"),
}
"""Why nothing can be localised in the maps of a method."""
OWN = (*SourceConfig.model_fields, "score", "cells")
"""Sections that a session has of its own in a saved map."""


def localising(config: RunConfig, saved: SavedMap, start: Start | None = None) -> RunConfig:
    """The configuration of a session that is localised in a saved map: source, touch and scores of `config`,
    the rest as the map was made.

    Args:
        start: where it begins, if not as `config` says.

    Raises:
        InputError: the map was made by a method in whose maps nothing can be localised, or with a sensor of
            another field of view.
    """
    if saved.config.backend not in LOCALISING:
        found = f"a map made by `backend: {saved.config.backend}`"
        reason = NOT_LOCALISED.get(saved.config.backend)
        if reason:
            found = f"{found}, {reason}"
        cure = "map the place again with `backend: recall`, or by whiskers with `backend: grid`"
        raise InputError(str(saved.path), found, "a map made by `backend: recall` or `backend: grid`", cure)
    check_same_fov(str(saved.path), saved.config, config)
    own = {name: getattr(config, name) for name in OWN}
    begin = {} if start is None else {"start": start}
    place = config.localise.model_copy(update={"map": saved.path.resolve(), **begin})
    changed = own | {"backend": LOCALISING[saved.config.backend], "localise": place}
    return saved.config.model_copy(update=changed)


def check_assignments(assignments: Sequence[str], saved: SavedMap) -> None:
    """Refuses settings that a session in a saved map cannot have of its own (`localising`).

    Args:
        assignments: each `a.b=value`, with names of settings.

    Raises:
        InputError: a setting would have no effect.
    """
    for assignment in assignments:
        name = assignment.partition("=")[0]
        section = name.partition(".")[0]
        if name == "localise.map":
            found = f"the map is {saved.path}, as given before the recording"
        elif section in (*OWN, "localise", "include"):
            continue
        else:
            found = f"without effect: {section} is as {saved.path} was made"
        expected = f"settings of {', '.join(OWN)} or localise"
        raise InputError(f"--set {name}", found, expected, "leave it out, or map the place anew with it")


def recorded_alike(file: Path, saved: SavedMap, assignments: Sequence[str] = ()) -> RunConfig:
    """The configuration of a recording by the sensor of a saved map: its readings become views as those of
    the map did.

    Args:
        assignments: settings to replace, each `a.b=value`.

    Raises:
        InputErrors: the assignments have errors. InputError: the file is a map.
    """
    if is_map(file):
        cure = "give the recording or the configuration whose poses are to be found"
        raise InputError(str(file), "a map, which is no recording", "a recording of the map's sensor", cure)
    refuse_other_files(file, "a recording or a configuration", (RECORDING, FOLDER))
    like, file = saved.config.recording, file.resolve()
    if like is not None and like.topics is None and (file.is_dir() or file.suffix in (".bag", ".db3")):
        cure = f"`python -m ratslam doctor {file} --like {saved.path} -o FILE.yaml`, and localise FILE.yaml"
        raise InputError(
            str(file),
            "a bag or a folder",
            f"such a recording as {Path(like.file or '').name}",
            cure,
        )
    recording = RecordingConfig(file=file) if like is None else like.model_copy(update={"file": file})
    sources = dict.fromkeys(SourceConfig.model_fields) | {"touch": saved.config.touch, "recording": recording}
    text = dump(saved.config.model_copy(update=sources))
    return validate(override(parse(text, str(saved.path)), assignments), RunConfig)


def localise(
    saved: SavedMap, config: RunConfig, directory: Path, observers: Sequence[Observer] = ()
) -> tuple[Scorecard, str, bool]:
    """Localises the source of a configuration in a saved map, which stays as it is.

    Args:
        saved: the map. config: with absolute paths; its source and touch are used.
        directory: the new run directory. observers: are told of the progress.

    Returns:
        the scorecard, the course of the localisation in a sentence with a line for each place at which the
        session does not agree with the map, and whether Ctrl-C ended it early.

    Raises:
        InputError: the map, the source or the run directory cannot be used, or the sensor is not that of the
            map.
    """
    card, interrupted = run(localising(config, saved), directory, observers=observers)
    return card, describe_localisation(directory), interrupted


def describe_localisation(directory: Path) -> str:
    """The course of a localisation in a sentence, with a line for each place at which the session does not
    agree with the map.

    Args:
        directory: of the run, with the file of state and probability of every step.
    """
    text = (directory / "localisation.csv").read_text(encoding="utf-8")
    steps = [line.split(",") for line in text.splitlines()[1:]]
    known = [state == Localisation.FOUND.name.lower() for _, state, *_ in steps]
    _, state, mass, *_ = steps[-1]
    state = state.replace("_", " ")
    lost = sum(before and not now for before, now in pairwise(known))
    again = f", lost {lost} time{'s' * (lost > 1)}" if lost else ""
    course = f"not found in {len(steps)} steps: {state}"
    if any(known):
        course = (
            f"found after {known.index(True) + 1} of {len(steps)} steps, known in {sum(known)} of them{again}"
            f"; at the end: {state}, probability {float(mass):.3f}"
        )
    file = directory / CHANGES  # maps of whiskers only
    changes = read_changes(file) if file.exists() else []
    return "\n".join([course, *(change.describe() for change in changes)])
