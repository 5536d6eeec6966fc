"""A rig: the quantities found in a record, what a configuration includes of them, and both as text.

Systematic errors and noise of wheel odometry, from a record with true poses.

The record is cut into windows of 10 s: shorter ones measure the jitter of the truth and the offset between
the clocks, longer ones leave too few. Over a window of L m and T rad of turning by the odometry,
    true turn  = turn_scale T + heading_bias L + noise of variance (a L + c |T|),
    true chord = length_scale x chord of the odometry with these headings + noise,
by robust least squares (soft L1), since a wheel that slips for a moment is no scale error. Uncertainties are
standard deviations over bootstrap copies of blocks of consecutive windows (Kuensch 1989).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import reduce
from itertools import chain
from typing import Any, NamedTuple

import numpy as np

from ratslam.runs.settings.strict_yaml import dump_data, merge_settings
from robot.sources.odometry import UNCORRECTED, OdometryCorrection, correct_motions
from tactile.base.errors import InputError
from tactile.base.random_streams import stream
from tactile.base.samples import robust_sd
from tactile.base.se2 import integrate, wrap

WINDOW = 10.0
"""Shortest window, s."""
LEAST_WINDOWS = 12
"""Least number of windows; the scales of fewer differ from one another more than they tell."""
LEAST_TURNED = 2 * np.pi
"""Least sum of absolute turns for a turn scale, rad."""
BLOCKS, DRAWS = 15, 300
"""Blocks of consecutive windows, and bootstrap copies."""
SLIP = 5.0
"""A window whose error exceeds this many robust standard deviations is a slip."""
KEPT_SDS = 2.0
"""A quantity that is nearer to the assumed one than this many of its standard deviations changes nothing: a
heading bias of no significance, applied to a long path, does more harm than none."""


class WheelFit(NamedTuple):
    """Errors of an odometry, each as (value, standard deviation); None where the record does not tell.

    Attributes:
        length_scale: true distance over that of the odometry. turn_scale: the same of turns. heading_bias:
            rad/m. heading_noise: rad per root metre. turn_noise: rad per root radian turned. length_noise:
            standard deviation of the distance of a window, as a share of it. position_noise: rms of the
            corrected chord's length, m per root metre. windows: their number. slips: of these, those with a
            turn or a distance that no noise explains. path: m. turned: sum of absolute turns, rad.
    """

    length_scale: tuple[float, float]
    turn_scale: tuple[float, float] | None
    heading_bias: tuple[float, float]
    heading_noise: tuple[float, float]
    turn_noise: tuple[float, float]
    length_noise: tuple[float, float]
    position_noise: tuple[float, float]
    windows: int
    slips: int
    path: float
    turned: float

    @property
    def correction(self) -> OdometryCorrection:
        """The systematic errors beyond `KEPT_SDS`, as settings of a recording."""
        found = {key: getattr(self, key) for key in ("length_scale", "turn_scale", "heading_bias")}
        off = {key: pair[0] - getattr(UNCORRECTED, key) for key, pair in found.items() if pair}
        sure = {key: found[key][0] for key in off if abs(off[key]) > KEPT_SDS * found[key][1]}
        return OdometryCorrection(**sure)


def fit_wheels(time: np.ndarray, motion: np.ndarray, truth: np.ndarray, seed: int = 0) -> WheelFit:
    """The errors of an odometry against true poses.

    Args:
        time: [N] s. motion: [N, 3] (m, m, rad) since the previous row. truth: [N, 3] (m, m, rad), rows of NaN
            where unknown. seed: of the bootstrap.

    Raises:
        InputError: the truth covers too few windows, or the robot does not move.
    """
    starts: list[int] = []  # rows with a true pose, at least `WINDOW` apart: the ends of the windows
    for row in np.flatnonzero(np.isfinite(truth).all(axis=1)).tolist():
        if not starts or time[row] - time[starts[-1]] >= WINDOW:
            starts.append(row)
    ends = np.array(starts, int)
    windows = _measure(motion, truth, ends, UNCORRECTED)
    path, turned = float(windows[0].sum()), float(windows[2].sum())
    if len(ends) - 1 < LEAST_WINDOWS or path == 0:
        found = f"{path:.3g} m in {max(len(ends) - 1, 0)} windows of {WINDOW:g} s with true poses"
        raise InputError("wheels", found, f"at least {LEAST_WINDOWS} windows of a robot that moves")
    turns = turned >= LEAST_TURNED
    start = _solve_heading(windows, turns)
    windows = _measure(motion, truth, ends, OdometryCorrection(turn_scale=start[0], heading_bias=start[1]))
    values, count = _solve(windows, turns), windows.shape[1]
    blocks = np.array_split(np.arange(count), min(BLOCKS, count))
    chosen = stream(seed, "fit.wheels").integers(0, len(blocks), (DRAWS, len(blocks)))
    copies = (np.concatenate([blocks[k] for k in one]) for one in chosen)  # rows of each bootstrap copy
    draws = np.array([_solve(windows[:, rows], turns) for rows in copies])
    pairs = [(float(value), float(sd)) for value, sd in zip(values, draws.std(axis=0), strict=True)]
    length, turn, _, true_turn, chord, true_chord = windows
    off = true_turn - values[1] * turn - values[2] * length, true_chord - values[0] * chord
    slips = np.any([np.abs(error) > SLIP * robust_sd(error) for error in off], axis=0)
    scale, turn_scale, bias, heading_noise, turn_noise, length_noise, position_noise = pairs
    noises = heading_noise, turn_noise, length_noise, position_noise
    known = turn_scale if turns else None
    return WheelFit(scale, known, bias, *noises, len(length), int(slips.sum()), path, turned)


def _measure(
    motion: np.ndarray, truth: np.ndarray, ends: np.ndarray, correction: OdometryCorrection
) -> np.ndarray:
    """[6, M] of each of the windows between these rows: way (m), turn and sum of absolute turns (rad) by
    odometry, true turn, chord by odometry with corrected headings, and true chord (m)."""
    raw = motion[:, :3]
    sums = np.cumsum(np.column_stack([np.hypot(raw[:, 0], raw[:, 1]), raw[:, 2], np.abs(raw[:, 2])]), axis=0)
    length, turn, turned = np.diff(sums[ends], axis=0).T
    known = np.flatnonzero(np.isfinite(truth).all(axis=1))
    # A turn of more than half a circle between two true poses is resolved by the odometry.
    steps = np.diff(sums[known, 1])
    steps = steps + wrap(np.diff(truth[known, 2]) - steps)
    true_sum = np.concatenate([[0.0], np.cumsum(steps)])[np.searchsorted(known, ends)]
    path = integrate(correct_motions(correction, raw))[ends, :2]
    chord, true_chord = (np.hypot(*np.diff(place, axis=0).T) for place in (path, truth[ends, :2]))
    return np.stack([length, turn, turned, np.diff(true_sum), chord, true_chord])


def _solve(windows: np.ndarray, turns: bool) -> np.ndarray:
    """[7] length scale, turn scale, heading bias, and the noises in the order of `WheelFit`."""
    from scipy.optimize import nnls  # slow to import

    length, turn, turned, true_turn, chord, true_chord = windows
    turn_scale, bias = _solve_heading(windows, turns)
    (scale,) = _solve_robustly(chord[:, None], true_chord)
    square = _clip_slips(true_turn - turn_scale * turn - bias * length) ** 2
    per_metre, per_radian = nnls(np.column_stack([length, turned]), square)[0]
    off = _clip_slips(true_chord - scale * chord)
    share = np.sqrt((off**2).sum() / (chord**2).sum())
    noises = np.sqrt([per_metre, per_radian]).tolist()
    return np.array([scale, turn_scale, bias, *noises, share, np.sqrt((off**2).sum() / length.sum())])


def _solve_heading(windows: np.ndarray, turns: bool) -> tuple[float, float]:
    """Turn scale and heading bias; without turns the scale stays 1."""
    length, turn, _, true_turn, *_ = windows
    if turns:
        scale, bias = _solve_robustly(np.column_stack([turn, length]), true_turn)
        return float(scale), float(bias)
    (bias,) = _solve_robustly(length[:, None], true_turn - turn)
    return 1.0, float(bias)


def _solve_robustly(columns: np.ndarray, value: np.ndarray) -> np.ndarray:
    """Coefficients of the columns [M, P] that give the values [M]."""
    from scipy.optimize import least_squares

    start = np.linalg.lstsq(columns, value, rcond=None)[0]
    scale = float(robust_sd(value - columns @ start))
    if scale == 0:
        return start
    fit = least_squares(
        lambda x: columns @ x - value, start, jac=lambda x: columns, loss="soft_l1", f_scale=scale
    )
    return fit.x


def _clip_slips(error: np.ndarray) -> np.ndarray:
    most = SLIP * robust_sd(error)
    return np.clip(error, -most, most)


HEADING = ("quantity", "assumed", "now", "+-", "unit", "setting")


class Quantity(NamedTuple):
    """A quantity of the rig.

    Attributes:
        name: in words. assumed: by the configuration; None where nothing is. value: found. sd: its standard
            deviation; None where it is exact or unknown. unit: as text. setting: path of the setting that
            takes the value; '' for none.
    """

    name: str
    assumed: float | None
    value: float
    sd: float | None
    unit: str
    setting: str = ""

    @property
    def differs(self) -> bool:
        """Whether the value is another one than that assumed, by `KEPT_SDS`."""
        if self.assumed is None or self.sd is None:
            return True
        return abs(self.value - self.assumed) > KEPT_SDS * self.sd


class Rig(NamedTuple):
    """What a record tells of a rig.

    Attributes:
        quantities: found. settings: further settings, nested. notes: what was found, in words. unknown: what
            this record does not tell, each with the reason.
    """

    quantities: tuple[Quantity, ...] = ()
    settings: dict[str, Any] = {}  # noqa: RUF012
    notes: tuple[str, ...] = ()
    unknown: tuple[str, ...] = ()

    @classmethod
    def join(cls, rigs: Iterable[Rig]) -> Rig:
        """All parts as one rig."""
        quantities, settings, notes, unknown = zip(*rigs, strict=True)
        return cls(
            tuple(chain(*quantities)),
            reduce(merge_settings, settings, {}),
            tuple(chain(*notes)),
            tuple(chain(*unknown)),
        )

    def included(self) -> dict[str, Any]:
        """All settings, nested, for a configuration to include; quantities within `KEPT_SDS` of what was
        assumed are left out."""
        settings = self.settings
        for quantity in self.quantities:
            if quantity.setting and quantity.differs:
                value: Any = float(f"{quantity.value:.6g}")
                for key in reversed(quantity.setting.split(".")):
                    value = {key: value}
                settings = merge_settings(settings, value)
        return settings

    def render(self) -> str:
        """The quantities as a table, with notes and what the record does not tell."""
        rows: list[Sequence[str]] = [HEADING]
        for quantity in self.quantities:
            assumed = "-" if quantity.assumed is None else f"{quantity.assumed:.4g}"
            sd = "-" if quantity.sd is None else f"{quantity.sd:.2g}"
            setting = quantity.setting
            if setting and not quantity.differs:
                setting = f"unchanged, within {KEPT_SDS:g} sd"
            rows.append((quantity.name, assumed, f"{quantity.value:.4g}", sd, quantity.unit, setting))
        lines = aligned(rows) if self.quantities else []
        return "\n".join([*lines, *self.notes, *(f"not determined: {reason}" for reason in self.unknown)])

    def file_text(self, record: str, command: str = "fit") -> str:
        """The file that a configuration includes: the settings, below the table as comments.

        Args:
            record: from which they are. command: that writes it.
        """
        text = f"The rig from {record}, written by `python -m ratslam {command}`.\n{self.render()}"
        comment = "\n".join(f"# {line}".rstrip() for line in text.splitlines())
        settings = self.included()
        use = "# A configuration takes these settings, where it has none of its own, by `include: [FILE]`."
        if not settings:
            use = "# No setting differs from what was assumed: there is nothing to include."
        return f"{comment}\n{use}\n{dump_data(settings)}"


def aligned(rows: Sequence[Sequence[str]]) -> list[str]:
    """Rows of cells as lines, in columns."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return ["  ".join(map(str.ljust, row, widths)).rstrip() for row in rows]
