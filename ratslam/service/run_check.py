"""Whether to believe the map of a run and which settings to try first; whether a live session could start.

The latter checks robot, whiskers, clocks, disk and settings, and moves nothing.
"""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import numpy as np

from evaluation.artifacts.run_reader import (
    Closures,
    check_run_directory,
    count_closures,
    has_steps,
    read_manifest,
    read_run,
)
from evaluation.metrics.run_metrics import RunArrays
from evaluation.metrics.trajectory import ate
from evaluation.report.verdict import CAUTION, judge_map
from ratslam.mapping.pose_graph import read_json
from ratslam.runs.settings.run_config import RunConfig, load_config
from ratslam.service.recording_check import Diagnosis
from robot.live.polling import SessionFault
from robot.live.selftest import check_session
from tactile.base.bounded import read_rows
from tactile.base.errors import InputError
from tactile.base.se2 import between

SAME = 0.99
"""Share of the odometry's error above which the map's is no better."""
NONE_ACCEPTED = (
    "no loop closure was accepted: the odometry contradicts those proposed, or places look alike; the report "
    "shows them; is the sensor mounted the other way round?"
)
NONE_PROPOSED = (
    "no place was recognised: did the robot come back to any? Do the views vary? Try another number of rows "
    "and columns, or another max_range"
)
FAST = 2.0
"""Median motion of a step, cells, above which the views of successive steps differ too much."""


def diagnose_run(path: Path) -> Diagnosis:
    """Whether to believe the map of a run directory.

    Raises:
        InputError: it is not a run directory, or has no steps.
    """
    import networkx  # slow to import

    check_run_directory(path)
    manifest = read_manifest(path)
    proceed = f"continue it: python -m ratslam run {path}/config.yaml --continue {path}/map.npz"
    if not manifest.digest and load_config(path / "config.yaml").recording is not None:  # a live session
        proceed = f"map its recording: python -m ratslam run {path}/config.yaml"
    if manifest.killed and not has_steps(path):
        return Diagnosis(f"{path}: a run that was killed before its first step", advice=(proceed,))
    run, config = read_run(path), load_config(path / "config.yaml")
    closures = count_closures(path)
    status = "killed" if manifest.killed else manifest.status
    what = f"{path}: a run of {len(run.time)} steps ({status}), backend {config.backend}"
    verdict = judge_map(run.doubt, run.unjudged)
    judgement = f"{verdict.headline}. {verdict.reason}"
    if manifest.killed:
        judgement = "It was killed, or ended by an error: the poses are those found on the way, not judged"
    given = [f"warning about the input: {sentence}" for sentence in run.warnings] or ["input: clean"]
    notes = [judgement, *given, _error_note(run)]
    if closures is not None:
        notes.append(
            f"loop closures: {closures.accepted} of {closures.proposed} accepted, "
            f"in {closures.accepted_sequences} of {closures.sequences} sequences"
        )
    pieces = 0
    if (path / "map.json").exists():
        pieces = networkx.number_weakly_connected_components(read_json(path / "map.json"))
    if pieces > 1:
        notes.append(f"the map has {pieces} pieces; nothing determines their relative poses")
    parse = lambda row: (row["outcome"] or "ok", row["lost"] == "1")  # noqa: E731
    rows = read_rows(path / "steps.csv", "the columns outcome and lost", parse)
    outcomes = Counter(outcome for outcome, _ in rows) + Counter(lost=sum(lost for _, lost in rows))
    faults = [
        f"{count} of {len(run.time)} steps: {name.replace('_', ' ')}"
        + (f" ({CAUSES[name]})" if name in CAUSES else "")
        for name, count in sorted(outcomes.items())
        if name != "ok" and count
    ]
    advice = _settings_to_try(run, config, closures)
    if (path / "calibration.yaml").exists():
        advice.append(f"copy {path}/calibration.yaml into the configuration of this robot's next session")
    if manifest.killed or (status != "complete" and (path / "map.npz").exists()):
        advice.insert(0, proceed)
    return Diagnosis(what, (), tuple(notes), tuple(faults), tuple(advice))


def _error_note(run: RunArrays) -> str:
    """Position errors of map and odometry, if truth is known."""
    rows = run.truth_rows
    if run.truth is None or len(rows) < 2:
        return "truth: unknown, so nothing but the health tells how good the map is"
    final, odometry = ate(run.final[rows], run.truth[rows]), ate(run.odometry[rows], run.truth[rows])
    better = "better" if final < SAME * odometry else "no better"
    better = "worse" if SAME * final > odometry else better
    return f"truth: map {final:.3g} m off, odometry {odometry:.3g} m (ATE): {better} than odometry"


CAUSES = {
    "too_fast": "the odometry of a step is over 190 cells: is it in metres and radians, is a stamp wrong?",
    "not_finite": "odometry or a view is NaN or infinite",
    "full": "a capacity was exceeded",
    "reseeded": "the pose cells lost their packet: the odometry jumps, or global_inhibition is too large",
    "lost": "the pose was lost: views that match nothing, or odometry that does not fit them",
}
"""Causes of outcomes."""


def _settings_to_try(run: RunArrays, config: RunConfig, closures: Closures | None) -> list[str]:
    """Settings to try first, each with its reason."""
    advice = []
    moved = np.hypot(*between(run.odometry[:-1], run.odometry[1:])[:, :2].T)
    moved = moved[moved > 0]
    cells = float(np.median(moved)) / config.pose_cells.cell_size if len(moved) else 0.0
    if not len(moved):
        advice.append("the odometry does not move: check its topic or columns")
    elif config.backend not in ("grid", "localise_grid") and cells > FAST:
        size = float(f"{2 * float(np.median(moved)):.2g}")
        advice.append(f"--set pose_cells.cell_size={size}: a step moves {cells:.2g} cells")
    if closures is not None and not closures.accepted:
        advice.append(NONE_ACCEPTED if closures.proposed else NONE_PROPOSED)
    elif run.doubt > CAUTION:
        report = "python -m ratslam report RUN_DIR -o report.html"
        advice.append(f"{report}: shows each closure with its two views")
        if config.recall.sector_fov == "auto":
            advice.append("recall.sector_fov: the sensor's field of view, rad, instead of an estimate")
        advice.append("keyframes.noise: the noise of this robot's odometry, instead of the preset's")
    return advice


def diagnose_live(config: RunConfig, name: str, directory: Path) -> Diagnosis:
    """Checks everything that a live session needs, without a motion.

    Args:
        name: of the configuration. directory: in which the session would make its run directory.

    Raises:
        InputError: it is not the configuration of a live session.
    """
    live = config.live
    if live is None:
        raise InputError(name, "no section `live`", "the configuration of a live session")
    robot = "topics" if live.topics is not None else "an arm" if live.create is None else "a Create"
    passed = [f"settings: backend {config.backend}, {robot}"]
    try:
        for line in check_session(live, config.touch.head, directory, config.recording):
            passed.append(line)  # those before a failure count
    except (InputError, SessionFault) as error:
        return Diagnosis(f"{name}: the live session cannot start", (), tuple(passed), (str(error),))
    return Diagnosis(f"{name}: the live session can start; nothing was moved", (), tuple(passed))
