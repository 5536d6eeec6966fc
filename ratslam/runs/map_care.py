"""Care of saved maps: what is in one, what differs between two, undoing a closure sequence, cropping."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from evaluation.artifacts.run_reader import has_steps, is_merged
from ratslam.core.backend import Map
from ratslam.core.session import Session
from ratslam.mapping.loop_closures import Verdict
from ratslam.mapping.map import KeyframeMap
from ratslam.mapping.map_solution import Obstacle, obstacle
from ratslam.methods.map_file import NAME, map_file
from ratslam.methods.recall import RecallBackend
from ratslam.places.crop import crop_map
from ratslam.places.difference import difference, keyframe_content
from ratslam.runs.map_results import rewrite_results
from ratslam.runs.map_settings import flat_settings
from ratslam.runs.saved_map import SavedMap, write_map
from ratslam.runs.settings.strict_yaml import dump
from tactile.base.bounded import malformed
from tactile.base.errors import InputError
from tactile.base.files import change_folder, make_new_file, require_writable

CURES = {
    Obstacle.NOT_ACCEPTED: "`ratslam map info {path} --json` lists them",
    Obstacle.MERGED: "if it is wrong, cut one of its passes out with `ratslam map crop --steps`, or map the "
    "recordings again with `--set keyframes.merge_stood=0`",
    Obstacle.ONLY_LINK: "if it is wrong, cut one of the sides out with `ratslam map crop --steps`",
}
"""What can be done instead of an undo, by why it cannot be made."""
Choose = Callable[[KeyframeMap], np.ndarray]
"""Chooses the keyframes of a map that remain: [E] bool."""


def map_info(saved: SavedMap) -> dict[str, Any]:
    """What is in a map, as JSON; numbers that the method does not give are left out.

    Raises:
        InputError: the map cannot be restored.
    """
    made = saved.open_session().map
    path = made.trajectory() if saved.steps else np.zeros((0, 3))
    doubt = made.final_doubt() if saved.steps else np.nan
    box = np.array([path[:, :2].min(axis=0), path[:, :2].max(axis=0)]) if len(path) else path
    info: dict[str, Any] = {
        "path": str(saved.path),
        "format": saved.format,
        "digest": saved.digest,
        "backend": saved.config.backend,
        "sensor": saved.sensor.describe(),
        "source": saved.source.name,
        "recording": saved.recording or None,
        "settings_sha256": hashlib.sha256(dump(saved.config).encode()).hexdigest(),
        "steps": saved.steps,
        "experiences": len(made.graph()) if saved.steps else 0,
        "pieces": len(np.unique(made.pieces())) if saved.steps else 0,
        "closures": len(made.closures()) if saved.steps else 0,
        "box_m": box.ravel().tolist(),
        "doubt": float(doubt) if np.isfinite(doubt) else None,
        "unjudged": made.unjudged() if saved.steps else "",
    }
    return info | (_keyframe_info(made) if isinstance(made, KeyframeMap) and saved.steps else {})


def _keyframe_info(made: KeyframeMap) -> dict[str, Any]:
    solution = made.solution()
    belief = solution.calibration()
    # Of the sequences of recall: those that may follow them in a final map follow from its poses.
    verdicts = solution.log.verdicts()[: made.state.log.sequences]
    log, step = solution.log, made.keyframe_steps()
    accepted = []
    for number in np.flatnonzero(verdicts == Verdict.ACCEPTED).tolist():
        members = log.members(number)
        accepted.append(
            {
                "sequence": number,
                "steps": step[members[[0, -1], 0]].tolist(),
                "match_steps": step[members[[0, -1], 1]].tolist(),
                "evidence": round(log.score(number), 2),
                "can_be_undone": obstacle(solution, number, made.state.log) is None,
            }
        )
    return {
        "keyframes": solution.count,
        "keyframes_not_merged": made.state.count,
        "sequences": len(verdicts),
        "accepted_sequences": accepted,
        "sequences_undone": int((verdicts == Verdict.UNDONE).sum()),
        "heading_bias_rad_per_m": [belief.bias, belief.bias_sd],
        "turn_error_rad_per_rad": [belief.turn_error, belief.turn_error_sd],
    }


def map_difference(first: SavedMap, second: SavedMap) -> dict[str, Any]:
    """What differs between two maps, as JSON: places (keyframes; steps for other methods), closures, the
    motion of common places in m and rad, settings, and the sensor.

    Raises:
        InputError: a map cannot be restored.
    """
    contents = []
    for saved in (first, second):
        made: Map = saved.open_session().map
        if isinstance(made, KeyframeMap):
            contents.append(keyframe_content(made))
        else:
            names = [f"{saved.recording} {step}".encode() for step in range(saved.steps)]
            path = made.trajectory() if saved.steps else np.zeros((0, 3))
            contents.append((path, names, made.closures()))
    found = difference(*contents)
    settings = [flat_settings(saved.config.model_dump(mode="json")) for saved in (first, second)]
    keys = sorted(settings[0].keys() | settings[1].keys())
    pairs = {key: [one.get(key) for one in settings] for key in keys}
    changed = {key: pair for key, pair in pairs.items() if repr(pair[0]) != repr(pair[1])}
    return {
        "same": first.digest == second.digest,
        "steps": [first.steps, second.steps],
        **{key: value if np.isfinite(value) else None for key, value in found.items()},
        "settings": changed,
        "sensor": first.sensor.disagreement(second.sensor),
    }


def undo_sequence(saved: SavedMap, sequence: int, output: Path) -> bool:
    """Removes the closures of a sequence from a map, solves it without them, and writes it. If it replaces
    the map of a run directory, the files there that follow from the map are written anew: all, or none.

    Returns:
        whether they were.

    Raises:
        InputError: no such sequence is accepted, its keyframes are merged, it joins broken parts, the map
            has no closure sequences, or a file of the run directory is missing or malformed.
    """
    session, made = _keyframe_session(saved, "undo")
    against = obstacle(made.solution(), sequence, made.state.log)
    if against is not None:
        expected = "an accepted sequence that can be undone"
        cure = CURES[against].format(path=saved.path)
        raise InputError(str(saved.path), f"sequence {sequence} {against}", expected, cure)
    made.undo(sequence)

    def write(file: Path) -> None:
        write_map(
            file, session, saved.config, saved.source,
            recording=saved.recording, estimate=saved.estimate, frontend=saved.frontend,
        )  # fmt: skip

    folder = output.parent
    if output != saved.path:
        make_new_file(output, write)
        return False
    if output.name != NAME or not (is_merged(folder) or has_steps(folder)):
        write(output)
        return False

    def change(shown: Path) -> None:
        write(shown / NAME)
        rewrite_results(shown, made, saved.config.score)

    change_folder(folder, str(sequence), NAME, change)
    return True


def replaced_file(path: Path) -> Path:
    """The file that an undo of a map replaces, which a link may name.

    Raises:
        InputError: it is read-only, its folder cannot be written in, or it is that of another folder.
    """
    file, cure = map_file(path), "or write a new map with -o"
    if file.is_symlink():
        if path.is_dir():
            found = f"a link to {file.resolve()}, whose folder has files of its own"
            raise InputError(str(file), found, "a map in its run directory", f"undo it there, {cure}")
        file = file.resolve()
    if file.exists():
        if not file.stat().st_mode & 0o222 or not os.access(file, os.W_OK):
            raise InputError(str(file), "read-only", "a map that may be changed", f"`chmod u+w` it, {cure}")
        require_writable(file)
    return file


def crop_saved(saved: SavedMap, choose: Choose, output: Path) -> int:
    """Writes the part of a map with the chosen keyframes as a map; returns its number of steps.

    Raises:
        InputError: no keyframe remains, or the map has no keyframes.
    """
    session, made = _keyframe_session(saved, "crop")
    backend = session.backend
    assert isinstance(backend, RecallBackend)
    cure = "`ratslam map info` says where the map lies and how many steps and pieces it has"
    with malformed(saved.path, "a part of the map", cure, "{}", (ValueError,)):
        cropped = crop_map(made, backend.new_map(), choose(made))
    steps = len(made.pieces())
    session.change_rows(cropped.rows.rows, steps, lambda state: backend.crop_rows(state, cropped))
    if cropped.elsewhere:
        session.begin_piece()
    estimate = saved.estimate._replace(place=-1)  # places are numbered anew

    def write(file: Path) -> None:
        write_map(file, session, saved.config, saved.source, estimate=estimate, frontend=saved.frontend)

    make_new_file(output, write)
    return steps


def _keyframe_session(saved: SavedMap, what: str) -> tuple[Session, KeyframeMap]:
    session = saved.open_session()
    if not isinstance(session.map, KeyframeMap) or not isinstance(session.backend, RecallBackend):
        found = f"a map of `backend: {saved.config.backend}`, which has no keyframes to {what}"
        raise InputError(str(saved.path), found, "a map of `backend: recall`")
    return session, session.map
