"""Tables of recordings: real buildings, where nobody tuned the map, and laser views or given place ids.

ATE is the RMS position error after a rigid alignment, m: of the final map, of the live pose (as estimated at
the time) and of odometry. A run is worse than odometry if its ATE exceeds `HARM_FACTOR` times odometry's by
`HARM_MARGIN`. Copies of a recording are miscalibrated, perturbed, or have a third of their given ids lost,
wrong or new (`evaluation.studies.perturbation`); depth views of a Create are mapped at several cell sizes and
sector widths. In buildings a closure is false by `FALSE_DISTANCE` or `FALSE_TURN`, a sequence if the medians
over its closures are; in the table `laser` if its two steps are 2.5 pose cells apart in truth.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from itertools import product
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from scipy.special import expit

from evaluation.metrics.statistics import expected_calibration_error
from evaluation.papers.tables.comparison import (
    Compared,
    Measured,
    SessionLog,
    column,
    compare_runs,
    measured_rows,
)
from evaluation.papers.tables.markdown import markdown_header, markdown_row, select_rows
from evaluation.papers.tables.recordings import GOLDEN, Recording, metres, real_recordings
from evaluation.papers.trial_sessions import ClosureClaims, closure_claims, known_ate, run_recording
from evaluation.studies.metrics import closure_errors
from evaluation.studies.perturbation import Perturbation, miscalibrate, perturb, spoil_labels
from ratslam.runs.settings.run_config import RunConfig

FALSE_DISTANCE, FALSE_TURN = 2.0, np.radians(30)
"""Of a closure's steps: true distance, m, and error of the claimed heading difference, rad."""
HARM_FACTOR, HARM_MARGIN = 1.05, 0.3
"""Of odometry's ATE, and m."""
_SUFFIX = "_odom_gt.csv"
"""End of the file names of buildings, in the folder `buildings` of the real recordings."""
_PERTURBATIONS: dict[str, Perturbation] = {
    "miscalibrated": miscalibrate,
    "ids lost": partial(spoil_labels, kind="lost"),
    "ids wrong": partial(spoil_labels, kind="wrong"),
    "ids new": partial(spoil_labels, kind="new"),
}
COLUMNS = (
    "recording", "odometry", "final", "live", "final of copies: median, worst",
    "live of copies: median, worst",
    "worst final / odometry", "worse than odometry: final, live", "false / closures as is",
    "false / closures of all runs", "false / sequences of all runs",
)  # fmt: skip

Section = Literal["buildings", "ids", "create"]
CREATE = "configs/create_lab.yaml"
_FACTORS = {"1/2": 0.5, "1": 1.0, "2": 2.0}
"""Of cell size and sector width in the rows of the Create."""


class BuildingsRow(NamedTuple):
    """A row: a recording, its section of the table, what its copies are (a key of `_PERTURBATIONS`; "": there
    are none), and factors on cell size and sector width."""

    recording: Recording
    section: Section
    copies: str = ""
    cell: float = 1.0
    sector: float = 1.0

    def configuration(self) -> RunConfig:
        """The configuration of its runs."""
        config = self.recording.configuration()
        if self.cell == self.sector == 1:
            return config
        fov = float(config.recall.sector_fov)
        scaled = {
            "pose_cells.cell_size": config.pose_cells.cell_size * self.cell,
            "experience.match_sd": config.experience.match_sd * self.cell,
            "recall.sector_fov": fov * self.sector,
        }
        return self.recording.configuration(*(f"{key}={value!r}" for key, value in scaled.items()))


def buildings_rows() -> dict[str, BuildingsRow]:
    """All rows by name; those of the buildings are the files found in the folder of the real recordings, or
    one row, `buildings`, for a file that is missing."""
    folder = (real_recordings() or Path()).absolute() / "buildings"
    found = {file.name.removesuffix(_SUFFIX): file for file in sorted(folder.glob(f"*{_SUFFIX}"))}
    hall = "configs/tuc_lecture_hall.yaml"
    recordings = {
        name: Recording(name, "configs/building.yaml", (f"recording.file={file}",), real=True)
        for name, file in (found or {"buildings": folder / f"NAME{_SUFFIX}"}).items()
    }
    recordings["intel"] = Recording(
        "intel (`configs/intel_laser.yaml`)", "configs/intel_laser.yaml", real=True
    )
    recordings["tuc"] = Recording(f"lecture hall (`{hall}`, given ids)", hall, real=True)
    rows = {name: BuildingsRow(one, "buildings", "miscalibrated") for name, one in recordings.items()}
    for fault in ("lost", "wrong", "new"):
        recording = Recording(f"lecture hall, copies with a third of the ids {fault}", hall, real=True)
        rows[f"ids {fault}"] = BuildingsRow(recording, "ids", f"ids {fault}")
    for (cell, cells), (sector, sectors) in product(_FACTORS.items(), _FACTORS.items()):
        recording = Recording(f"Create, depth, cell x {cell}, sector x {sector}", CREATE, real=True)
        rows[f"create {cell} {sector}"] = BuildingsRow(recording, "create", "", cells, sectors)
    return rows


def buildings_table(
    rows: Sequence[str] | None = None,
    copies: int = 10,
    workers: int = 0,
    output: Path | None = None,
    against: Path | None = None,
) -> Iterator[str]:
    """The lines of the table, each as soon as its runs are done; totals and missing recordings below it.

    Args:
        rows: names of rows of `buildings_rows` or of sections; None: all. output, against: see `SessionLog`;
            the file is `buildings.csv`, a session is the seed of a copy, 0 the recording as it is.

    Raises:
        InputError: no such row, or a file cannot be used.
    """
    every = buildings_rows()
    sections: dict[str, BuildingsRow] = {row.section: row for row in every.values()}
    names = select_rows(rows, {**sections, **every}, tuple(sections))
    chosen = {name: row for name, row in every.items() if name in names or row.section in names}
    missing = {name: reason for name, row in chosen.items() if (reason := row.recording.missing())}
    present = {name: row for name, row in chosen.items() if name not in missing}
    tasks = {
        name: {
            str(seed): (row.configuration(), row.copies, seed)
            for seed in range(1 + copies * bool(row.copies))
        }
        for name, row in present.items()
    }
    log, notes = SessionLog("buildings", output, against, tasks), list[str]()
    found: dict[Section, list[Measured]] = {}
    yield markdown_header(COLUMNS)
    for name, runs in measured_rows(_measure_run, tasks, workers, log):
        row = present[name]
        yield markdown_row([row.recording.label, *_cells(runs)])
        found.setdefault(row.section, []).extend(runs)
        if row.section == "ids":
            _, final, _ = _errors(runs)
            notes.append(f"{row.copies}: worst copy {final[1:].max() / final[0]:.2f} times the ATE as is.")
    notes = ([_total(found["buildings"])] if "buildings" in found else []) + notes
    if "create" in found:
        odometry, final, live = _errors(found["create"])
        above = f"final {(final > odometry).sum()}, live {(live > odometry).sum()}"
        median = metres(np.median(final))
        notes.append(f"Create, {len(final)} settings: final median {median} m; above odometry: {above}.")
    notes += [f"Left out: {name}: {reason}" for name, reason in missing.items()]
    yield from ["", *notes] if notes else []
    yield from compare_runs(COMPARED, log, list(chosen))


def _measure_run(task: tuple[RunConfig, str, int]) -> Measured:
    """Runs and measures a recording with a configuration, or its copy of a kind and a seed (0: as it is).

    Closures and sequences without known truth do not count as false. Shown are the `calibration` of the odds:
    [R, 2] log odds that each closure sequence is true, NaN where they are not known, and whether it is false.

    Raises:
        InputError: the recording cannot be used, or has no truth.
    """
    config, copies, seed = task
    _, session, run = run_recording(config, _PERTURBATIONS[copies] if seed else None, seed)
    claims = closure_claims(session.map, run.truth)
    false, sequences, odds = judge_claims(claims)
    closures, accepted = false[claims.accepted], sequences[sequences[:, 0], 1]
    figures = {
        "odometry": known_ate(run.odometry, run.truth),
        "final": known_ate(run.trajectory, run.truth),
        "live": known_ate(run.live, run.truth),
        "closures": len(closures),
        "false_closures": int(closures.sum()),
        "sequences": len(accepted),
        "false_sequences": int(accepted.sum()),
    }
    return Measured(figures, {"calibration": np.column_stack([odds, sequences[:, 1]])})


def judge_claims(claims: ClosureClaims) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Whether closures and closure sequences are false, and the odds of sequences.

    Returns:
        [n] bool, of each claim, whether it is false. [R, 2] bool, of each sequence, whether it is accepted
        and whether it is false: by the medians of its claims. [R] log odds that each sequence is true; NaN
        where the truth or they themselves are unknown.
    """
    members = [claims.sequence == number for number in np.unique(claims.sequence)]
    middles = [
        np.array([np.median(values[rows]) for rows in members]) for values in (claims.distance, claims.turn)
    ]
    single, whole = (
        (distance > FALSE_DISTANCE) | (turn > FALSE_TURN)
        for distance, turn in ((claims.distance, claims.turn), middles)
    )
    accepted = np.array([claims.accepted[rows].any() for rows in members], bool)
    known = np.array([np.isfinite(claims.distance[rows]).all() for rows in members], bool)
    odds = np.array([claims.log_odds[rows][0] for rows in members], float)
    return single, np.column_stack([accepted, whole]), np.where(known, odds, np.nan)


def _is_worse(error: np.ndarray, odometry: np.ndarray) -> np.ndarray:
    """Whether ATEs, m, exceed those of odometry by more than the margins."""
    return error > HARM_FACTOR * odometry + HARM_MARGIN


COMPARED = Compared(
    "final ATE", "final", "live", "odometry", worse=_is_worse, failed=_is_worse,
    counts={
        "false / closures": ("false_closures", "closures"),
        "false / sequences": ("false_sequences", "sequences"),
    },
    medians={},
)  # fmt: skip
"""Of two runs of the table; a run whose final map is worse than odometry is a failure."""


def _cells(runs: Sequence[Measured]) -> list[str]:
    """The cells of a row: its recording as it is, then the copies."""
    odometry, final, live = _errors(runs)
    ratio = (final / np.maximum(odometry, 1e-12)).max()
    return [
        *map(metres, (odometry[0], final[0], live[0])),
        _spread(final[1:]),
        _spread(live[1:]),
        f"{ratio:.2f}",
        f"{_is_worse(final, odometry).sum()}, {_is_worse(live, odometry).sum()} of {len(runs)}",
        _false(runs[:1], "closures"),
        _false(runs, "closures"),
        _false(runs, "sequences"),
    ]


def _total(runs: Sequence[Measured]) -> str:
    """The line below the table over all runs of buildings."""
    odometry, final, live = _errors(runs)
    odds, false = np.concatenate([run.shown["calibration"] for run in runs]).T
    known = np.isfinite(odds)
    error = expected_calibration_error(expit(odds[known]), false[known] == 0)
    closures = column(runs, "closures").sum()
    share = f" ({column(runs, 'false_closures').sum() / closures:.1%})" if closures else ""
    return (
        f"All buildings, {len(runs)} runs: false / closures {_false(runs, 'closures')}{share}; false / "
        f"sequences {_false(runs, 'sequences')}; worse than odometry: final "
        f"{_is_worse(final, odometry).mean():.1%}, live {_is_worse(live, odometry).mean():.1%}; expected "
        f"calibration error of the odds of {known.sum()} "
        f"sequences {error:.3f}."
    )


def _errors(runs: Sequence[Measured]) -> np.ndarray:
    """[3, n] ATE of odometry, final and live, m."""
    return np.array([column(runs, name) for name in ("odometry", "final", "live")])


def _spread(errors: np.ndarray) -> str:
    return f"{metres(np.median(errors))}, {metres(errors.max())}" if len(errors) else "-"


def _false(runs: Sequence[Measured], name: str) -> str:
    """False ones of the accepted closures, or of the accepted sequences."""
    return f"{column(runs, f'false_{name}').sum()} / {column(runs, name).sum()}"


ROWS = {
    "square": Recording("`configs/square.yaml`, synthetic", "configs/square.yaml"),
    "figure8": Recording(
        "`b_figure8_alias`, a third of the places look alike",
        "configs/square.yaml",
        (f"recording.file={GOLDEN}/b_figure8_alias.npz",),
    ),
    "kidnap": Recording(
        "`e_kidnap`, carried away once, `keyframes.may_be_carried`",
        "configs/square.yaml",
        (f"recording.file={GOLDEN}/e_kidnap.npz", "keyframes.may_be_carried=true"),
    ),
    "tuc": Recording(
        "`configs/tuc_lecture_hall.yaml`, real, given place ids", "configs/tuc_lecture_hall.yaml", real=True
    ),
    "intel": Recording(
        "`configs/intel_laser.yaml`, real, 18-number laser views", "configs/intel_laser.yaml", real=True
    ),
}


def laser_table(rows: Sequence[str] | None = None, copies: int = 10, workers: int = 0) -> Iterator[str]:
    """The lines of the table; rows whose recordings are missing are named below it."""
    rows = select_rows(rows, ROWS)
    missing = {row: reason for row in rows if (reason := ROWS[row].missing())}
    tasks = {
        row: {"classic": (ROWS[row].configuration("backend=classic"), 0)}
        | {str(seed): (ROWS[row].configuration(), seed) for seed in range(copies + 1)}
        for row in rows
        if row not in missing
    }
    heads = ("classic (closures, false)", "ratslam (closures, false)", "perturbed: median, maximum")
    yield markdown_header(["recording", "odometry", *heads])
    for row, (classic, ours, *perturbed_copies) in measured_rows(_measure_recording, tasks, workers):
        spread = _spread(np.array([error for error, *_ in perturbed_copies]))
        cells = [f"{metres(error)} ({closures}, {false})" for error, _, closures, false in (classic, ours)]
        yield markdown_row([ROWS[row].label, metres(ours[1]), *cells, spread])
    yield from ["", *(f"Left out: {row}: {reason}" for row, reason in missing.items())] if missing else []


def _measure_recording(task: tuple[RunConfig, int]) -> tuple[float, float, int, int]:
    """ATE of the final map and of dead reckoning, m, number of closures and of false ones of one recording,
    perturbed with a seed (0: not at all).

    Raises:
        InputError: the recording cannot be used, or has no truth.
    """
    config, seed = task
    config, _, run = run_recording(config, perturb if seed else None, seed)
    false = int((closure_errors(run.truth, run.closures) > 2.5 * config.pose_cells.cell_size).sum())
    final, odometry = (known_ate(poses, run.truth) for poses in (run.trajectory, run.odometry))
    return final, odometry, len(run.closures), false
