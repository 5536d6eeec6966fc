"""Your sensor, live: a thread reads the robot, and a loop of your own maps what it reads.

`python -m ratslam.examples.sensor_live` maps the walls of a room with six range sensors on wheels and prints

    300 readings mapped as they came: 0.07 m off, odometry 0.2 m
"""

import queue
import threading
import time

import numpy as np

import ratslam
from evaluation.plots.style import BLUE, GREY, INK, add_axes, add_legend, metre_grid, name_axes, new_figure
from tactile.base.se2 import integrate

READINGS, PERIOD, ROOM = 300, 0.02, (3.0, 2.0)  # number, s, m
MOTION = np.array([0.05, 0.0, 2 * np.pi / 75])  # per reading: m, m, rad
Reading = tuple[ratslam.Odometry, np.ndarray]


def _read_robot(readings: "queue.Queue[Reading | None]") -> None:
    """Your driver. Here: a robot that drives circles in a room, whose odometry turns 3 % too far."""
    random, rays = np.random.default_rng(2), np.arange(6) * np.pi / 3
    for x, y, heading in integrate(np.tile(MOTION, (READINGS, 1))):
        ahead = np.stack([np.cos(heading + rays), np.sin(heading + rays)], axis=1)
        walls = np.where(ahead > 0, ROOM, 0.0) - (x + ROOM[0] / 2, y + 0.4)
        ranges = (walls / ahead).min(axis=1) + random.normal(0, 0.01, 6)  # m
        view = np.clip(ranges / 3.0, 0, 1).reshape(1, 6, 1)
        time.sleep(PERIOD)
        readings.put((ratslam.Odometry(MOTION[0], 0.0, 1.03 * MOTION[2], PERIOD), view))
    readings.put(None)


def main() -> None:
    config = ratslam.load_config("square", ["recording=null", "session.reserve=512"], source_required=False)
    slam = ratslam.Slam(config, ratslam.SourceDescription(view_shape=(1, 6, 1), rate_hz=1 / PERIOD))
    readings: queue.Queue[Reading | None] = queue.Queue()
    threading.Thread(target=_read_robot, args=(readings,), daemon=True).start()
    motion, online, seconds = [], [], []
    while (reading := readings.get()) is not None:
        begin = time.perf_counter()
        estimate = slam.step(ratslam.observation(*reading))
        seconds.append(time.perf_counter() - begin)
        motion.append(reading[0][:3])
        online.append(estimate.pose)
    truth = integrate(np.tile(MOTION, (READINGS, 1)))
    paths = {"odometry": integrate(np.array(motion)), "online": np.array(online)}
    off = {name: np.hypot(*(path - truth)[:, :2].T).mean() for name, path in paths.items()}
    errors = f"{off['online']:.1g} m off, odometry {off['odometry']:.1g} m"
    print(f"{slam.steps} readings mapped as they came: {errors}")

    line = "four circles in a room, known by six ranges and bad odometry"
    figure = new_figure(4.9, "Your sensor, live", line)
    plane, clock = add_axes(figure, 0.62, 1.0, 3.0, 3.0), add_axes(figure, 4.6, 1.0, 3.0, 3.0)
    plane.plot(*truth[:, :2].T, color=INK, lw=0.8, label="truth")
    plane.plot(*paths["odometry"][:, :2].T, color=GREY, lw=0.8, ls="--", label="odometry")
    plane.plot(*paths["online"][:, :2].T, color=BLUE, lw=1.2, label="pose during the session")
    plane.set_aspect("equal")
    metre_grid(plane)
    clock.plot(1e3 * np.sort(seconds), np.linspace(0, 100, len(seconds)), color=BLUE)
    clock.axvline(1e3 * PERIOD, color=INK, lw=0.8, ls=":")
    clock.set_xscale("log")
    name_axes(clock, "time of a step (ms); dotted: between readings", "share of the steps (%)")
    add_legend(figure, plane)
    figure.savefig("sensor_live.png")


if __name__ == "__main__":
    main()
