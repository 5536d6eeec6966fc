"""Made-up strain of four tapered whiskers against flat walls and posts, in closed form, no simulator."""

import numpy as np

from tactile.base.types import MotionKind, Odometry, Report, StepEnd
from tactile.wall_estimation.report_frontend import ReportFrontendConfig

RATE, SPEED, CONTACT = 2000.0, 0.02, 2e-4
TIME = np.arange(4000) / RATE
FEELERS = ReportFrontendConfig().feelers
POINTING = np.arctan2(*FEELERS.direction.T[::-1])
LENGTH = 0.14
TAPER = (1 - 0.3 / 1.45) / LENGTH
STIFF = 3 * 0.725e-3  # strain a radian and 1/m


def wall(angle: float, random: np.random.Generator | None = None, *, first: int | None = None) -> np.ndarray:
    """[T, W, 2] from first contact on, at a wall of that direction (rad in base_link), which is endless, or
    long enough for the whisker `first` alone; with noise where a stream is given."""
    normal = np.array([np.sin(angle), -np.cos(angle)])
    beta = angle - POINTING
    nearer, side = np.minimum(beta, np.pi - beta), np.where(beta < np.pi / 2, 1, -1)
    there = np.arange(4) == first if first is not None else np.ones(4, bool)
    room = FEELERS.base @ normal + LENGTH * np.sin(beta)  # from the wall to the middle, tips just touching

    def strain(distance: np.ndarray) -> np.ndarray:
        gap = np.clip((distance[:, None] - FEELERS.base @ normal) / LENGTH, -1.0, 1.0)
        slant = np.minimum(np.arcsin(gap), nearer)
        turn = np.where((nearer > 0) & there, nearer - slant, 0.0)
        across = STIFF * (1 / LENGTH - TAPER) * side * turn
        down = 0.08 * across - 0.15 * np.abs(across) * np.tan(np.minimum(slant + 0.2, 1.3))
        return np.stack([across, down], axis=-1)

    far = float(room[there & (nearer > 0)].max())
    approach = far - np.linspace(0, 0.05, 5001)
    hit = approach[np.argmax(np.abs(strain(approach)[..., 0]).max(axis=1) > CONTACT)]
    read = strain(hit - SPEED * np.sin(angle) * TIME)
    return read if random is None else read + 4e-6 * random.standard_normal(read.shape)


def post(whisker: int, along: float) -> np.ndarray:
    """[T, W, 2] as one whisker is bent about a post that it met so far along its shaft, m."""
    away = along * FEELERS.direction[whisker] - np.outer(0.05 * np.arange(200) / 200 + 1e-6, [1.0, 0.0])

    def strain(away: np.ndarray) -> np.ndarray:
        reach = np.linalg.norm(away, axis=1)
        turn = np.arctan2(away[:, 1], away[:, 0]) - POINTING[whisker]
        return np.where(reach < LENGTH, STIFF * (1 / reach - TAPER) * turn, 0.0)

    begun = away[np.argmax(np.abs(strain(away)) > CONTACT)]
    across = strain(begun - np.outer(SPEED * TIME, [1.0, 0.0]))
    read = np.zeros((len(TIME), 4, 2))
    read[:, whisker] = np.stack([across, 0.08 * across - 0.05 * np.abs(across)], axis=-1)
    return read


def report(
    moment: StepEnd = StepEnd.FREE,
    *,
    motion: MotionKind = MotionKind.FORWARD,
    contact: tuple[int, ...] = (),
    strain: np.ndarray | None = None,
    odometry: Odometry | None = None,
) -> Report:
    """A report; that of FWD2 if it has strain."""
    strain = np.zeros((0, 4, 2)) if strain is None else strain
    seconds, time = len(strain) / RATE, np.arange(len(strain)) / RATE
    driven = Odometry(SPEED * seconds, 0.0, 0.0, seconds) if seconds else Odometry(0.025, 0, 0, 0.5)
    touched = np.isin(np.arange(4), contact)
    return Report(odometry or driven, int(motion), int(moment), np.ones(4, bool), touched, time, strain)


def met(strain: np.ndarray, share: float = 0.4) -> tuple[Report, Report]:
    """HIT1 of the first whisker in that strain and its successor: HIT2 when a second whisker touches, ABORT
    if none does within `share` of the strain."""
    level = np.abs(strain[..., 0]) > CONTACT
    ever = np.logical_or.accumulate(level, axis=0)
    first = int(np.abs(strain[0, :, 0]).argmax())
    second = np.flatnonzero(ever.sum(axis=1) > 1)
    last = round(share * len(strain))
    hit = len(second) > 0 and second[0] < last
    end = max(int(second[0]), 200) if hit else last
    now = tuple(np.flatnonzero(ever[end]).tolist())
    slow = report(StepEnd.HIT2 if hit else StepEnd.ABORT, contact=now, strain=strain[:end])
    return report(StepEnd.HIT1, contact=(first,)), slow


def apart(one: float, other: float) -> float:
    """Degrees between two directions, which repeat after half a turn."""
    return float(abs((np.degrees(one - other) + 90) % 180 - 90))
