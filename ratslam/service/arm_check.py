"""What pokes and whisks in free air tell of an arm and of its whisker head: questions, answers, settings."""

from __future__ import annotations

import numpy as np

from ratslam.service.create_check import Verdict
from ratslam.service.record_fit import signal_rig, signals_of_cycles
from ratslam.service.rig_fit import Quantity, Rig
from robot.live.arm_bench import FreeWhisks
from robot.live.live_config import LiveConfig
from robot.live.poke_loop import FreePokes
from robot.live.selftest import MIN_RATE_SHARE
from robot.sources.source import Sample
from tactile.base.errors import InputError
from tactile.calibration import RestBaselineConfig, calibrate, estimate_noise
from tactile.frontend import TouchConfig
from tactile.pokes import HIGHEST, PokeConfig, force_rise, learn_threshold
from tactile.rig_signals import fit_signals

SMOOTH = 0.5
"""Time over which the force is averaged for its drift, s."""
SHORTEST = 1.0
"""Time for which a poke must last to tell of the force, s."""
MARGIN = 1.5
"""A threshold exceeds the largest rise in free air by this factor, at least."""
LEAST_SDS = 6.0
"""Least threshold of a rise, in its standard deviations: normally distributed ones exceed it once in 1e9."""


def judge_arm(live: LiveConfig, touch: TouchConfig, record: FreePokes) -> tuple[list[Verdict], Rig]:
    """Answers the questions to an arm, and the settings that follow."""
    arm, pokes = live.arm, touch.pokes
    met = np.isfinite(record.touched)
    words = [
        f"towards {np.degrees(angle):.0f} degrees after {depth:.3f} m"
        for angle, depth in zip(record.angle[met], record.touched[met], strict=True)
    ]
    detail = ", ".join(words) or f"{len(met)} pokes touched nothing"
    verdicts = [Verdict("free air", "contact" if words else "fine", detail)]
    whole = record.states * (~met) >= SHORTEST * arm.hz
    push = [part for part, free in zip(record.each(record.push), whole, strict=True) if free]
    quantities: list[Quantity] = []
    unknown: tuple[str, ...] = ()
    if arm.touch == "head":
        unknown = ("whiskers: `check robot head` measures them",)
    elif not push:
        verdicts.append(Verdict("force", "cannot tell", f"no poke lasted {SHORTEST:g} s without a contact"))
    else:
        verdict, quantities = _judge_force(pokes, push, arm.hz, arm.force_limit)
        verdicts.append(verdict)
    robot, host = record.each(record.robot), record.each(record.host)
    rate = float(np.median([(len(part) - 1) / np.ptp(part) for part in host if len(part) > 1]))
    found = "fine" if rate >= MIN_RATE_SHARE * arm.hz else "slow stream"
    verdicts.append(Verdict("states", found, f"{rate:.0f} of {arm.hz} states/s"))
    jitter = np.concatenate([b - a - (b - a).min() for a, b in zip(robot, host, strict=True) if len(a)])
    middle, most = np.quantile(record.ages, (0.5, 0.99))
    late = f"newest state {1e3 * middle:.0f} ms old, 99 % less than {1e3 * most:.0f}"
    late += f"; 99 % arrive less than {1e3 * np.quantile(jitter, 0.99):.0f} ms late"
    verdicts.append(Verdict("latency", "late states" if most > arm.stale / 2 else "fine", late))
    worst = float(record.back.max())
    back = f"the tool comes back within {1e3 * worst:.2f} mm, by the arm's own poses"
    verdicts.append(Verdict("position", "comes back elsewhere" if worst > arm.arrive / 2 else "fine", back))
    quantities += [
        Quantity("states", float(arm.hz), rate, 0.1 * arm.hz, "Hz"),
        Quantity("age of states, 99 %", None, float(most), None, "s"),
        Quantity("position after a poke, rms", None, float(np.sqrt((record.back**2).mean())), None, "m"),
    ]
    fine = all(verdict.found == "fine" for verdict in verdicts)
    notes = ("nothing has to be set",) if fine else ()
    return verdicts, Rig(tuple(quantities), notes=notes, unknown=unknown)


def _judge_force(
    pokes: PokeConfig, push: list[np.ndarray], hz: int, limit: float
) -> tuple[Verdict, list[Quantity]]:
    """The verdict on the force [T] along each poke, N, and its quantities, with the setting that follows."""
    noise = float(np.median([estimate_noise(part) for part in push]))
    block = round(SMOOTH * hz)
    means = [part[: len(part) // block * block].reshape(-1, block).mean(axis=1) for part in push]
    drift = max(float(np.ptp(part)) for part in means)
    rise = np.concatenate([force_rise(pokes, part, hz) for part in push])
    middle, sd, highest = abs(float(rise.mean())), float(rise.std()), float(rise.max())
    quantities = [
        Quantity("force, noise", None, noise, None, "N"),
        Quantity("force, drift over a poke", None, drift, None, "N"),
        Quantity("rise in free air, highest", None, highest, None, "N"),
    ]
    most = f"a third of force_limit is {HIGHEST * limit:.3g} N"
    try:
        threshold = learn_threshold(pokes, push, hz, limit)
    except InputError as error:
        sds = max(LEAST_SDS, (MARGIN * highest - middle) / max(sd, 1e-9))
        if middle + sds * sd > HIGHEST * limit:
            cure = "check the payload and the tool on the pendant, or poke more slowly (`touch.pokes.speed`)"
            return Verdict("force", "too uneven", f"{error.found}; {most}; {cure}"), quantities
        # The force has no outliers: a lower threshold is still above all of its rises.
        detail = f"{error.found}; {most}; {sds:.1f} sds do, {MARGIN:g} times the highest rise or more"
        quantities.append(Quantity("sds", pokes.sds, sds, None, "", "touch.pokes.sds"))
        return Verdict("force", "too uneven", detail), quantities
    quantities.append(Quantity("threshold of a contact", None, threshold, None, "N"))
    return Verdict("force", "fine", f"a rise of {threshold:.1f} N is a contact; {most}"), quantities


def judge_head(live: LiveConfig, touch: TouchConfig, record: FreeWhisks) -> tuple[list[Verdict], Rig]:
    """Answers the questions to a whisker head, and the settings that follow."""
    plan, cycles = live.plan, [cycle for cycle in record.cycles() if len(cycle.time)]
    lost, bad = int((record.whole - record.samples).sum()), int(record.bad)
    samples = f"{lost} of {int(record.whole) * len(record.samples)} samples lost, {bad} damaged"
    residual, worst = float(record.residual), float(record.late.max())
    clock = f"residual {1e3 * residual:.1f} ms, at most {1e3 * live.residual:g}"
    late = f"a whisk is here {1e3 * float(np.median(record.late)):.0f} ms after its end, the latest "
    verdicts = [
        Verdict("samples", "samples lost" if lost or bad else "fine", samples),
        Verdict("clock", "clock uneven" if residual > live.residual else "fine", clock),
        Verdict("latency", "late samples" if worst > live.grace else "fine", f"{late}{1e3 * worst:.0f} ms"),
    ]
    grace = round(min(1.0, MARGIN * worst), 3)
    parts = [Rig(settings={"live": {"grace": grace}} if worst > live.grace else {})]
    try:
        calibration = calibrate(plan.calibration, cycles, touch.contact.slope_window, "free whisking")
        usual = float(np.median(calibration.threshold[calibration.alive]))
        answer = "fine", f"a contact is a deflection of {1e3 * usual:.1f} mrad, median"
    except InputError as error:
        answer = "refused", error.found
    verdicts.append(Verdict("calibration", *answer))
    try:
        signals = signals_of_cycles([Sample(float(cycle.time[0]), cycle, None) for cycle in cycles])
    except InputError as error:
        return [*verdicts, Verdict("whiskers", "cannot tell", str(error))], Rig.join(parts)
    known = set(touch.head.dead)
    dead = set(np.flatnonzero((np.ptp(signals.free, axis=0) == 0).all(axis=1)).tolist())
    off, most = np.abs(np.median(signals.free, axis=0)).max(axis=1), live.head.overload
    bent = [k for k in np.flatnonzero(off > most / 2).tolist() if k not in known]
    words = [f"no signal of whisker {k}" for k in sorted(dead - known)]
    words += [f"whisker {k} rests bent by {off[k]:.2g} rad, and the arm stops at {most:g}" for k in bent]
    found = "dead whiskers" if dead - known else "bent whiskers" if bent else "fine"
    alive = f"{len(off) - len(dead | known)} of {len(off)} alive"
    verdicts.append(Verdict("whiskers", found, ", ".join(words) or alive))
    if dead - known:
        parts.append(Rig(settings={"touch": {"head": {"dead": sorted(dead | known)}}}))
    try:
        fit = fit_signals(signals)
    except InputError as error:
        return [*verdicts, Verdict("drift", "cannot tell", str(error))], Rig.join(parts)
    # What the baseline follows from whisk to whisk, of a whisker whose free deflection is its noise alone.
    least = (touch.baseline or RestBaselineConfig()).free_sds * fit.noise[~fit.dead]
    share = (fit.drift[~fit.dead] / np.sqrt(plan.whisking.rate) / least).max(axis=1)
    far = [f"whisker {k}" for k in np.flatnonzero(~fit.dead)[share > 1].tolist()]
    detail = f"at most {100 * share.max():.0f} % of what the baseline follows from whisk to whisk"
    verdicts.append(Verdict("drift", "drifts" if far else "fine", ", ".join([*far, detail])))
    return verdicts, Rig.join([*parts, signal_rig(signals, fit, registered=True)])
