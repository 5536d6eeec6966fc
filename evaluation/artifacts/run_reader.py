"""The files of a run directory as arrays and records, also those of a run that was interrupted.

`read_run` gives poses, experiences and truth; `read_manifest` what was run and how it ended;
`read_closure_table` all loop closures that the map considered (`closures.csv`); `read_changes` the places at
which a session does not agree with its map (`changes.csv`); `read_closure_views` and `read_whisker_views` the
images. `pieces.csv` gives the piece of the map in which each step is; only a map of several pieces has it. A
folder with `merge.json` holds a map merged of several sessions and is no run.
"""

from __future__ import annotations

import csv
import fcntl
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from evaluation.metrics.run_metrics import NOT_JUDGED, UNFINISHED, RunArrays
from evaluation.metrics.scorecard import Scorecard
from evaluation.metrics.trajectory import read_tum
from tactile.base.bounded import LARGEST_NUMBER, read_json, read_npz, read_rows, read_text, read_text_table
from tactile.base.errors import InputError

PIECES = "pieces.csv"
PIECE_COLUMNS = ("t", "piece")


def write_pieces(path: Path, time: np.ndarray, piece: np.ndarray) -> None:
    """Writes the piece [N] of steps at times [N], s."""
    lines = [f"{t!r},{one}" for t, one in zip(time.tolist(), piece.tolist(), strict=True)]
    Path(path).write_text("\n".join([",".join(PIECE_COLUMNS), *lines]) + "\n", encoding="utf-8")


def _read_pieces(path: Path, steps: int) -> np.ndarray:
    """The piece [steps] of each step, 0 without the file."""
    if not path.exists():
        return np.zeros(steps, int)
    piece = read_text_table(path, dict.fromkeys(PIECE_COLUMNS, ()))[0][:, 1]
    if len(piece) < steps:
        raise InputError(str(path), f"{len(piece)} lines", f"{steps}, one for each step")
    if not ((piece >= 0) & (piece < 2**31) & (piece == np.round(piece))).all():
        raise InputError(str(path), "a piece that is no number of one", "whole numbers from 0")
    return piece[:steps].astype(int)


MERGE_REPORT = "merge.json"


def is_merged(folder: Path) -> bool:
    """Whether a folder holds a merged map."""
    return (folder / MERGE_REPORT).exists()


def _refuse_merged(folder: Path) -> None:
    """Raises `InputError` if a folder holds a merged map, which has no steps of a run."""
    if is_merged(folder):
        cure = f"{folder}/map.png shows it, {MERGE_REPORT} says what joined it, and `map info` what is in it"
        raise InputError(str(folder), "a merged map, which has no steps", "the directory of a run", cure)


def read_session_steps(folder: Path) -> list[int]:
    """Number of steps of each session of a merged folder, in the order of its map."""
    expected = f"the {MERGE_REPORT} of a merged map"
    return read_json(folder / MERGE_REPORT, expected, lambda content: list(map(int, content["steps"])))


def check_run_directory(path: Path) -> None:
    """Checks that a folder holds a run.

    Raises:
        InputError: there is no such folder, or it holds no run.
    """
    if not path.is_dir():
        raise InputError(str(path), "no such folder", "the directory of a run")
    _refuse_merged(path)
    if not any((path / name).exists() for name in ("manifest.json", "steps.csv")):
        raise InputError(str(path), "no run in this folder", "the directory of a run")


def read_run(path: Path) -> RunArrays:
    """Reads the arrays of a run. Without a final trajectory (interrupted run) the online one replaces it.

    Raises:
        InputError: a file is missing or malformed, or it is a merged map.
    """
    _refuse_merged(path)
    online_time, online = _tum(path / "online.tum")
    odometry_time, odometry = _tum(path / "odometry.tum")
    place = read_columns(path / "steps.csv", "place")[0].astype(int)
    steps = min(len(online_time), len(odometry_time), len(place))
    if steps == 0:
        raise InputError(str(path), "a run without steps", "a run directory with results")
    time = online_time[:steps]
    there = (path / "truth.tum").exists()
    truth_time, truth = _tum(path / "truth.tum") if there else (np.zeros(0), np.zeros((0, 3)))
    known, row = np.isin(time, truth_time), np.searchsorted(truth_time, time)
    true = np.full((steps, 3), np.nan)
    true[known] = truth[row[known]]
    final = _tum(path / "trajectory.tum")[1] if (path / "trajectory.tum").exists() else online
    errors = path / "online_error.csv"
    nodes, links, node_piece = np.zeros((0, 3)), np.zeros((0, 2), int), np.zeros(0, int)
    if (path / "map.json").exists():
        nodes, links, node_piece = read_json(path / "map.json", "the map.json of a run directory", _graph)
    place = np.where(place[:steps] < len(nodes), place[:steps], -1)
    created = np.full(len(nodes), -1)  # the first step at each node
    visited, step = np.unique(place, return_index=True)
    created[visited[visited >= 0]] = step[visited >= 0]
    doubt, unjudged = np.nan, NOT_JUDGED if (path / "trajectory.tum").exists() else UNFINISHED
    if (path / "health.json").exists():
        doubt, unjudged = read_json(
            path / "health.json",
            "the health.json of a run directory",
            lambda content: (
                (np.nan, str(content["reason"]))
                if content["worse_than_odometry"] is None
                else (float(content["worse_than_odometry"]), "")
            ),
        )
    run = RunArrays(
        time=time,
        truth=true if known.any() else None,
        online=online[:steps],
        final=final[:steps],
        odometry=odometry[:steps],
        experience=place,
        created=created,
        nodes=nodes,
        links=links,
        online_error=read_columns(errors, "error")[0] if errors.exists() else np.zeros(0),
        doubt=doubt,
        unjudged=unjudged,
        warnings=read_manifest(path).warnings,
        piece=_read_pieces(path / PIECES, steps),
        node_piece=node_piece,
        state=_states(path / "localisation.csv", steps),
    )
    found = np.flatnonzero(run.found)
    if not len(run.state):
        return run
    # The map is older than a localised session, so its pieces have numbers of their own, below 0. That of the
    # experience nearest to where the session was last found is the piece of the session.
    in_map = -1 - run.node_piece
    if len(found) and len(nodes):
        nearest = np.hypot(*(nodes - run.final[found[-1]])[:, :2].T).argmin()
        in_map = np.where(in_map == in_map[nearest], run.main, in_map)
    return run._replace(node_piece=in_map)


def has_steps(path: Path) -> bool:
    """Whether a run directory has a step."""
    online = path / "online.tum"
    return online.exists() and online.stat().st_size > 0


def read_scorecard(path: Path) -> Scorecard:
    """Reads the scorecard in a run directory."""
    file = path / "scorecard.json"
    return read_json(file, "the directory of a scored run", Scorecard.model_validate)


WALL_COLUMNS = ("west", "south", "east", "north", "height")
"""Columns of walls.csv, m: axis-aligned boxes in the frame of the truth."""


def write_walls(path: str | Path, walls: np.ndarray) -> None:
    """Writes walls [B, 5]; the floats read back equal."""
    lines = [",".join(WALL_COLUMNS), *(",".join(map(repr, row)) for row in walls.tolist())]
    Path(path).write_text("\n".join(lines) + "\n", encoding="utf-8")


def read_walls(path: Path) -> np.ndarray:
    """Reads the walls [B, 5] of a run directory; B is 0 without the file."""
    file = path / "walls.csv"
    if not file.exists():
        return np.zeros((0, len(WALL_COLUMNS)))
    return read_text_table(file, dict.fromkeys(WALL_COLUMNS, ()))[0]


def first_step(path: Path) -> int:
    """The number of the first step of a run directory: above 0 if the run continues another.

    Manifests of earlier versions do not tell it; the map of a run that has ended does.
    """
    with suppress(InputError):
        return read_json(path / "manifest.json", "a manifest", lambda content: int(content["first_step"]))
    saved = checkpoint_steps(path)
    return max(0, saved - len(_tum(path / "online.tum")[0])) if saved else 0


def checkpoint_steps(path: Path) -> int:
    """Number of steps in the checkpoint (map.npz) of a run directory; 0 without a readable one."""
    try:
        return read_npz(path / "map.npz", ("steps",), int, "a checkpoint")
    except InputError:
        return 0


def read_columns(path: Path, *names: str, empty: float | None = None) -> list[np.ndarray]:
    """Numeric columns of a growing CSV file of a run; an incomplete last line is dropped.

    Args:
        empty: value of an empty cell; None: an empty cell is an error.
    """
    text, found = read_text(path, "a file of a run directory"), []
    header, *lines = text[: text.rfind("\n") + 1].splitlines() or [",".join(names)]
    fields, rows = header.split(","), [line.split(",") for line in lines]
    for name in names:
        try:
            at = fields.index(name)
            cells = [row[at] for row in rows]
            column = np.array([empty if empty is not None and cell == "" else float(cell) for cell in cells])
            if ((np.abs(column) > LARGEST_NUMBER) & np.isfinite(column)).any():
                raise ValueError
        except (ValueError, IndexError):
            cause = f"a row without a number in column {name}"
            raise InputError(str(path), cause, f"column {name}") from None
        found.append(column)
    return found


def _tum(path: Path) -> tuple[np.ndarray, np.ndarray]:
    if not path.exists():
        raise InputError(str(path), "no such file", "a file of a run directory")
    time, pose = read_tum(path) if path.stat().st_size else (np.zeros(0), np.zeros((0, 3)))
    if (np.diff(time) < 0).any():
        raise InputError(str(path), "times that decrease", "a file of a run directory")
    return time, pose


def _states(path: Path, steps: int) -> np.ndarray:
    """[N] the state of each step of a localised session; empty without the file."""
    if not path.exists():
        return np.zeros(0, str)
    lines = read_text(path, "the states of a session").splitlines()[1 : steps + 1]
    states = [cells[1] for cells in (line.split(",") for line in lines) if len(cells) > 1]
    if len(states) < steps:
        raise InputError(str(path), "not a state for each step", f"{steps} lines step,state,...")
    return np.array(states, str)


def _graph(content: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Nodes [M, 3], links [L, 2] and pieces [M] of a node-link file."""
    rows = [[node["x"], node["y"], node["heading"]] for node in content["nodes"]]
    piece = np.array([node.get("piece", 0) for node in content["nodes"]], int)
    pairs = [[link["source"], link["target"]] for link in content.get("edges", content.get("links"))]
    nodes, links = np.array(rows, float).reshape(-1, 3), np.array(pairs).reshape(-1, 2)
    if not np.isfinite(nodes).all():
        raise ValueError("a pose that is not finite")
    if links.size and (links.dtype.kind != "i" or links.min() < 0 or links.max() >= len(nodes)):
        raise ValueError("a link to no node")
    return nodes, links.astype(int), piece


SESSION_REPORT = "live.json"
"""Report of a live session, written when it has ended."""
RUNNING = "running"
"""Status of a run that has not ended, or was killed."""


class Manifest(NamedTuple):
    """The manifest of a run.

    Attributes:
        status: `running`, `complete` or `interrupted`; of a live session that ended before its map was
            finished, the outcome from its report. source: name of the recording or simulation.
        total: final number of steps, if known. seed: of the session, if known.
        versions: of the program, its libraries and Python. continued: whether it went on from a map.
        killed: it has not ended, and no process writes it. digest: sha256 of its recording or simulation,
            '' of a live session. warnings: about the input, a sentence each.
    """

    status: str = RUNNING
    source: str = ""
    total: int | None = None
    seed: int | None = None
    versions: Mapping[str, str] = {}
    continued: bool = False
    killed: bool = False
    digest: str = ""
    warnings: tuple[str, ...] = ()


def read_manifest(directory: Path) -> Manifest:
    """Reads the manifest; that of a run without the file has no versions."""
    file = directory / "manifest.json"
    found = read_json(file, "the manifest of a run", _parse_manifest) if file.exists() else Manifest()
    if found.status != RUNNING:
        return found
    killed, report = file.exists() and _is_left(directory / "steps.csv"), directory / SESSION_REPORT
    if not report.exists():
        return found._replace(killed=killed)
    outcome = read_json(report, "the report of a live session", lambda content: str(content["outcome"]))
    return found._replace(killed=killed, status=outcome)


def _parse_manifest(content: Any) -> Manifest:
    recording, versions, seed = content["recording"], content.get("versions", {}), content.get("seeds", {})
    total = None if content["continued"] else recording["samples"]
    return Manifest(
        status=str(content["status"]),
        source=str(recording.get("name", "")),
        total=None if total is None else int(total),
        seed=None if seed.get("session") is None else int(seed["session"]),
        versions={str(name): str(version) for name, version in versions.items()},
        continued=bool(content["continued"]),
        digest=str(recording.get("sha256", "")),
        warnings=tuple(map(str, content.get("input", {}).get("warnings", ()))),
    )


def _is_left(file: Path) -> bool:
    """Whether no process holds the lock of a run; False where that cannot be told."""
    try:
        with file.open("rb") as opened:
            fcntl.flock(opened, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except FileNotFoundError:
        return True  # before its first line
    except OSError:
        return False
    return True


ACCEPTED = "accepted"
"""Verdict on the closures of the map."""
CLOSURE_COLUMNS = ("step", "match_step", "verdict")
"""Columns that every closures.csv has; a map may add columns of numbers."""


class ClosureTable(NamedTuple):
    """The closures of a run, n of them, in the order of the file.

    Attributes:
        steps: [n, 2] the earlier and the later step that a closure joins, counted from the first step of
            this run: negative in the run that this one continues.
        verdicts: [n] `accepted`, or why it is no closure of the map.
        evidence: the other columns, [n] each, by name.
    """

    steps: np.ndarray
    verdicts: list[str]
    evidence: Mapping[str, np.ndarray]

    def accepted(self) -> np.ndarray:
        """[n] bool, which are closures of the map."""
        return np.array([verdict == ACCEPTED for verdict in self.verdicts], bool)


def read_closure_table(directory: Path) -> ClosureTable:
    """Reads the closures of a run directory; none without the file."""
    file = directory / "closures.csv"
    if not file.exists():
        return ClosureTable(np.zeros((0, 2), int), [], {})

    def parse(row: Mapping[str, str]) -> tuple[list[int], str, dict[str, float]]:
        pair = [int(np.int32(row[name])) for name in ("match_step", "step")]
        return (
            pair,
            str(row["verdict"]),
            {name: float(row[name]) for name in row if name not in CLOSURE_COLUMNS},
        )

    rows = read_rows(file, "the columns step, match_step, verdict, and numbers in all others", parse)
    names = rows[0][2] if rows else {}
    evidence = {name: np.array([cells[name] for _, _, cells in rows]) for name in names}
    steps = np.array([pair for pair, _, _ in rows], int).reshape(-1, 2) - first_step(directory)
    return ClosureTable(steps, [verdict for _, verdict, _ in rows], evidence)


def read_closures(directory: Path) -> np.ndarray:
    """The pairs of steps [n, 2] of this run that are joined by accepted closures; n is 0 without the file."""
    table = read_closure_table(directory)
    return table.steps[table.accepted() & (table.steps >= 0).all(axis=1)]


def write_closure_pairs(path: Path, pairs: np.ndarray) -> None:
    """Writes accepted closures without evidence: pairs [n, 2] of steps, the later and the earlier."""
    lines = (f"{later},{earlier},{ACCEPTED}\n" for later, earlier in pairs.tolist())
    Path(path).write_text("".join([",".join(CLOSURE_COLUMNS) + "\n", *lines]), encoding="utf-8")


class Closures(NamedTuple):
    """Loop closures of a run: proposed and accepted ones, and sequences of both."""

    proposed: int
    accepted: int
    sequences: int
    accepted_sequences: int


def count_closures(path: Path) -> Closures | None:
    """The loop closures in closures.csv; None if there are none, as of a method that proposes none."""
    if not (path / "closures.csv").exists():
        return None
    table = read_closure_table(path)
    accepted = table.accepted()
    sequence = table.evidence.get("sequence", np.arange(len(accepted)))
    sequences = len(np.unique(sequence)), len(np.unique(sequence[accepted]))
    return Closures(len(accepted), int(accepted.sum()), *sequences)


CHANGES = "changes.csv"


class ChangeRow(NamedTuple):
    """One place, a line of the file: m, m, m; `new`, `gone` or `different`; nat; expected number by chance;
    number of passes; steps of the session that contradict."""

    x: float
    y: float
    extent: float
    kind: str
    evidence: float
    alarms: float
    passes: int
    first_step: int
    last_step: int

    @classmethod
    def parse(cls, line: Mapping[str, str]) -> ChangeRow:
        """The place of a line of the file; a ValueError for a line that is malformed."""
        numbers = [float(line[name]) for name in ("x", "y", "extent", "evidence", "alarms")]
        if not np.isfinite(numbers).all():
            raise ValueError("a number that is not finite")
        x, y, extent, evidence, alarms = numbers
        passes, first, last = (int(np.int32(line[name])) for name in ("passes", "first_step", "last_step"))
        return cls(x, y, extent, str(line["kind"]), evidence, alarms, passes, first, last)

    def describe(self) -> str:
        """The place in one line."""
        what = {"new": "something new", "gone": "something gone"}.get(self.kind, "something different")
        where = f"({self.x:.2f}, {self.y:.2f}) m, {self.extent:.2f} m long"
        when = f"{self.passes} passes, steps {self.first_step} to {self.last_step}"
        return f"changed: {what} at {where}, {when}, evidence {self.evidence:.0f} nat"


def write_changes(path: Path, changes: Sequence[ChangeRow]) -> None:
    """Writes the places, the surest first."""
    with path.open("w", encoding="utf-8", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows([ChangeRow._fields, *changes])


def read_changes(path: Path) -> list[ChangeRow]:
    """Reads the places."""
    return read_rows(path, f"the columns {', '.join(ChangeRow._fields)}", ChangeRow.parse)


CLOSURE_VIEWS = "closure_views.npz"


class ClosureViews(NamedTuple):
    """Views of n steps.

    Attributes:
        step: [n] increasing, counted from the first step of this run.
        view: [n, R, C] uint8, brightness.
    """

    step: np.ndarray
    view: np.ndarray


def eight_bit(view: np.ndarray) -> np.ndarray:
    """A view [R, C, K] in 0..1 as an image [R, C] of its first channel in 0..255; only 0 becomes 0."""
    return np.ceil(255 * np.clip(view[..., 0], 0.0, 1.0)).astype(np.uint8)


def write_closure_views(path: Path, views: ClosureViews) -> None:
    """Writes the file; equal views give equal bytes."""
    np.savez_compressed(path, step=views.step, view=views.view)


def read_closure_views(directory: Path) -> ClosureViews | None:
    """Reads the views of a run directory; None without the file."""

    def parse(step: np.ndarray, view: np.ndarray) -> ClosureViews:
        if step.ndim != 1 or view.ndim != 3 or len(step) != len(view) or view.dtype != np.uint8:
            raise ValueError("arrays that do not fit each other")
        return ClosureViews(step.astype(int), view)

    file = directory / CLOSURE_VIEWS
    expected = "the views of a run directory: step [n] and view [n, R, C] of 8 bits"
    return read_npz(file, ClosureViews._fields, parse, expected) if file.exists() else None


_WHITE = 255


class WhiskerViews(NamedTuple):
    """Whisker images of N steps and a head with R rings of C whiskers.

    Attributes:
        view: [N, R, C] pixel values in 0..1, 0 without contact.
        alive: [N, R, C] bool, the whisker has a signal.
        azimuth: [C] direction of the whiskers of each column, rad counter-clockwise from ahead.
        length: [R] length of the whiskers of each ring, m. tallest: obstacle height of pixel value 1, m.
    """

    view: np.ndarray
    alive: np.ndarray
    azimuth: np.ndarray
    length: np.ndarray
    tallest: float


def write_whisker_views(path: str | Path, images: WhiskerViews) -> None:
    """Writes an .npz file with pixel values in 255 steps; equal images give equal bytes."""
    arrays = {name: np.asarray(array) for name, array in images._asdict().items()}
    # Rounded up, so that a whisker in contact is never 0.
    arrays["view"] = np.ceil(_WHITE * images.view).astype(np.uint8)
    np.savez_compressed(path, **arrays)  # type: ignore[arg-type]


def read_whisker_views(path: str | Path) -> WhiskerViews:
    """The inverse of `write_whisker_views`, except for rounding."""

    def parse(view: np.ndarray, *arrays: np.ndarray) -> WhiskerViews:
        alive, azimuth, length, tallest = arrays
        rings, columns = view.shape[1:]
        if (length.shape, azimuth.shape, alive.shape) != ((rings,), (columns,), view.shape):
            raise ValueError("arrays that do not fit each other")
        return WhiskerViews(view / _WHITE, alive, azimuth, length, float(tallest))

    return read_npz(path, WhiskerViews._fields, parse, "the views.npz of a run directory")
