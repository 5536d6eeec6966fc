"""The rig from the record of a configuration: wheels, head and whiskers, as far as they are in it.

Without true poses, the errors of the wheels are the calibration that the map of the record finds: the
keyframe map solves for a heading bias and an error of turns with its poses (`ratslam.mapping`), because loops
do not close without them. A scale of all distances changes the size of the map and closes every loop as well:
revisits do not tell it. The signals of whiskers come from raw whisks, or from a registered source.
"""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from ratslam.runs.build_session import build_session, open_observations, open_source
from ratslam.runs.settings.completion import complete
from ratslam.runs.settings.run_config import RunConfig
from ratslam.runs.settings.strict_yaml import load
from ratslam.service.rig_fit import LEAST_TURNED, Quantity, Rig, WheelFit, fit_wheels
from robot.recordings import real_whiskers
from robot.sources.odometry import UNCORRECTED, OdometryCorrection
from robot.sources.source import Sample, SourceInfo
from robot.touch_source import observation_of
from robot.world.maze import parse_maze, wall_boxes
from robot.world.walls import Surroundings
from tactile.base.errors import InputError
from tactile.base.plugins import PluginConfig, read_settings
from tactile.base.random_streams import stream
from tactile.base.types import Cycle, Observation, Whisk
from tactile.contact_stream import Touch
from tactile.frontend import Frontend
from tactile.rig_signals import SignalFit, SignalRecord, fit_head, fit_signals, head_with
from tactile.wall_estimation.signal_map import fit_signal_map
from tactile.whisker_geometry import HeadConfig, ur10_head

REST_SHARE = 0.05
"""Part of a cycle, from its start, in which whiskers are at rest and free."""
MOST_CYCLES = 200
"""Cycles used at most, evenly spread over the record."""
DRIFT_BLOCK = 0.5
"""Blocks whose means tell the drift of a continuous record, s."""


def read_signals_of_reach(source: PluginConfig) -> SignalRecord:
    """The signals of an arm that reaches through clutter; as a source it gives contacts only."""
    config = read_settings(real_whiskers.ReachConfig, source.settings, "source.settings")
    signal = real_whiskers.read_reach(config.file).signal
    block = max(round(DRIFT_BLOCK * config.rate), 1)
    contact = (real_whiskers.find_touches(config, signal) == Touch.CONTACT).mean(axis=0)
    free, apart = signal[: config.free_rows], block / config.rate
    return SignalRecord(free, signal, block, apart, contact, real_whiskers.WHISKERS, "counts")


def signals_of_cycles(samples: list[Sample]) -> SignalRecord:
    """The deflections of a whisker head at rest, at the start of each cycle.

    Raises:
        InputError: there are no raw samples, or too few.
    """
    cycles = [(sample.time, sample.reading) for sample in samples if isinstance(sample.reading, Cycle)]
    if len(cycles) < 8:
        raise InputError("record", f"{len(cycles)} whisks with raw samples", "at least 8")
    some = np.unique(np.linspace(0, len(cycles) - 1, min(len(cycles), MOST_CYCLES)).astype(int))
    rest = max(int(REST_SHARE * min(len(cycle.time) for _, cycle in cycles)), 1)
    record = np.concatenate([cycles[k][1].deflection[:rest] for k in some])
    apart = (cycles[some[-1]][0] - cycles[some[0]][0]) / (len(some) - 1)
    whiskers = record.shape[1]
    names = tuple(f"whisker {k}" for k in range(whiskers))
    return SignalRecord(record, record, rest, apart, np.zeros(whiskers), names, "rad")


def signal_rig(record: SignalRecord, fit: SignalFit, registered: bool) -> Rig:
    """The signals as a rig: medians over the channels of live whiskers, and a line for each whisker."""
    live = ~fit.dead
    quantities = []
    for name, values, unit in (
        ("noise, median channel", fit.noise, record.unit),
        ("white noise, median channel", fit.white, record.unit),
        ("correlation of neighbours", fit.correlation, ""),
        ("drift, median channel", fit.drift, f"{record.unit}/sqrt(s)"),
    ):
        known = values[live][np.isfinite(values[live])]
        if len(known):
            spread = float(np.subtract(*np.quantile(known, [0.75, 0.25])) / 1.349)
            quantities.append(Quantity(name, None, float(np.median(known)), spread, unit))
    dead = np.flatnonzero(fit.dead).tolist()
    settings = {"touch": {"head": {"dead": dead}}} if dead and not registered else {}
    unknown = (
        "stage-to-signal map: no known touch in the record",
        *(
            f"drift of {record.names[k]}: it touches in {record.contact[k]:.0%} of the record"
            for k in np.flatnonzero(np.isnan(fit.drift).any(axis=1))
        ),
    )
    reasons = {whisker: f"dirty: {reason}" for whisker, reason in fit.dirty.items()}
    reasons |= {int(k): "dead: no signal" for k in np.flatnonzero(fit.dead)}
    lines = [f"each channel: baseline; noise; correlation; drift ({record.unit}, {record.unit}/sqrt(s))"]
    for k, name in enumerate(record.names):
        columns = (fit.baseline, fit.noise, fit.correlation, fit.drift)
        # '-' where the record does not tell the number
        parts = (
            " ".join(f"{value:.3g}" if np.isfinite(value) else "-" for value in column[k])
            for column in columns
        )
        lines.append(f"  {name}: " + (reasons[k] if fit.dead[k] else "; ".join(parts)))
        if k in reasons and not fit.dead[k]:
            lines.append(f"    {reasons[k]}")
    return Rig(tuple(quantities), settings, tuple(lines), unknown)


def fit_record(config: RunConfig, seed: int = 0) -> Rig:
    """All that the record of a configuration tells of its rig.

    Args:
        config: with absolute paths. seed: of the bootstrap.

    Raises:
        InputError: the record cannot be read.
    """
    if config.source is not None and config.source.plugin == "whisker_stage":
        return _fit_stage(config.source)
    if config.source is not None and config.source.plugin == "whisker_reach":
        record = read_signals_of_reach(config.source)
        return signal_rig(record, fit_signals(record), registered=True)
    plain = _without_correction(config)
    with open_source(plain) as source:
        completed = complete(plain, source)
        samples = list(source)
        info = source.info
    parts = [fit_wheels_of(config, completed, samples, seed)]
    if info.raw_whiskers and info.planar_whiskers is None:
        try:
            record = signals_of_cycles(samples)
            parts.append(signal_rig(record, fit_signals(record), registered=False))
        except InputError as error:
            alive = [sample.reading.alive for sample in samples if isinstance(sample.reading, Whisk)]
            dead = np.flatnonzero(~np.any(alive, axis=0)).tolist() if alive else []
            settings = {"touch": {"head": {"dead": dead}}} if dead else {}
            parts.append(Rig(settings=settings, unknown=(f"noise, drift, baseline: {error}",)))
        parts.append(_fit_head(completed, samples, info))
    return Rig.join(parts)


def _without_correction(config: RunConfig) -> RunConfig:
    """The configuration with the odometry as recorded."""
    if config.recording is None:
        return config
    recording = config.recording.model_copy(update={"odometry": UNCORRECTED})
    return config.model_copy(update={"recording": recording})


def fit_wheels_of(config: RunConfig, completed: RunConfig, samples: list[Sample], seed: int) -> Rig:
    """Scales, drift and noise of the odometry, from true poses, or else from revisits."""
    assumed = UNCORRECTED if config.recording is None else config.recording.odometry
    time = np.array([sample.time for sample in samples])
    motion = np.array([[*sample.reading.odometry][:3] for sample in samples], float).reshape(-1, 3)
    unknown = np.full(3, np.nan)
    truth = np.array([unknown if sample.truth is None else sample.truth for sample in samples])
    if not np.isfinite(truth).any():
        return _from_revisits(_without_correction(config), samples, assumed)
    try:
        fit = fit_wheels(time, motion, truth, seed)
    except InputError as error:
        return Rig(unknown=(f"wheels: {error.found}; {error.expected} are needed",))
    rig = _from_truth(fit, assumed, completed)
    if config.recording is not None:
        return rig
    # No setting corrects the odometry of another source.
    return rig._replace(quantities=tuple(quantity._replace(setting="") for quantity in rig.quantities))


def _from_truth(fit: WheelFit, assumed: OdometryCorrection, completed: RunConfig) -> Rig:
    noise, cell = completed.keyframes.noise, completed.pose_cells.cell_size
    unknown = []
    if fit.turn_scale is None:
        turned = f"the robot turns {fit.turned:.2g} rad in all"
        unknown.append(f"turn scale: {turned}; at least {LEAST_TURNED:.2g} rad are needed")
    known = {key: found for key in WHEELS if (found := getattr(fit, key)) is not None}
    quantities = [
        *(_of_wheels(key, assumed, found) for key, found in known.items()),
        Quantity("heading noise", noise.heading_per_cell / np.sqrt(cell), *fit.heading_noise, "rad/sqrt(m)"),
        Quantity("turn noise", noise.heading_per_radian, *fit.turn_noise, "rad/sqrt(rad)"),
        Quantity("position noise", noise.per_cell * np.sqrt(cell), *fit.position_noise, "m/sqrt(m)"),
        Quantity("distance spread in 10 s", None, 100 * fit.length_noise[0], 100 * fit.length_noise[1], "%"),
    ]
    note = (
        f"wheels: {fit.windows} windows of 10 s with true poses, {fit.path:.4g} m, {fit.turned:.4g} rad; "
        f"in {fit.slips} of them the wheels slip or the truth jumps (beyond 5 sd)"
    )
    return Rig(tuple(quantities), notes=(note,), unknown=tuple(unknown))


def _from_revisits(config: RunConfig, samples: list[Sample], assumed: OdometryCorrection) -> Rig:
    if config.recording is None:
        return Rig(unknown=("wheels: the record has no true poses",))
    scale = "length scale: no true poses, and a map closes its loops at any scale"
    reason = "no views that tell revisits"
    if any(shows_place(sample.reading) for sample in samples):
        found = fit_revisits(config, assumed)
        if found is not None:
            return found._replace(unknown=(scale,))
        reason = "the map closes no loops or is doubted"
    return Rig(unknown=(scale, f"turn scale, heading bias: no true poses, and {reason}"))


def shows_place(reading: Any) -> bool:
    """Whether a place may be recognised by a reading."""
    return not isinstance(reading, Observation) or bool(reading.view_seen) or int(reading.label) >= 0


WHEELS = {"length_scale": "m/m", "turn_scale": "rad/rad", "heading_bias": "rad/m"}
"""Settings of `recording.odometry` and their units."""


def _of_wheels(key: str, assumed: OdometryCorrection, found: tuple[float, float]) -> Quantity:
    name, setting = key.replace("_", " "), f"recording.odometry.{key}"
    return Quantity(name, getattr(assumed, key), *found, WHEELS[key], setting)


DELAY = (
    "head: the rest angle holds the delay of contact detection, which no contact tells apart from it "
    "(0.9 degrees for 15 mrad)"
)

STEEPEST_REST = 90.0
"""Largest rest angle of a head, degrees."""


def _fit_head(config: RunConfig, samples: list[Sample], info: SourceInfo) -> Rig:
    """Rest angle and base radii of the head.

    Args:
        config: completed for the source.
    """
    rows = [sample for sample in samples if sample.truth is not None]
    if info.maze is None or not rows:
        lacking = "walls or posts of known place" if info.maze is None else "arm poses"
        return Rig(unknown=(f"rest angle, base radii: the record has no {lacking}",))
    assumed = config.touch.head
    frontend = Frontend(config.touch, info.calibration)
    whisks = [frontend.features(sample.reading) for sample in rows]
    maze = parse_maze(info.maze.text, Path("maze of the recording"))
    walls = wall_boxes(maze, stream(info.maze.seed, "maze.heights"), info.maze.heights)
    pose = np.array([sample.truth for sample in rows])

    def predict(head: HeadConfig) -> np.ndarray:
        return Surroundings(walls, ur10_head(head)).contact(pose).angle

    contact, angle = (np.array([getattr(whisk, name) for whisk in whisks]) for name in ("contact", "touched"))
    try:
        (rest, sd), radius_of, contacts, errors = fit_head(assumed, contact, angle, predict)
    except InputError as error:
        return Rig(unknown=(f"rest angle, base radii: {error.found}; {error.expected} are needed",))
    # Rings whose radius is unknown keep theirs.
    rest = min(rest, STEEPEST_REST)
    quantities = [Quantity("rest angle", assumed.rest_deg, rest, sd, "degrees", "touch.head.rest_deg")]
    unknown, radii = [], []
    for number, (ring, radius) in enumerate(zip(assumed.rings, radius_of, strict=True)):
        radii.append(ring.radius if radius is None else radius[0])
        if radius is None:
            unknown.append(f"radius of ring {number}: too few of its contacts are against edges")
        else:
            quantities.append(Quantity(f"radius of ring {number}", ring.radius, *radius, "m"))
    found = head_with(assumed, np.array([rest, *radii]))
    rings = [{key: float(f"{value:.6g}") for key, value in ring.model_dump().items()} for ring in found.rings]
    note = (
        f"head: {contacts} contacts; their protractions err by {1e3 * errors[0]:.1f} mrad, "
        f"{1e3 * errors[1]:.1f} with the head assumed; the radii are set in touch.head.rings"
    )
    return Rig(tuple(quantities), {"touch": {"head": {"rings": rings}}}, (note, DELAY), tuple(unknown))


FOLDS, BLOCK = 3, 10
"""Parts of the rows held out in turn, and consecutive rows held out together: neighbours are alike."""


def _fit_stage(source: PluginConfig) -> Rig:
    """How well signals of a whisker on a stage follow from the place of the touch, on rows held out."""
    settings = read_settings(real_whiskers.StageConfig, source.settings, "source.settings")
    position, signal, base = real_whiskers.read_stage_calibration(settings.file)
    # Root mean square errors over the channels of each row held out: of the map, and of the mean signal.
    errors = np.zeros((2, len(signal)))
    part = np.arange(len(signal)) // BLOCK % FOLDS
    folds = [part == k for k in range(FOLDS)]
    try:
        for fold in folds:
            known = fit_signal_map(position[~fold], signal[~fold], base)
            predictions = known(position[fold]), signal[~fold].mean(axis=0)
            for out, mean in zip(errors, predictions, strict=True):
                out[fold] = np.sqrt(((signal[fold] - mean) ** 2).mean(axis=1))
    except InputError as reason:
        return Rig(unknown=(f"stage-to-signal map: {reason}",))
    size = float(np.sqrt((signal**2).mean()))
    error, control = (float(np.median(part)) for part in errors)
    share = [100 * float(np.median(errors[0][fold])) / size for fold in folds]
    quantities = (
        Quantity("signal, rms", None, size, None, "counts"),
        Quantity("error of the map, held out", None, 100 * error / size, float(np.std(share)), "% of rms"),
        Quantity("error without a map (the mean)", None, 100 * control / size, None, "% of rms"),
    )
    note = f"map: {len(signal)} touches at known places; median error of rows held out, in {FOLDS} parts"
    unknown = ("noise, drift: a stage rests between its rows, and the file has no time",)
    return Rig(quantities, notes=(note,), unknown=unknown)


def fit_revisits(config: RunConfig, assumed: OdometryCorrection = UNCORRECTED) -> Rig | None:
    """What the map of the record of a configuration knows of the odometry; None if it closes no loops, is
    doubted or has no calibration. Some maps have no error of turns.

    Raises:
        InputError: the record cannot be mapped.
    """
    with open_observations(config) as (completed, source):
        session = build_session(completed, source)
        for _ in session.replay(observation_of(sample) for sample in source):
            pass
    write = session.map.files().get("calibration.yaml")
    closures = len(session.map.closures())
    if write is None or not closures:
        return None
    with TemporaryDirectory() as folder:
        file = Path(folder) / "calibration.yaml"
        write(file)
        found = load(file).data["keyframes"]["calibration"]
    quantities = [_of_wheels("heading_bias", assumed, (found["heading_bias"], found["heading_bias_sd"]))]
    if "turn_error" in found:
        turn = 1 + found["turn_error"], found["turn_error_sd"]
        quantities.insert(0, _of_wheels("turn_scale", assumed, turn))
    note = (
        f"wheels: from the {closures} loop closures of a map (doubt {float(session.map.final_doubt()):.2f}); "
        "the standard deviations take these closures as true"
    )
    return Rig(tuple(quantities), notes=(note,))
