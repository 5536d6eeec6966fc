"""What an arm publishes that another program moves: the pose of its tool and the wrench at it, as the program
pokes in rings along the route of a simulated session."""

import numpy as np

from robot.simulation.head.simulated_pokes import PokeSimulation
from robot.world.contact_force import force_error
from tactile.base.se2 import between, compose, integrate
from tactile.pokes import poke_angles
from tests.helpers.ros_bags import Entry, header

START = 1_700_000_000_123_456_789  # ns
PRESS, DWELL = 10.0, 0.3  # the other program stops at this force, N, and rests so long, s
RETRACT = 0.1  # speed of the way back and of the way on, m/s


def profile(turn: float, hz: float, out: float, rests: bool) -> np.ndarray:
    """Depths [T] of a tool at a rate on its way out at a speed (m/s), up to `turn`, and back, m."""
    ahead, back = (np.arange(int(turn / speed * hz) + 1) * speed / hz for speed in (out, RETRACT))
    rest = np.zeros(round(DWELL * hz) if rests else 0)
    return np.concatenate([rest, ahead, turn + rest, np.full(1, turn), turn - back, np.zeros(1)])


def poked_states(
    simulation: PokeSimulation,
    hz: float = 100.0,
    rings: int | None = None,
    rests: bool = True,
    skip: frozenset[tuple[int, int]] = frozenset(),
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Poses [T, 3] of the tool in the frame of the odometry, true ones [T, 3], and forces [T, 3] in the frame
    of the tool, N.

    Args:
        rings: how many of the session, None for all. rests: whether the tool rests at home and where it
            turns. skip: rings and directions in which it does not poke.
    """
    pokes, force, random = simulation.pokes, simulation.config.force, np.random.default_rng(0)
    homes, poses, true, ways = integrate(simulation.odometry[:, :3]), [], [], []
    for number, (home, place, way) in enumerate(
        list(zip(homes, simulation.truth, simulation.way, strict=True))[:rings]
    ):
        if poses:  # moves on
            steps = round(0.06 / RETRACT * hz)
            share, frames = np.linspace(0, 1, steps)[1:, None], ((poses, home), (true, place))
            for taken, end in frames:
                taken.append(compose(taken[-1][-1], share * between(taken[-1][-1], end)))
            ways.append(np.zeros(steps - 1))
        for direction, (angle, far) in enumerate(zip(poke_angles(pokes), way, strict=True)):
            if (number, direction) in skip:
                continue
            turn = min(far + PRESS / force.stiffness, pokes.reach)
            depth = profile(turn, hz, pokes.speed, rests)
            out = depth[:, None] * np.array([np.cos(angle), np.sin(angle), 0.0])
            poses.append(compose(home, out))
            true.append(compose(place, out))
            ways.append(np.maximum(depth - far, 0.0) * force.stiffness)
    pose, truth, push = (np.concatenate(part) for part in (poses, true, ways))
    facing = np.zeros(len(pose))  # direction of the pokes in the base frame
    moved = np.diff(truth[:, :2], axis=0, prepend=truth[:1, :2])
    for row in range(1, len(pose)):
        still = np.hypot(*moved[row]) < 1e-9 or push[row] < push[row - 1]
        facing[row] = facing[row - 1] if still else np.arctan2(moved[row, 1], moved[row, 0])
    felt = force_error(force, truth) + force.noise * random.standard_normal((len(pose), 3))
    felt[:, :2] -= push[:, None] * np.column_stack([np.cos(facing), np.sin(facing)])
    return pose, truth, felt


def poke_messages(pose: np.ndarray, felt: np.ndarray, hz: float = 100.0) -> list[Entry]:
    """PoseStamped and WrenchStamped messages of poses [T, 3] and forces [T, 3], in order."""
    found = []
    for row, (at, push) in enumerate(zip(pose.tolist(), felt.tolist(), strict=True)):
        time, (x, y, yaw) = START + round(row * 1e9 / hz), at
        turn = {"x": np.cos(yaw / 2), "y": np.sin(yaw / 2), "z": 0.0, "w": 0.0}  # z of the tool points down
        place = {"position": {"x": x, "y": y, "z": 0.1}, "orientation": turn}
        stamped = {"header": header(time, "base"), "pose": place}
        found.append(Entry("/tool_pose", "geometry_msgs/msg/PoseStamped", time, stamped))
        force = dict(zip("xyz", push, strict=True))
        wrench = {"header": header(time + 1000, "tool0"), "wrench": {"force": force}}
        found.append(Entry("/ft", "geometry_msgs/msg/WrenchStamped", time + 1000, wrench))
    return found
