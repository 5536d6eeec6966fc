"""What the runs of a bench check tell of a Create's odometry: five questions, and the settings that follow.

Remainders. Let e be the commanded motion of a reading and g what the robot reports for one unit of it, from
the marked run, which is read once. A robot that keeps remainders reports sum(g e) in all, one that loses them
sum(trunc(g e)); the share of this difference that a robot lacks decides.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ratslam.service.rig_fit import Quantity, Rig
from robot.drivers.create.driver_config import CreateConfig
from robot.drivers.create.protocol import COUNT, WRAP
from robot.drivers.create.wheel_counters import count_steps
from robot.live.create_bench import BenchRun

KEPT, LOST = 0.25, 0.6
"""Lacking share of the remainders up to which they are kept, and from which on they are lost."""
LEAST_LACK = 8.0
"""Least difference between a robot that keeps and one that loses remainders, mm or degrees."""
TOLERANCE = 0.01
"""Largest error of a scale that is fine."""
MARK_SD = 0.3, 2e-3
"""Standard deviation of the user's measurement, degrees and m: of a number rounded to 1 degree and 5 mm."""
AGREE = 2.0
"""Counts within which a run reports what the marked one tells: each is cut to whole ones at both ends."""
MOST_COUNTS = 1024
"""Counts between two readings above which a wheel passed the end of its encoder; it makes some hundred."""
LATE = 0.025
"""Median time of a reply from which on it is late, s; a USB adapter takes up to 16 ms."""


class Verdict(NamedTuple):
    """The answer to a question. Attributes: found: `fine`, a fault, or `cannot tell`."""

    question: str
    found: str
    detail: str


def judge_create(
    config: CreateConfig, runs: list[BenchRun], turned: float | None, drove: float | None
) -> tuple[list[Verdict], Rig]:
    """Answers the questions, and the settings of the robot.

    Args:
        config: with which the runs were driven. turned, drove: true amounts of the first turn and drive,
            degrees and m; None where they were not measured.
    """
    wrap, wraps = _judge_wrap(config, runs)
    expected, reported = zip(*(_motions(config, run, wrap) for run in runs), strict=True)
    lost, remainders = _judge_remainders(config, runs, expected, reported)
    late, latency = _judge_latency(runs)
    settings: dict[str, Any] = {"remainders": lost} if lost and config.model == "create1" else {}
    settings |= {"wrap": wrap} if wrap != config.wrap else {}
    verdicts, quantities = [remainders, wraps, latency], []
    for turns, mark in ((True, turned), (False, drove)):
        mine = [k for k, run in enumerate(runs) if run.turns == turns]
        commanded = expected[mine[0]].sum()
        pairs = np.array([(abs(expected[k].sum()), abs(_complete(reported[k], lost).sum())) for k in mine])
        verdict, quantity = _judge_scale(config, turns, mark, commanded * _gain(pairs, lost), lost)
        verdicts.append(verdict)
        quantities += [quantity] if quantity else []
        if turns and mark and config.model == "create1" and lost == "lost":
            base = config.wheel_base * commanded / mark
            quantities.append(
                Quantity("wheel base", config.wheel_base, base, 1e-3 * base, "m", "live.create.wheel_base")
            )
    lines = [run.describe(*pair) for run, *pair in zip(runs, expected, reported, strict=True)]
    unknown = tuple(f"{each.question}: {each.detail}" for each in verdicts if each.found == "cannot tell")
    rig = Rig(tuple(quantities), {"live": {"create": settings | late}}, tuple(lines), unknown)
    return verdicts, rig if settings or late else rig._replace(settings={})


def _motions(config: CreateConfig, run: BenchRun, wrap: int) -> tuple[np.ndarray, np.ndarray]:
    """Expected and reported motion of each reading [N] of the moving robot, degrees or mm."""
    rows, column = run.rows, 3 if run.turns else 2
    moving = rows[1:, column] != 0
    if config.model == "create1":
        moving |= rows[1:, column + 2] != 0
        return rows[1:, column][moving], rows[1:, column + 2][moving]
    left, right = COUNT * count_steps(np.diff(rows[:, 6:8], axis=0), wrap).T
    turn = np.degrees((right - left) / 1000 / config.wheel_base)
    return rows[1:, column][moving], (turn if run.turns else (left + right) / 2)[moving]


def _gain(pairs: np.ndarray, lost: str) -> float:
    """Reported for one unit of the commanded motion in the marked run.

    Args:
        pairs: [M, 2] commanded and reported motion of the runs, the marked one first; counts are averaged
            over those that agree with it.
    """
    commanded, reported = pairs.T
    gain = reported[0] / commanded[0]
    alike = np.abs(reported - gain * commanded) <= AGREE if lost == "kept" else np.arange(len(pairs)) == 0
    return float(reported[alike].sum() / commanded[alike].sum())


def _complete(reported: np.ndarray, lost: str) -> np.ndarray:
    """Counts with the mean of what was lost."""
    return reported + np.sign(reported) / 2 if lost == "lost" else reported


def _judge_remainders(
    config: CreateConfig,
    runs: list[BenchRun],
    expected: tuple[np.ndarray, ...],
    reported: tuple[np.ndarray, ...],
) -> tuple[str, Verdict]:
    """What becomes of remainders (`kept`, `lost` or '' for unknown), and the verdict."""
    question = "remainders"
    if config.model != "create1":
        return "kept", Verdict(question, "fine", "encoders count on")
    answers, words = set(), []
    for turns, unit in ((True, "degree"), (False, "mm")):
        first = next(k for k, run in enumerate(runs) if run.turns == turns)
        commanded = expected[first].sum()
        gain = _complete(reported[first], "lost").sum() / commanded if commanded else 0.0
        sums: dict[float, np.ndarray] = {}  # of each speed: remainders, and what lacks
        for run, motion, counts in zip(runs, expected, reported, strict=True):
            if run.turns == turns and run.poll:
                rest = np.abs(gain * motion - np.trunc(gain * motion)).sum()
                lack = abs(gain * motion.sum()) - abs(counts.sum())
                sums[run.speed] = sums.get(run.speed, np.zeros(2)) + (rest, lack)
        shares = [lack / rest for rest, lack in sums.values() if rest >= LEAST_LACK]
        if shares:
            share = float(np.median(shares))  # wheels that stick at the lowest speed report too little there
            answers.add("lost" if share >= LOST else "kept" if share <= KEPT else "")
            words.append(f"{100 * share:.0f} % of what is below 1 {unit}")
    if len(answers) != 1 or "" in answers:
        why = f"of the readings lack {' but '.join(words)}" if words else "the robot hardly reported a motion"
        return "", Verdict(question, "cannot tell", why)
    (answer,) = answers
    found = "remainders lost" if answer == "lost" else "fine"
    return answer, Verdict(question, found, f"of the readings lack {' and '.join(words)}")


def _judge_wrap(config: CreateConfig, runs: list[BenchRun]) -> tuple[int, Verdict]:
    """Counts after which the encoders start again, and the verdict."""
    question = "wrap"
    if config.model == "create1":
        return WRAP, Verdict(question, "fine", "each reading clears the counters")
    counts = np.concatenate([run.rows[:, 6:8] for run in runs])
    jumps = np.abs(np.diff(counts, axis=0))
    passed = jumps[jumps > MOST_COUNTS]
    if not len(passed):
        return config.wrap, Verdict(
            question, "cannot tell", "no encoder passed its end: switch it off and on before"
        )
    found = 2 ** round(float(np.log2(np.median(passed))))
    detail = f"{len(passed)} x, after {found} counts"
    return found, Verdict(question, "fine" if found == WRAP else "wrap", detail)


def _judge_latency(runs: list[BenchRun]) -> tuple[dict[str, Any], Verdict]:
    """The settings for late replies, and the verdict."""
    took = np.concatenate([run.rows[:, 1] - run.rows[:, 0] for run in runs])
    middle, most = np.quantile(took, (0.5, 0.95))
    detail = f"replies take {1e3 * middle:.0f} ms, 95 % less than {1e3 * most:.0f}"
    if middle < LATE:
        return {}, Verdict("latency", "fine", detail)
    rate = float(np.clip(np.floor(1 / (2 * most)), 5, 20))
    return {"rate": rate, "silence": max(0.3, 2.5 / rate)}, Verdict("latency", "latency", detail)


def _judge_scale(
    config: CreateConfig, turns: bool, mark: float | None, reported: float, lost: str
) -> tuple[Verdict, Quantity | None]:
    """The verdict on a scale, and the scale.

    Args:
        mark: measured, degrees or m. reported: degrees or mm.
    """
    name, key = ("turn", "turn_scale") if turns else ("distance", "distance_scale")
    if mark is None or not lost:
        why = (
            f"the {'turn' if turns else 'drive'} was not measured" if lost else "what becomes of remainders?"
        )
        return Verdict(name, "cannot tell", why), None
    reported = reported if turns else reported / 1000
    if reported == 0:
        return Verdict(name, "cannot tell", "the robot reported no motion"), None
    scale = mark / reported
    cut = 0.3 if turns else 5e-4  # of a whole count
    sd = float(np.hypot(MARK_SD[not turns], cut * scale) / abs(mark)) * scale
    off = abs(scale - 1)
    detail = f"true over reported: {scale:.4f} +- {sd:.4f}"
    found = (
        "fine" if off + 2 * sd < TOLERANCE else "scale wrong" if off - 2 * sd > TOLERANCE else "cannot tell"
    )
    quantity = Quantity(f"{name} scale", getattr(config, key), scale, sd, "", f"live.create.{key}")
    return Verdict(name, found, detail), quantity
