"""A run as arrays (`RunArrays`), and its metrics (`RUN_METRICS`): extent, trajectory errors, Energy Metric,
Experience Metric.

Some are of maps in several pieces. A robot that was carried away begins a new piece; a loop closure with an
older piece joins the two. The map defines no motion between steps in different pieces, so an error of such a
pair says nothing about it.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from evaluation.metrics.energy_metric import Energy, Relations, energy, energy_all_pairs, relation_errors
from evaluation.metrics.exm import DEFAULT_EXM, EXM_MODES, ExmConfig, base_end, change_rows, experience_metric
from evaluation.metrics.metric import Direction, Finding, Metric, Quantity
from evaluation.metrics.trajectory import (
    align,
    ate,
    online_errors,
    position_error,
    position_errors,
    rpe,
    successive_pairs,
    summarize_errors,
)
from tactile.base.errors import InputError
from tactile.base.se2 import between, compose, inverse

FOUND = "found"
"""State of a step whose pose in the map is known."""
NOT_JUDGED = "not judged by this method"
UNFINISHED = "not judged before the end of the run"
"""Why a map is not judged; another reason is given in its run directory."""


class RunArrays(NamedTuple):
    """Poses, experiences and truth of a run with N steps, M experiences and L links.

    Attributes:
        time: [N] s, increasing.
        truth: [N, 3] true poses (m, m, rad), NaN in rows without one; or None.
        online: [N, 3] online pose at each step. final: [N, 3] pose of each step in the final map.
        odometry: [N, 3] dead reckoning of raw odometry from any start.
        experience: [N] current experience, an index into `nodes`, -1 for none.
        created: [M] step at which each experience was first visited, -1: not in this run.
        nodes: [M, 3] poses of the experiences in the final map, in the frame of `final`.
        links: [L, 2] linked experiences.
        doubt: probability, by the map itself, that its error is worse than odometry's; NaN if there is none.
        unjudged: why there is none. warnings: about the input, a sentence each.
        online_error: [A] position errors of the current pose in the map of that time, m; empty if unknown.
        piece: [N] the piece of the map in which each step is, see `evaluation.metrics.run_metrics`; empty:
            all steps are in one.
        node_piece: [M] the piece of each experience, which may have no steps; empty: that of its first visit.
        state: [N] of a session localised in a map: found, searching, ... ; empty for others.
    """

    time: np.ndarray
    truth: np.ndarray | None
    online: np.ndarray
    final: np.ndarray
    odometry: np.ndarray
    experience: np.ndarray
    created: np.ndarray
    nodes: np.ndarray
    links: np.ndarray
    online_error: np.ndarray = np.zeros(0)
    doubt: float = np.nan
    unjudged: str = NOT_JUDGED
    warnings: tuple[str, ...] = ()
    piece: np.ndarray = np.zeros(0, int)
    node_piece: np.ndarray = np.zeros(0, int)
    state: np.ndarray = np.zeros(0, str)

    @property
    def has_pieces(self) -> bool:
        """Whether the map is in several pieces, whose poses cannot be compared."""
        return len(np.unique(self.piece)) > 1

    @property
    def found(self) -> np.ndarray:
        """[N] bool, which steps are known in the frame of the map: all where nothing was localised."""
        return self.state == FOUND if len(self.state) else np.ones(len(self.time), bool)

    @property
    def main(self) -> int:
        """The piece in whose frame pictures and commands give places: the one that was found in its map
        (-1 if none was), else the largest."""
        if not len(self.piece):
            return 0
        numbers, steps = np.unique(self.piece[self.found], return_counts=True)
        return int(numbers[steps.argmax()]) if len(numbers) else -1

    @property
    def truth_rows(self) -> np.ndarray:
        """The steps [K] with a true pose."""
        if self.truth is None:
            return np.zeros(0, int)
        return np.flatnonzero(np.isfinite(self.truth).all(axis=1))

    def ranked_pieces(self) -> list[tuple[int, int]]:
        """Rank and number of each piece: `main` first, with rank 0, then by the number of their steps."""
        numbers, sizes = np.unique(self.piece, return_counts=True)
        ranks = np.argsort(-sizes - len(self.piece) * (numbers == self.main), kind="stable")
        return list(enumerate(numbers[ranks].tolist(), start=self.main < 0))

    def name_piece(self, number: int) -> str:
        """A piece in words."""
        rows = np.flatnonzero(self.piece == number)
        if len(self.state) and len(rows):
            return f"{self.state[rows[-1]].replace('_', ' ')}, {len(rows):,} steps"
        return f"piece {number + 1}, {len(rows):,} steps"

    def check(self) -> None:
        """Raises `InputError` if an array has a wrong shape, an unknown value or an index out of range."""
        steps, nodes = len(self.time), len(self.nodes)
        shapes: dict[str, tuple[int, ...]] = dict.fromkeys(("time", "experience"), (steps,))
        shapes |= dict.fromkeys(("online", "final", "odometry"), (steps, 3))
        shapes |= {"created": (nodes,), "nodes": (nodes, 3), "links": (len(self.links), 2)}
        if self.truth is not None:
            shapes["truth"] = (steps, 3)
        for name, shape in shapes.items():
            array = np.asarray(getattr(self, name))
            if array.shape != shape:
                raise InputError(f"run.{name}", f"shape {array.shape}", str(shape))
            if name != "truth" and not np.isfinite(array).all():
                raise InputError(f"run.{name}", "a NaN or infinite value", "finite numbers")
        if steps == 0:
            raise InputError("run.time", "no steps", "at least one")
        for name, low, high in (("experience", -1, nodes), ("created", -1, steps), ("links", 0, nodes)):
            index = np.asarray(getattr(self, name))
            if index.size and not (low <= index.min() and index.max() < high):
                raise InputError(f"run.{name}", f"{index.min()} to {index.max()}", f"{low} to {high - 1}")


FAR = 2.0
"""Distance of a jump that no correction within a piece makes, in diagonals of the box of dead reckoning."""
GAP = 0.1
"""Distance between two pieces in a picture, as a share of the width of the first one."""


def energy_within_pieces(estimate: np.ndarray, truth: np.ndarray, piece: np.ndarray) -> Energy:
    """Energy over every pair of steps i < j in the same piece.

    Args:
        estimate: [T, 3] poses. truth: [T, 3] true poses. piece: [T] the piece of each step, int.
    """
    found = [energy_all_pairs(estimate[piece == one], truth[piece == one]) for one in np.unique(piece)]
    known = [part for part in found if part.pairs]
    if len(known) == 1:
        return known[0]
    pairs = sum(part.pairs for part in known)
    if not pairs:
        return Energy(np.nan, np.nan, 0)
    trans2 = sum(part.trans2 * part.pairs for part in known) / pairs
    rot2 = sum(part.rot2 * part.pairs for part in known) / pairs
    return Energy(trans2, rot2, pairs)


def ate_within_pieces(estimate: np.ndarray, truth: np.ndarray, piece: np.ndarray) -> float:
    """Root mean square position error, m, after an alignment of each piece by itself; NaN without steps."""
    if not len(piece):
        return np.nan
    errors = [position_errors(estimate[piece == one], truth[piece == one]) for one in np.unique(piece)]
    return float(np.sqrt((np.concatenate(errors) ** 2).mean()))


def arrange_pieces(run: RunArrays) -> RunArrays:
    """The run with its pieces where a picture shows them: `run.main` stays, in the frame of the map; the
    others are aligned to the truth as that one is or, where that is unknown, stand beside the one before.
    Within a piece nothing changes; a run of one piece is left as it is. Experiences and online poses move
    with their pieces."""
    of_node = run.node_piece
    if not len(run.piece):
        return run
    if not len(of_node):
        of_node = np.where(run.created < 0, run.main, run.piece[run.created])
    numbers, sizes = np.unique(run.piece, return_counts=True)
    order = [run.main, *numbers[np.argsort(-sizes, kind="stable")], *np.unique(of_node)]
    pieces = [one for one in dict.fromkeys(map(int, order)) if one in run.piece or one in of_node]
    if len(pieces) < 2:
        return run
    final, online, nodes = run.final.copy(), run.online.copy(), run.nodes.copy()
    rows, to_map, shown = run.truth_rows, None, list[np.ndarray]()
    for one in pieces:
        steps, placed = run.piece == one, of_node == one
        known, moved = rows[steps[rows]], np.zeros(3)
        inside = np.concatenate([final[steps], nodes[placed]])
        if to_map is not None and run.truth is not None and len(known):
            moved = compose(to_map, align(final[known], run.truth[known]))
        elif shown:
            right = max(part[:, 0].max() for part in shown) + GAP * np.ptp(shown[0][:, 0])
            moved[:2] = [right, shown[0][:, 1].min()] - inside[:, :2].min(axis=0)
        for poses, own in ((final, steps), (online, steps), (nodes, placed)):
            poses[own] = compose(moved, poses[own])
        shown.append(compose(moved, inside))
        if to_map is None and run.truth is not None and len(known):
            to_map = align(run.truth[known], final[known])
    return run._replace(final=final, online=online, nodes=nodes, node_piece=of_node)


IN_PLACE = np.zeros(3)


class Layers(NamedTuple):
    """Positions [.., 2] (m) to draw, in the frame of the map.

    `to_map` [3] moves true poses there.
    """

    truth: np.ndarray | None
    odometry: np.ndarray
    final: np.ndarray
    nodes: np.ndarray
    to_map: np.ndarray = IN_PLACE

    @classmethod
    def align(cls, run: RunArrays) -> Layers:
        """The layers of a run: the truth aligned to the map and odometry to the truth, as for ATE; without
        truth, odometry starts at the first pose of the map."""
        rows = run.truth_rows
        if run.truth is None or len(rows) == 0:
            to_map = compose(run.final[0], between(run.odometry[0], np.zeros(3)))
            return cls(None, _xy(compose(to_map, run.odometry)), _xy(run.final), _xy(run.nodes))
        true = run.truth[rows]
        to_map = align(true, run.final[rows])
        odometry = compose(compose(to_map, align(run.odometry[rows], true)), run.odometry)
        truth = compose(to_map, run.truth)
        return cls(_xy(truth), _xy(odometry), _xy(run.final), _xy(run.nodes), to_map)

    def box(self, room: float, *others: np.ndarray) -> np.ndarray:
        """[[left, bottom], [right, top]] of truth, map and other points, and of odometry near them: within
        `room`, as a share of the size."""
        known = [self.final, self.nodes, *others] + ([] if self.truth is None else [self.truth])
        low, high = bounds(*known)
        margin, (far_low, far_high) = room * (high - low).max(), bounds(self.odometry)
        if room:
            low = np.minimum(low, np.maximum(far_low, low - margin))
            high = np.maximum(high, np.minimum(far_high, high + margin))
        return np.stack([low, high])


def bounds(*points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The minimum and maximum coordinates [2] of points [.., 2]."""
    every = np.concatenate([part.reshape(-1, 2) for part in points])
    return np.nanmin(every, axis=0), np.nanmax(every, axis=0)


def _xy(pose: np.ndarray) -> np.ndarray:
    return np.asarray(pose)[..., :2]


def _tie_jump(poses: np.ndarray, odometry: np.ndarray) -> tuple[int, float] | None:
    """The step at which online poses jump farther than a correction within a piece could move them, and how
    far, m; None without one. A piece lies far from all others until it is tied to them.

    Args:
        poses: [T, 3] online, each in the map of its time. odometry: [T, 3] dead reckoning.
    """
    if len(poses) < 2:
        return None
    moved = np.hypot(*np.diff(poses[:, :2], axis=0).T)
    step, reach = int(moved.argmax()) + 1, np.hypot(*np.ptp(odometry[:, :2], axis=0))
    return (step, float(moved.max())) if moved.max() > FAR * reach > 0 else None


def unjoined_share(piece: np.ndarray) -> float:
    """Share of the steps outside the largest piece; NaN without steps.

    Args:
        piece: [T] the piece of each step, int.
    """
    _, steps = np.unique(piece, return_counts=True)
    return float(1 - steps.max() / len(piece)) if len(piece) else np.nan


class RunData(NamedTuple):
    """The input of run metrics.

    Attributes:
        run, exm: as scored. rows: [K] steps with a true pose. findings: those of `RUN_METRICS` by name;
            values that need a missing truth are left out.
    """

    run: RunArrays
    exm: ExmConfig
    rows: np.ndarray
    findings: dict[str, Finding]


def _metric(name: str, label: str, unit: str, direction: Direction, section: str) -> Metric:
    return Metric(name, label, unit, direction, section, lambda data: data.findings.get(name))


_PAIRS = {
    "change": "successive experience changes",
    "consecutive": "consecutive steps",
    "gap": "steps at a gap",
    "links": "linked experiences",
    "all": "all pairs of steps",
}
PIECES = "Pieces"
"""Heading of the metrics of a map in several pieces."""
PAIR_GAP = 10
"""Distance of the pairs of `energy_gap`, steps."""
_PARTS = (("", "", "m2+rad2"), ("_trans2", ", trans", "m2"), ("_rot2", ", rot", "rad2"))
RUN_METRICS: tuple[Metric, ...] = (
    _metric("steps", "steps", "", None, "Extent"),
    _metric("duration", "duration", "s", None, "Extent"),
    _metric("path", "length of the true path", "m", None, "Extent"),
    _metric("experiences", "experiences", "", None, "Extent"),
    _metric("links", "links", "", None, "Extent"),
    _metric("map_doubt", "map worse than odometry, probability", "", None, "Health"),
    _metric("pieces", "pieces that nothing joins", "", None, PIECES),
    _metric("unjoined_share", "share of steps outside the largest piece", "", "low", PIECES),
    _metric("energy_within_pieces", "Energy Metric within pieces", "m2+rad2", "low", PIECES),
    _metric("ate_within_pieces", "ATE within pieces", "m", "low", PIECES),
    _metric("ate_final", "ATE, final", "m", "low", "Trajectory"),
    _metric("ate_online", "ATE, online", "m", "low", "Trajectory"),
    _metric("anytime_median", "online error, median", "m", "low", "Trajectory"),
    _metric("anytime_late", "online error, RMS of the second half", "m", "low", "Trajectory"),
    _metric("anytime_jump", "online error, largest jump", "m", "low", "Trajectory"),
    _metric("rpe_translation", "RPE over one step, translation", "m", "low", "Trajectory"),
    _metric("rpe_rotation_deg", "RPE over one step, rotation", "deg", "low", "Trajectory"),
    _metric("relations_translation", "relations file, translation", "m", "low", "Trajectory"),
    _metric("relations_rotation_deg", "relations file, rotation", "deg", "low", "Trajectory"),
    *(
        _metric(f"energy_{pairs}{suffix}", label + part, unit, "low", "Energy Metric")
        for pairs, label in _PAIRS.items()
        for suffix, part, unit in _PARTS
    ),
    _metric("exm_base", "base set", "entries", None, "Experience Metric"),
    _metric("exm_arr", "ARR", "", "high", "Experience Metric"),
    *(_metric(f"exm_arcr_{mode}", f"ARCR, {mode}", "", "high", "Experience Metric") for mode in EXM_MODES),
    _metric("exm_action_arr", "ARR, per action", "", "high", "Experience Metric"),
    _metric("exm_action_arcr_strict", "ARCR, strict, per action", "", "high", "Experience Metric"),
)
"""In the order of the scorecard."""
_EXPERIENCE = [metric.name for metric in RUN_METRICS if metric.section == "Experience Metric"]
DOUBTED = 0.7
"""Probability of being worse than odometry above which a map is doubted (`ratslam.mapping.map_solution`)."""


def run_data(run: RunArrays, exm: ExmConfig = DEFAULT_EXM, relations: Relations | None = None) -> RunData:
    """Computes the findings of a run; `relations` are true relative motions of the recording, if any."""
    rows, truth = run.truth_rows, run.truth
    note = "map_doubted: the trajectory is odometry" if run.doubt > DOUBTED else ""
    findings = {
        "steps": Finding(len(run.time)),
        "duration": Finding(float(run.time[-1] - run.time[0])),
        "experiences": Finding(len(run.nodes)),
        "links": Finding(len(run.links)),
        "map_doubt": Finding(run.doubt, note=note if np.isfinite(run.doubt) else run.unjudged),
    }
    if run.has_pieces:
        findings |= _piece_findings(run, rows)
    if relations is not None:
        translation, rotation, used, dropped = relation_errors(run.time, run.final, relations)
        raw_translation, raw_rotation, *_ = relation_errors(run.time, run.odometry, relations)
        note = f"{used} relations" + (f", {dropped} outside the recording" if dropped else "")
        findings["relations_translation"] = Finding(translation, raw_translation, note)
        findings["relations_rotation_deg"] = Finding(rotation, raw_rotation, note)
    if truth is None or len(rows) == 0:
        return RunData(run, exm, rows, findings | experience_findings(run.experience, None, exm))
    if len(rows) < len(run.time):
        findings["steps"] = Finding(len(run.time), note=f"{len(rows)} of them with a true pose")
    findings["path"] = Finding(path_length(truth[rows]), path_length(run.odometry[rows]))
    compared = _trajectories(run, truth, rows) | _energies(run, truth, rows)
    if run.has_pieces:  # links are within pieces; all others compare poses of different pieces
        reason = "across pieces that nothing joins"
        for name in (name for name in compared if not name.startswith("energy_links")):
            compared[name] = Finding(np.nan, compared[name].odometry, reason)
    findings |= compared
    base = None if exm.base is None else int(np.searchsorted(rows, exm.base))
    inside = exm.model_copy(update={"base": base})
    findings |= experience_findings(run.experience[rows], truth[rows], inside)
    return RunData(run, exm, rows, findings)


def _trajectories(run: RunArrays, truth: np.ndarray, rows: np.ndarray) -> dict[str, Finding]:
    truth, online, final, odometry = (poses[rows] for poses in (truth, run.online, run.final, run.odometry))
    raw_ate, (raw_translation, raw_rotation) = ate(odometry, truth), rpe(odometry, truth)
    raw_errors = summarize_errors(online_errors(odometry, truth))
    known, (translation, rotation) = len(run.online_error) > 0, rpe(final, truth)
    errors = summarize_errors(run.online_error if known else online_errors(online, truth))
    note, tied = "in the map of that time" if known else "of the online poses", ""
    if jump := _tie_jump(run.online, run.odometry):  # online poses were in a piece of their own at first
        at, distance = run.time[jump[0]], jump[1]
        tied = f"with a jump of {distance:.1f} m at t = {at:.1f} s, as where a new piece is tied"
    unfinished = np.array_equal(run.final, run.online)
    return {
        "ate_final": Finding(ate(final, truth), raw_ate, tied if unfinished else ""),
        "ate_online": Finding(ate(online, truth), raw_ate, tied),
        **{
            f"anytime_{name}": Finding(error, raw, note)
            for name, error, raw in zip(("median", "late", "jump"), errors, raw_errors, strict=True)
        },
        "rpe_translation": Finding(translation, raw_translation),
        "rpe_rotation_deg": Finding(float(np.degrees(rotation)), float(np.degrees(raw_rotation))),
    }


def _piece_findings(run: RunArrays, rows: np.ndarray) -> dict[str, Finding]:
    """Findings on a map in several pieces; rows: [K] steps with a true pose."""
    sizes = sorted(np.unique(run.piece, return_counts=True)[1].tolist(), reverse=True)
    pieces = Finding(len(sizes), note=f"{', '.join(map(str, sizes))} steps")
    found = {"pieces": pieces, "unjoined_share": Finding(unjoined_share(run.piece))}
    if run.truth is None or not len(rows):
        return found
    arrays = run.final, run.odometry, run.truth, run.piece
    final, odometry, true, piece = (values[rows] for values in arrays)
    ours, raw = (energy_within_pieces(poses, true, piece) for poses in (final, odometry))
    error, raw_error = (ate_within_pieces(poses, true, piece) for poses in (final, odometry))
    found["energy_within_pieces"] = Finding(ours.total, raw.total, f"{ours.pairs} pairs")
    return found | {"ate_within_pieces": Finding(error, raw_error, "each piece aligned by itself")}


def _energies(run: RunArrays, truth: np.ndarray, rows: np.ndarray) -> dict[str, Finding]:
    at = rows[change_rows(run.experience[rows])]
    final, odometry, true = run.final[rows], run.odometry[rows], truth[rows]
    links = run.links[np.isin(run.created, rows)[run.links].all(axis=1)]
    born, raw = truth[run.created], run.odometry[run.created]
    moves, near, far = (successive_pairs(*size) for size in ((len(at),), (len(rows),), (len(rows), PAIR_GAP)))
    ours = energy(run.nodes[run.experience[at]], truth[at], moves)
    return {
        **_energy("change", ours, energy(run.odometry[at], truth[at], moves)),
        **_energy("consecutive", energy(final, true, near), energy(odometry, true, near)),
        **_energy("gap", energy(final, true, far), energy(odometry, true, far), f"k = {PAIR_GAP}; "),
        **_energy("links", energy(run.nodes, born, links), energy(raw, born, links)),
        **_energy("all", energy_all_pairs(final, true), energy_all_pairs(odometry, true)),
    }


def _energy(pairs: str, ours: Energy, raw: Energy, note: str = "") -> dict[str, Finding]:
    return {
        f"energy_{pairs}": Finding(ours.total, raw.total, f"{note}{ours.pairs} pairs"),
        f"energy_{pairs}_trans2": Finding(ours.trans2, raw.trans2),
        f"energy_{pairs}_rot2": Finding(ours.rot2, raw.rot2),
    }


def experience_findings(
    experience: np.ndarray, truth: np.ndarray | None, config: ExmConfig
) -> dict[str, Finding]:
    """The Experience Metric in all modes; without truth only ARR, and only with a given base set."""
    if np.all(experience == -1):
        return dict.fromkeys(_EXPERIENCE, Finding(np.nan, note="no experiences"))
    if truth is None and config.base is None:
        reason = "no ground truth, and no base set given"
        return dict.fromkeys(_EXPERIENCE, Finding(np.nan, note=reason))
    if truth is None:  # ARR does not depend on poses
        found = experience_findings(experience, np.zeros((len(experience), 3)), config)
        return {name: value for name, value in found.items() if "arcr" not in name}
    try:
        base = base_end(truth, config.position, config.heading_deg) if config.base is None else config.base
    except InputError as error:
        return dict.fromkeys(_EXPERIENCE, Finding(np.nan, note=str(error)))
    step = {mode: config.model_copy(update={"base": base, "log": "step", "mode": mode}) for mode in EXM_MODES}
    results = {mode: experience_metric(experience, truth, step[mode]) for mode in EXM_MODES}
    strict = results["strict"]
    action = experience_metric(experience, truth, step["strict"].model_copy(update={"log": "action"}))
    return {
        "exm_base": Finding(strict.base, note="per-step log"),
        "exm_arr": Finding(strict.arr, note=f"{strict.relocalisations} of {strict.entries} entries"),
        **{f"exm_arcr_{mode}": Finding(result.arcr, note=result.note) for mode, result in results.items()},
        "exm_action_arr": Finding(action.arr, note=f"{action.relocalisations} of {action.entries} entries"),
        "exm_action_arcr_strict": Finding(action.arcr, note=action.note),
    }


def path_length(pose: np.ndarray) -> float:
    """Length of a path [N, 3], m."""
    return float(np.sum(np.hypot(*np.diff(pose[:, :2], axis=0).T)))


def recognition_error(quantities: Mapping[str, Quantity]) -> Finding:
    """1 - ARR x ARCR of a scorecard; ARCR is undefined where ARR is 0."""
    arr, arcr = (quantities[name].value for name in ("exm_arr", "exm_arcr_strict"))
    if arr is None or (arr and arcr is None):
        return Finding(np.nan)
    return Finding(1 - arr * (arcr or 0.0))


def anchored_errors(run: RunArrays) -> dict[str, Finding]:
    """Mean position errors, m, of paths that begin at the first true pose; {} if a step has no true pose."""
    truth = run.truth
    if truth is None or not np.isfinite(truth).all():
        return {}
    # All backends take the first step from odometry, so its error is not theirs.
    start = compose(truth[0], inverse(run.odometry[0]))
    paths = run.online, run.final, run.odometry
    online, final, odometry = (position_error(compose(start, path), truth) for path in paths)
    return {"error_online": Finding(online, odometry), "error_final": Finding(final, odometry)}
