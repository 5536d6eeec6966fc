"""Judges the odometry of a recording or session before it is believed.

All rules compare a recording with itself. The typical step is the one above which half of the path was
covered, and so are the typical speed, turn and turn rate; standing still and sensor noise do not affect them,
and the fastest 1 % are ignored. A finding is an error where the map must be wrong, else a warning; each names
its place and a setting that cures it. The judge changes no pose: it only refuses or warns.

| finding | rule | severity |
|---|---|---|
| unit | typical interval, speed or turn beyond `UnitLimits`; the units that explain it are named | error |
| unit | headings follow the motion only as degrees; starts of over `START` at over `FAST` m/s | error |
| repeats | what is no unit's fault once repeated poses count as one | error |
| unit | a path under `LEAST_PATH` at under `CRAWL` m/s: kilometres, or a robot that stood | warning |
| jump | one of the few largest steps, over `JUMP` typical ones | error if faster than `UnitLimits.speed` |
| gap | a velocity held over `GAP` median intervals (1 s at least), over `JUMP` typical steps | error |
| gap | the same while the robot stands; `LONG_GAP` intervals between poses or motions | warning |
| publishers | over a tenth of the steps lead back to where the robot was before | error |
| counts | steps are whole degrees or millimetres, most of one: what is below may be lost | warning |
| precision | numbers at these coordinates lie apart by over a tenth of a typical step | warning |
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

import numpy as np
from pydantic import Field

from robot.recordings.csv_config import PER_UNIT, WORDS
from robot.recordings.sanity_checks import WHOLE, RowName, Stretch, count_others
from robot.sources.odometry import UNCORRECTED, OdometryCorrection, correct_motions, replace_steps
from robot.sources.source import Warn
from tactile.base.errors import InputError
from tactile.base.settings import Settings

RATIO = 30.0  # of odometry and truth; correct data are near 1, a wrong unit gives 57 or 1000
_GLITCHES = 2  # number of fastest steps that are ignored, or a hundredth of all if that is more
JUMP = 10.0
"""Typical steps above which a step is a jump; clean recordings stay below 5.1."""
LEAST_TURN = 1.0
"""Smallest turn that is a jump, rad: a robot that hardly turns may turn sharply a few times."""
GAP, LONG_GAP, LEAST_GAP = 10.0, 100.0, 1.0
"""Median intervals above which a velocity does not hold, and above which poses have a gap; at least 1 s."""
SHORTEST, HELD, TURN = 4e-4, 5.0, 1.0
"""Shortest median interval of any odometry, s; longest, and largest typical turn, rad, over which a velocity
holds."""
FAST, START, CRAWL, LEAST_PATH = 3.0, 15.0, 1e-3, 0.1
"""Speed, m/s, from which starts are judged, and the fastest of any robot, m/s²; speed and whole path of one
that hardly moves, m/s and m."""
LEAST_COUNTS, COUNTED = 60, 0.02
"""Least number of steps that show whole units, and their largest error, units."""


class UnitLimits(Settings):
    """Limits of the unit check. Raise a limit for a robot that exceeds it."""

    speed: float = Field(default=25.0, gt=0)
    """Largest typical speed, m/s: a car in town drives 15; an arm of 30 mm/s, read as m/s, 30."""
    turn_rate: float = Field(default=6.0, gt=0)
    """Largest typical turn rate, rad/s: robots turn at 0.2 to 1, which in degrees is 11 to 57."""
    interval: float = Field(default=60.0, gt=0)
    """Longest median step, s: 100 ms taken for seconds is 100."""


DEFAULT_LIMITS = UnitLimits()


class MotionTrack(NamedTuple):
    """The data of a recording that are judged.

    Attributes:
        time: [N] s. moved: [N] rows with odometry. motion: [N, 4] (dx m, dy m, dtheta rad, dt s).
        truth: [N, 3] (x m, y m, heading rad), NaN where unknown; or None.
        held: whether velocities were recorded, which hold since the row before.
        poses: [N, 3] as recorded (x m, y m, heading rad), where poses were; else None.
    """

    time: np.ndarray
    moved: np.ndarray
    motion: np.ndarray
    truth: np.ndarray | None = None
    held: bool = False
    poses: np.ndarray | None = None


class TypicalMotion(NamedTuple):
    """Typical motion of a robot.

    Attributes:
        interval: median time between rows, s. speed: m/s. turn_rate: rad/s. turn: rad in one step.
        start: acceleration of the second fastest start from rest, m/s². true_speed: of the truth, m/s.
        path, turning: totals (odometry, truth), m and net rad. NaN without truth.
    """

    interval: float
    speed: float
    turn_rate: float
    turn: float
    start: float
    true_speed: float
    path: tuple[float, float]
    turning: tuple[float, float]


@dataclass(frozen=True)
class InputJudge:
    """How a recording is judged, and whom the judge tells.

    Attributes:
        limits: of the unit check. correction: of the odometry, which comes before the judgement.
        warn: called with one sentence for each warning; None: nobody is told.
        stretch: that is read and judged.
    """

    limits: UnitLimits = DEFAULT_LIMITS
    correction: OdometryCorrection = UNCORRECTED
    warn: Warn = None
    stretch: Stretch = WHOLE

    def say(self, sentence: str) -> None:
        """Tells a warning; a sentence that begins with `note: ` tells a fact that is no fault."""
        if self.warn is not None:
            self.warn(sentence)

    def errors(
        self,
        track: MotionTrack,
        place: RowName,
        where: str,
        clock: str = "",
        cures: Cures | None = None,
        in_order: bool = True,
    ) -> list[InputError]:
        """Judges a whole recording: tells the warnings and returns the errors.

        Args:
            place: names a row. where: names the recording. clock: what to do if its clock is at fault.
            cures: what to set for a unit; None: the odometry's scales. in_order: whether the rows have no
                errors; of others only the units are judged.
        """
        with np.errstate(all="ignore"):  # what is no number is reported by the reader
            if self.correction != UNCORRECTED:
                corrected, moved = track.motion.copy(), track.moved
                kept = replace_steps(self.correction, corrected[moved, :3])
                corrected[moved, :3] = correct_motions(self.correction, kept)
                track = track._replace(motion=corrected)
            if in_order and track.poses is not None and (finding := _two_publishers(track.poses)):
                return [InputError(place(finding.row or 0), *finding[2:])]
            if (found := unit_errors(track, where, self.limits, cures or unit_cure)) or not in_order:
                return found
            if track.poses is not None and _are_degrees(track.poses):
                said = "headings agree with the direction of motion in degrees, and not in radians"
                return [InputError(where, said, "headings in radians", (cures or unit_cure)("angle", "deg"))]
            errors = []
            for finding in _judge_steps(track, self.limits, clock):
                at = where if finding.row is None else place(finding.row)
                if finding.refused:
                    errors.append(InputError(at, finding.found, finding.expected, finding.cure))
                else:
                    self.say(f"{at}: {finding.found}; {finding.cure}")
        return errors


DEFAULT_JUDGE = InputJudge()


def limits_of(interval: float, limits: UnitLimits = DEFAULT_LIMITS) -> UnitLimits:
    """The limits for a source whose steps take so long, s; 0: as long as those of other robots."""
    longest = max(limits.interval, 3 * interval)
    return limits.model_copy(update={"interval": longest})


def judge_motion(time: np.ndarray, motion: np.ndarray, where: str, interval: float = 0.0) -> list[str]:
    """Warnings about the odometry of a session that no recording was read for: live, simulated, a plug-in.

    Args:
        time: [N] s. motion: [N, 4] (dx m, dy m, dtheta rad, dt s). where: names the session. interval: usual
            duration of a step, s, see `limits_of`.
    """
    track, limits = MotionTrack(time, np.ones(len(time), bool), motion), limits_of(interval)
    steps = _judge_steps(track, limits)
    found = [f"{where}, step {each.row or 0}: {each.found}; {each.cure}" for each in steps]
    return [*map(str, unit_errors(track, where, limits)), *found]


class _Finding(NamedTuple):
    """A finding. Attributes: refused: whether it is an error. row: its first row, None for all of them."""

    refused: bool
    row: int | None
    found: str
    expected: str
    cure: str


@np.errstate(all="ignore")
def _judge_steps(
    track: MotionTrack, limits: UnitLimits = DEFAULT_LIMITS, clock: str = ""
) -> Iterator[_Finding]:
    """Findings in single steps of a track whose units are right, errors first.

    Args:
        clock: what to do if the clock is at fault; '' if there is no other clock.
    """
    rows = np.flatnonzero(track.moved & np.isfinite(track.motion).all(axis=1) & np.isfinite(track.time))
    if len(rows) < 4:
        return
    steps = _Steps(track.time[rows], track.motion[rows])
    intervals = GAP if track.held else LONG_GAP
    gaps = steps.duration > max(intervals * steps.interval, LEAST_GAP)
    if gaps.any():
        yield _gap(steps, gaps, rows, track.held, clock)
    jumps = steps.jumps() & ~gaps
    if track.poses is not None and (finding := _coarse_numbers(track.poses[rows], steps)):
        yield finding
    elif jumps.any():
        yield _jump(steps, jumps, rows, limits)
    for amounts, count, unit in ((steps.turn, np.radians(1), "degree"), (steps.length, 1e-3, "mm")):
        moved = amounts[amounts > COUNTED * count] / count
        off = np.abs(moved - np.round(moved))
        if len(moved) >= LEAST_COUNTS and np.quantile(off, 0.99) < COUNTED and np.median(moved) < 1.5:
            found = (
                f"{(moved < 1.5).sum()} of {len(moved)} steps that are not 0 are 1 {unit}, all are whole ones"
            )
            cure = (
                "a robot that loses the rest at each reading hardly reports this motion: read it less often"
            )
            yield _Finding(False, None, found, "", cure)
    path, speed = float(steps.length.sum()), steps.typical_length / (steps.interval or 1.0)
    if 0 < path < LEAST_PATH and speed < CRAWL:
        cure = "if these are kilometres, --set recording.odometry.length_scale=1000"
        yield _Finding(False, None, f"the whole path is {path:.3g} m, at {speed:.2g} m/s", "", cure)


class _Steps:
    """Lengths [N] m, turns [N] rad and durations [N] s of the steps of a track, and the typical ones."""

    def __init__(self, time: np.ndarray, motion: np.ndarray) -> None:
        self.time = time
        self.length, self.turn = np.hypot(motion[:, 0], motion[:, 1]), np.abs(motion[:, 2])
        self.length[0] = self.turn[0] = 0.0  # before the first row nothing is known
        self.duration = np.concatenate([[0.0], np.diff(time)])
        ahead = self.duration[self.duration > 0]
        self.interval = float(np.median(ahead)) if len(ahead) else 0.0
        # A step that took several intervals may be longer in proportion; one that took less may not.
        self._share = np.maximum(self.duration / (self.interval or 1.0), 1.0)
        self.typical_length = _typical(self.length / self._share, np.ones(len(time)))
        self.typical_turn = _typical(self.turn / self._share, np.ones(len(time)))

    def jumps(self) -> np.ndarray:
        """[N] bool, the few steps that are far longer, or turn far more, than all others."""
        return _outliers(self.length / self._share, 0.0) | _outliers(self.turn / self._share, LEAST_TURN)


def tracker_faults(track: MotionTrack) -> tuple[np.ndarray, np.ndarray]:
    """[N] bool twice, of the places of a tracked animal: those between a jump away and the jump back, within
    `LEAST_GAP` s (a reflection, another mark); and those to which a jump leads that has no way back."""
    steps = _Steps(track.time, track.motion)
    place = np.cumsum(track.motion[:, :2], axis=0)
    jumped = np.flatnonzero(steps.jumps())
    wild, moved = np.zeros(len(place), bool), np.zeros(len(place), bool)
    for row in jumped.tolist():
        if wild[row - 1]:  # the way back
            continue
        later = jumped[(jumped > row) & (track.time[jumped] <= track.time[row] + LEAST_GAP)]
        most = JUMP * steps.typical_length
        elapsed = np.maximum((track.time[later] - track.time[row - 1]) / (steps.interval or 1.0), 1.0)
        back = later[np.hypot(*(place[later] - place[row - 1]).T) <= most * elapsed]
        if len(back):
            wild[row : back[0]] = True
        else:
            moved[row] = True
    return wild, moved


def _outliers(amounts: np.ndarray, least: float) -> np.ndarray:
    """[N] bool, amounts over `JUMP` times the typical one of all smaller ones; none if they are many."""
    order = np.argsort(amounts)
    ordered = amounts[order]
    # At most a twentieth of the steps, at least four, can be jumps, and four of them one after another: more
    # are how this robot moves.
    first = len(ordered) - max(4, int(0.05 * len(ordered)))
    done = np.cumsum(ordered)
    for place in range(max(first, 1), len(ordered)):
        typical = ordered[np.searchsorted(done, done[place - 1] / 2)]
        if typical > 0 and ordered[place] > max(JUMP * typical, least):
            found = np.asarray(amounts >= ordered[place])
            runs = np.diff(np.flatnonzero(np.diff(found, prepend=False, append=False)))[::2]
            return found if runs.max() <= 4 else np.zeros(len(amounts), bool)
    return np.zeros(len(amounts), bool)


def _gap(steps: _Steps, gaps: np.ndarray, rows: np.ndarray, held: bool, clock: str) -> _Finding:
    moved = (steps.length > JUMP * steps.typical_length) | (steps.turn > JUMP * steps.typical_turn)
    wrong = gaps & moved if held else np.zeros(len(gaps), bool)
    first = int((wrong if wrong.any() else gaps).argmax())
    found = f"nothing for {steps.duration[first]:.4g} s before t = {steps.time[first]:.3f} s"
    found += f", a step every {steps.interval:.3g} s elsewhere{count_others(wrong if wrong.any() else gaps)}"
    stretch = "else choose a stretch with recording.from and recording.to"
    if wrong.any():
        found += f": the velocity that holds over it moves the robot by {steps.length[first]:.4g} m"
        found += f" and {steps.turn[first]:.3g} rad, and nobody knows how it moved"
        cure = f"if the clock jumped or the robot stood, {clock or _largest(steps, wrong)}; {stretch}"
        return _Finding(True, int(rows[first]), found, "no gap in velocities", cure)
    what = "how the robot moved is not known" if held else "poses and motions bridge it, views do not"
    cure = f"if the clock jumped, {clock}" if clock else f"look at it: {what}"
    return _Finding(False, int(rows[first]), f"{found} ({what})" if clock else found, "", cure)


def _jump(steps: _Steps, jumps: np.ndarray, rows: np.ndarray, limits: UnitLimits) -> _Finding:
    first = int(jumps.argmax())
    speed = steps.length / np.maximum(steps.duration, 1e-9)
    found = f"the odometry jumps by {steps.length[first]:.4g} m and {steps.turn[first]:.3g} rad in "
    found += f"{steps.duration[first]:.3g} s at t = {steps.time[first]:.3f} s, typically by "
    found += f"{steps.typical_length:.3g} m and {steps.typical_turn:.3g} rad a step{count_others(jumps)}"
    back = first + 1 < len(jumps) and jumps[first + 1]
    cause = "a wild pose" if back else "a reset of the odometry, or a robot that was carried"
    cure = f"{cause}: {_largest(steps, jumps)}; or choose a stretch with recording.from and recording.to"
    refused = bool((speed[jumps] > limits.speed).any())
    return _Finding(refused, int(rows[first]), found, "steps that this robot can make", cure)


def _largest(steps: _Steps, wrong: np.ndarray) -> str:
    """The setting that repeats the step before each of these steps [N] bool, and of no other."""
    words = []
    for name, amounts in (("largest_step", steps.length), ("largest_turn", steps.turn)):
        most = float(amounts[~wrong].max(initial=0))
        beyond = amounts[wrong & (amounts > 2 * most)]
        if len(beyond) and most > 0:
            size = min(np.sqrt(most * beyond.min()), 5 * most)
            words.append(f"--set recording.odometry.{name}={size:.2g}")
    return f"{' '.join(words)} repeats the step before instead" if words else "drop these rows"


def _two_publishers(poses: np.ndarray) -> _Finding | None:
    """Positions that jump between two paths: each leads back to where the robot was two messages before."""
    once = np.hypot(*np.diff(poses[:, :2], axis=0).T)
    twice = np.hypot(*(poses[2:, :2] - poses[:-2, :2]).T)
    moved = (once[:-1] > 0) & (once[1:] > 0)
    # Two publishers: a tenth of the steps leads back to within a quarter of its length.
    back = moved & (twice < 0.25 * np.minimum(once[:-1], once[1:]))
    if not back.sum() > max(0.1 * len(poses), _GLITCHES):
        return None
    path, alone = float(once.sum()), float(np.hypot(*np.diff(poses[::2, :2], axis=0).T).sum())
    found = f"{int(back.sum())} of {len(poses)} poses lead back to where the robot was before: the path is "
    found += f"{path:.4g} m, that of every second message {alone:.4g} m, so two nodes publish here"
    cure = "--set recording.topics.odometry.every=2, or record each node under a topic of its own"
    return _Finding(True, int(back.argmax()) + 1, found, "one publisher", cure)


def _are_degrees(poses: np.ndarray) -> bool:
    """Whether headings point along the motion, forwards or backwards, in degrees and not in radians."""
    step = np.diff(poses[:, :2], axis=0)
    length, heading = np.hypot(*step.T), poses[:-1, 2]
    moved = length > np.median(length[length > 0]) / 2 if (length > 0).any() else length > 0
    if moved.sum() <= 20 or np.ptp(heading) <= 2 * np.pi:
        return False
    along = 2j * np.arctan2(step[moved, 1], step[moved, 0])
    agree = [abs(np.exp(2j * angle[moved] - along).mean()) for angle in (heading, np.radians(heading))]
    return bool(agree[0] < 0.5 and agree[1] > 0.9)


def _coarse_numbers(poses: np.ndarray, steps: _Steps) -> _Finding | None:
    """Coordinates so far from the origin that numbers lie apart by much of a step."""
    places = poses[:, :2]
    single = places.astype(np.float32)
    far = float(np.median(np.abs(places).max(axis=1)))
    spacing = float(np.spacing(np.float32(far)) if (single == places).all() else np.spacing(far))
    if not spacing > 0.1 * steps.typical_length > 0:  # else it spoils the step
        return None
    found = f"coordinates of {far:.4g} m come in steps of {spacing:.2g} m, and the robot moves by "
    found += f"{steps.typical_length:.2g} m: precision was lost far from the origin"
    cure = "write them in double precision or from a near origin; of a bag, take velocities: "
    cure += "--set recording.topics.odometry.use=twist"
    return _Finding(False, int((np.abs(places).max(axis=1) >= far).argmax()), found, "", cure)


def typical_motion(track: MotionTrack) -> TypicalMotion:
    """The typical motion in a track; rows with errors are ignored."""
    steps = np.diff(track.time[track.moved & np.isfinite(track.time)])
    interval = float(np.median(steps)) if len(steps) else 0.0
    dt = track.motion[:, 3]
    # A step of 1000 median ones is an error of the clock and is ignored.
    good = np.isfinite(track.motion).all(axis=1) & (dt > 0) & (dt <= 1000.0 * interval)
    length, turn = np.hypot(track.motion[good, 0], track.motion[good, 1]), np.abs(track.motion[good, 2])
    true_speed, path, turning = _compare_with_truth(track, good)
    share = np.maximum(dt[good] / (interval or 1.0), 1.0)
    tame = ~(_outliers(length / share, 0.0) | _outliers(turn / share, LEAST_TURN))
    good[good], length, turn = tame, length[tame], turn[tame]
    speed, turn_rate = _typical(length, dt[good]), _typical(turn, dt[good])
    in_step, pace = _typical(turn, np.ones_like(turn)), length / dt[good]
    starts = (pace[:-1] < 0.1 * speed) & (pace[1:] > 0.7 * speed)
    hardest = np.sort(np.where(starts, np.diff(pace) / dt[good][1:], 0.0))[-2:]
    start = float(hardest[0]) if len(hardest) == 2 else 0.0
    return TypicalMotion(interval, speed, turn_rate, in_step, start, true_speed, path, turning)


Cures = Callable[[str, str], str]
"""The cure for a quantity (time, length, angle) in a unit: what to set."""


def unit_cure(quantity: str, unit: str) -> str:
    """The setting that corrects an odometry in this unit, of any format; times have none."""
    per = PER_UNIT[quantity][unit]
    if quantity == "time":
        return f"divide the times by {per:g}" if per > 1 else f"multiply the times by {1 / per:g}"
    return f"--set recording.odometry.{'length' if quantity == 'length' else 'turn'}_scale={1 / per:.6g}"


def unit_errors(
    track: MotionTrack, where: str, limits: UnitLimits = DEFAULT_LIMITS, cures: Cures = unit_cure
) -> list[InputError]:
    """Errors of a whole recording: times not in s, motion not in m or rad, odometry that disagrees with
    truth.

    Each cause is reported once: the truth is compared only where no other check has found an error.
    """
    errors = []
    if track.truth is not None:
        errors = heading_errors(track.truth[:, 2], track.time, "the truth's heading", where, limits)
        if errors:
            track = track._replace(truth=track.truth * (1, 1, np.pi / 180))
    robot = typical_motion(track)
    found = list(_absurd(robot, track.held, limits, cures))
    if found and (repeated := _repeats(track, limits)):
        found = [repeated]
    found += [each for each in _unlike_truth(robot, limits) if not found or "truth's" in each[0]]
    return errors + [InputError(where, *words) for words in found]


def _repeats(track: MotionTrack, limits: UnitLimits) -> tuple[str, str, str] | None:
    """Of a track that moves as no robot does: whether it does not, once each pose that is repeated counts
    once. Finding, expectation, cure."""
    rows = np.flatnonzero(track.moved)
    changed = np.flatnonzero(track.motion[rows, :3].any(axis=1))
    every = int(np.median(np.diff(changed))) if len(changed) > 4 and not track.held else 1
    if every < 2:
        return None
    motion = track.motion[rows[changed]]
    motion[1:, 3] = np.diff(track.time[rows[changed]])
    once = track._replace(time=track.time[rows[changed]], moved=np.ones(len(motion), bool), motion=motion)
    if _faults(typical_motion(once._replace(truth=None)), False, limits):
        return None
    found = f"{len(rows) - len(changed)} of {len(rows)} poses are the pose before again, mostly {every} alike"
    cure = "drop the repeated ones, or publish them as often as they are measured"
    return found, "each pose once", f"{cure}; of topics, --set recording.topics.odometry.every={every}"


def _absurd(
    robot: TypicalMotion, held: bool, limits: UnitLimits, cures: Cures
) -> Iterator[tuple[str, str, str]]:
    """What no robot does: finding, expectation, cure; the cure names the units that explain all of it."""
    faults = _faults(robot, held, limits)
    if not faults:
        return
    named = {"time": "times in seconds", "length": "odometry in metres", "angle": "odometry in radians"}
    limit = {"time": "interval", "length": "speed", "angle": "turn_rate"}
    if units := _explanation(robot, held, limits):
        speeds = f"{robot.speed:.4g} m/s and {robot.turn_rate:.4g} rad/s"
        typical = f"typically {robot.interval:.3g} s a step, {speeds}"
        parts = [f"these are {WORDS[unit].split()[0]}: {cures(key, unit)}" for key, unit in units.items()]
        for key in units:
            yield faults.get(key, typical), named[key], "; ".join([*parts, _else(limit[key], limits)])
        return
    for key, words in faults.items():
        yield words, named[key], f"no unit explains it; {_else(limit[key], limits)}"


def _faults(robot: TypicalMotion, held: bool, limits: UnitLimits) -> dict[str, str]:
    """By quantity (time, length, angle) what is absurd, in words."""
    found = {}
    if robot.interval > (min(limits.interval, HELD) if held else limits.interval):
        held_words = ", and velocities do not hold so long" * held
        found["time"] = f"half of the steps take over {robot.interval:.4g} s{held_words}"
    elif 0 < robot.interval < SHORTEST:
        found["time"] = f"half of the steps take less than {robot.interval:.2g} s"
    if robot.speed > limits.speed:
        found["length"] = f"half of the path is driven at over {robot.speed:.4g} m/s"
    elif robot.start > START * limits.speed / DEFAULT_LIMITS.speed and robot.speed > FAST:
        found["length"] = f"it starts from rest to {robot.speed:.3g} m/s at {robot.start:.3g} m/s²"
    most = TURN * limits.turn_rate / DEFAULT_LIMITS.turn_rate if held else np.pi
    if robot.turn_rate > limits.turn_rate or robot.turn > most:
        turning = f"{robot.turn_rate:.4g} rad/s, {robot.turn:.3g} rad a step"
        found["angle"] = f"half of the turning is done at over {turning}"
    return found


def _explanation(robot: TypicalMotion, held: bool, limits: UnitLimits) -> dict[str, str]:
    """The fewest units, of time, length and angle, with which nothing is absurd; of as many, those that make
    the robot most like a usual one. {} if there are none."""
    usual = np.array([0.1, 0.4, 0.5])  # interval (s), speed (m/s) and turn rate (rad/s) of a usual robot
    # Decades by which a unit is less likely than one of equal fit.
    rare = {"cm": 0.5, "km": 1.0, "ns": 0.2, "us": 0.2, "ks": 0.3, "min": 0.5}
    best: tuple[float, dict[str, str]] = (np.inf, {})
    there = {"time": 1.0, "length": robot.speed, "angle": robot.turn}
    for chosen in product(*(list(PER_UNIT[key])[: None if most > 0 else 1] for key, most in there.items())):
        named = dict(zip(there, chosen, strict=True))
        seconds, metres, radians = (1 / PER_UNIT[key][unit] for key, unit in named.items())
        rate = 1.0 if held else seconds  # velocities have their own unit of time
        changed = robot._replace(
            interval=robot.interval * seconds,
            speed=robot.speed * metres / rate,
            start=robot.start * metres / rate**2,
            turn_rate=robot.turn_rate * radians / rate,
            turn=robot.turn * radians * (seconds if held else 1.0),
        )
        if _faults(changed, held, limits):
            continue
        values = np.array([changed.interval, changed.speed, changed.turn_rate])
        unlike = float(np.abs(np.log10(np.maximum(values, 1e-12) / usual))[values > 0].sum())
        unlike += sum(rare.get(unit, 0.0) for unit in chosen)
        units = {key: unit for key, unit in named.items() if PER_UNIT[key][unit] != 1}
        best = min(best, (100 * len(units) + unlike, units), key=lambda each: each[0])
    return best[1]


def _unlike_truth(robot: TypicalMotion, limits: UnitLimits) -> Iterator[tuple[str, str, str]]:
    """Units of the truth, and of an odometry that disagrees with it."""
    millimetres = "divide by 1000 if it is millimetres"
    if robot.true_speed > limits.speed:
        found = f"half of the truth's path is driven at over {robot.true_speed:.4g} m/s"
        yield found, "truth in metres", f"{millimetres}; {_else('speed', limits)}"
    elif _differ_by_unit(*robot.path):
        found = "the odometry covers {:.4g} m, the truth {:.4g} m".format(*robot.path)
        yield found, "both in metres", millimetres
    if _differ_by_unit(*robot.turning):
        found = "the odometry turns by {:.4g} rad, the truth by {:.4g} rad".format(*robot.turning)
        yield found, "both in radians", "multiply by pi/180 if it is degrees"


def heading_errors(
    heading: np.ndarray,
    time: np.ndarray,
    what: str,
    where: str,
    limits: UnitLimits = DEFAULT_LIMITS,
    cure: str = "multiply by pi/180",
) -> list[InputError]:
    """Errors of a heading column [N] that must be in degrees: wider than a turn and too fast for radians."""
    good = np.isfinite(heading) & np.isfinite(time)
    heading, dt = heading[good], np.diff(time[good])
    if not len(heading) or np.abs(heading).max() <= 2 * np.pi + 0.1:
        return []  # wrapped radians, or too few degrees to decide
    turn = np.abs(np.diff(heading))
    turn = np.minimum(turn, np.abs(360 - turn))[dt > 0]
    rate = _typical(turn, dt[dt > 0])
    if rate <= limits.turn_rate and _typical(turn, np.ones_like(turn)) <= np.pi:
        return []
    found = f"{what} runs from {heading.min():.4g} to {heading.max():.4g}, mostly at {rate:.3g} a second"
    cure = f"{cure} if it is degrees; {_else('turn_rate', limits)}"
    return [InputError(where, found, "a heading in radians", cure)]


def _typical(amount: np.ndarray, duration: np.ndarray) -> float:
    """The rate above which half of the total amount [N] falls."""
    rate = amount / duration
    ignored = max(_GLITCHES, int(0.01 * len(rate)))
    order = np.argsort(rate)[: max(len(rate) - ignored, 0)]
    done = np.cumsum(amount[order])
    return float(rate[order][np.searchsorted(done, done[-1] / 2)]) if len(done) and done[-1] > 0 else 0.0


def _compare_with_truth(
    track: MotionTrack, good: np.ndarray
) -> tuple[float, tuple[float, float], tuple[float, float]]:
    """Speed of the truth; path and net turning of odometry and truth. NaN without truth."""
    nothing = np.nan, (np.nan, np.nan), (np.nan, np.nan)
    if track.truth is None:
        return nothing
    rows = np.flatnonzero(np.isfinite(track.truth).all(axis=1))
    if len(rows) <= _GLITCHES + 1:
        return nothing
    motion, truth = np.where(good[:, None], track.motion, 0.0), track.truth[rows]
    driven = np.diff(np.cumsum(np.hypot(motion[:, 0], motion[:, 1]))[rows])
    length, dt = np.hypot(*np.diff(truth[:, :2], axis=0).T), np.diff(track.time[rows])
    speed = _typical(length[dt > 0], dt[dt > 0])
    turns = np.cumsum(motion[:, 2])[rows], np.unwrap(truth[:, 2])
    ends = np.unique(np.linspace(0, len(rows) - 1, 51).astype(int))
    turned = (np.abs(np.diff(angle[ends])) for angle in turns)
    # Steps of at least 5 cm along the true path, so that noise does not add up; turning over 50 stretches.
    steps, last = [0.0], complex(*truth[0, :2])
    for point in (truth[:, 0] + 1j * truth[:, 1]).tolist():
        if (step := abs(point - last)) >= 0.05:
            steps.append(step)
            last = point
    totals = [float(np.sort(each)[:-_GLITCHES].sum()) for each in (driven, np.array(steps), *turned)]
    return speed, (totals[0], totals[1]), (totals[2], totals[3])


def _differ_by_unit(a: float, b: float) -> bool:
    """Whether two totals, m or rad, differ by more than `RATIO`, as with a wrong unit; never for NaN."""
    least, most = min(a, b), max(a, b)
    return least > 0.3 and most > 5.0 and most > RATIO * least


def _else(name: str, limits: UnitLimits) -> str:
    return f"if it really is so, raise recording.limits.{name} ({getattr(limits, name):g})"
