"""The run directory: files of a run, readable at any moment.

Text files grow by whole lines, one chunk at a time; all other files appear complete, by renaming. So an
interrupt, a kill or a full disk leaves a readable prefix. Besides `RunDirectory`: the world, the views, the
grid map and the changes of a localised session in it; the error of the online pose while a run proceeds.
"""

from __future__ import annotations

import fcntl
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from pathlib import Path
from typing import Any, TextIO

import numpy as np

from evaluation.artifacts import run_reader
from evaluation.artifacts.grid_files import read_grid, write_grid_truth, write_nav2
from evaluation.artifacts.run_reader import CHANGES, ChangeRow, read_closure_table, write_changes, write_walls
from evaluation.metrics.occupancy_grid import GridTruth, OccupancyGrid, cell_centres
from evaluation.metrics.occupancy_score import score_grid
from evaluation.metrics.trajectory import current_error
from ratslam.core.backend import Map
from ratslam.core.session import CHUNK, Session
from ratslam.places.change import Change, session_changes
from ratslam.places.localiser import Localiser
from robot.sources.source import SourceInfo
from robot.world.arena import Arena, read_arena, wall_segments
from robot.world.maze import read_maze, wall_boxes
from tactile.base.errors import os_errors_of
from tactile.base.files import require_new_file, write_atomically, write_text_atomically
from tactile.base.random_streams import stream
from tactile.base.se2 import compose, inverse
from tactile.frontend import TouchConfig
from tactile.whisker_geometry import ur10_head

COLUMNS = (
    "t", "place", "action", "x", "y", "heading", "sd_x", "sd_y", "sd_heading", "lost", "doubt", "outcome",
)  # fmt: skip
"""Columns of steps.csv before those of the backend: time (s), experience, action, online pose in the map
frame and its standard deviations (m, m, rad), flag, probability that the map is worse than odometry,
outcome."""
STREAMS = ("online.tum", "odometry.tum", "steps.csv", "online_error.csv", "timing.csv")
"""Files that grow by whole lines from the start on; truth.tum does from the first known pose on."""


WhiskerView = tuple[np.ndarray, np.ndarray]
"""A whisker image: brightness [R, C, K] in 0..1, and bool [W], the whisker has a signal."""


class RunDirectory(AbstractContextManager["RunDirectory"]):
    """A new run directory; a context manager that closes its text files.

    Its process holds a lock on steps.csv, which distinguishes a run from one that was killed.

    Args:
        columns: columns of steps.csv that the backend adds. manifest: the first text of manifest.json, which
            is there before the other files.

    Raises:
        InputError: the directory exists or cannot be created.
    """

    def __init__(self, path: Path, columns: Iterable[str] = (), manifest: str = "") -> None:
        self.path = path
        require_new_file(path, parents=True)
        with os_errors_of(path, "cannot be created", "a writable folder"):
            path.mkdir(parents=True)
        if manifest:
            self.text("manifest.json", manifest)
        self._streams = {name: self._begin(name) for name in STREAMS}
        with suppress(OSError):  # a file system without locks
            fcntl.flock(self._streams["steps.csv"], fcntl.LOCK_EX)
        heads = {"steps.csv": ",".join((*COLUMNS, *columns)), "online_error.csv": "t,error"}
        heads["timing.csv"] = "step,steps,seconds"
        self.append({name: head + "\n" for name, head in heads.items()})

    def __exit__(self, *_: object) -> None:
        for file in self._streams.values():
            # A full disk has been reported by the failed write; closing would report it again.
            with suppress(OSError):
                file.close()

    def _begin(self, name: str) -> TextIO:
        return (self.path / name).open("x", encoding="utf-8", newline="")

    def append(self, lines: Mapping[str, Iterable[str]]) -> None:
        """Appends whole lines to the text files and flushes them; a file begins with its first line."""
        for name, added in lines.items():
            with self._writing(name):
                text = "".join(added)
                if text and name not in self._streams:
                    self._streams[name] = self._begin(name)
                if name in self._streams:
                    self._streams[name].write(text)
                    self._streams[name].flush()

    def text(self, name: str, content: str) -> None:
        """Writes a text file atomically."""
        with self._writing(name):
            write_text_atomically(self.path / name, content)

    def file(self, name: str, write: Callable[[Path], Any]) -> None:
        """Writes any file atomically: `write(path)` gets a temporary path with the same suffix."""
        with self._writing(name):
            write_atomically(self.path / name, write)

    @contextmanager
    def _writing(self, name: str) -> Iterator[None]:
        """Names the file in errors, and notes what holds of the others."""
        try:
            yield
        except OSError as error:
            if error.errno is None:
                raise
            named = OSError(error.errno, error.strerror, error.filename or str(self.path / name))
            named.add_note("the files written before are complete")
            raise named from error

    def save_world(self, info: SourceInfo) -> None:
        """Writes maze.txt and walls.csv of a source in a maze, arena.txt of one in an arena."""
        if info.arena is not None:
            self.text("arena.txt", info.arena)
        maze = info.maze
        if maze is None:
            return
        self.text("maze.txt", maze.text)
        boxes = wall_boxes(read_maze(self.path / "maze.txt"), stream(maze.seed, "maze.heights"), maze.heights)
        self.file("walls.csv", lambda path: write_walls(path, np.column_stack(boxes)))

    def save_whisker_views(self, views: list[WhiskerView], config: TouchConfig) -> None:
        """Writes views.npz, if the views are images of the whiskers of a head."""
        head = ur10_head(config.head)
        if not views or views[0][0].shape[:2] != head.shape or len(views[0][1]) != len(head.length):
            return
        columns = head.shape[1]
        images = run_reader.WhiskerViews(
            view=np.array([view[..., 0] for view, _ in views]),
            alive=np.array([alive.reshape(head.shape) for _, alive in views]),
            azimuth=np.arctan2(head.rest[:columns, 1], head.rest[:columns, 0]),
            length=head.length[::columns],
            tallest=config.image.tallest,
        )
        self.file("views.npz", lambda path: run_reader.write_whisker_views(path, images))

    def save_closure_views(self, images: Sequence[np.ndarray | None]) -> None:
        """Writes closure_views.npz: the images [R, C] of the steps that closures join; None: no view."""
        joined = np.unique(read_closure_table(self.path).steps).tolist()
        seen = {step: image for step, image in enumerate(images) if image is not None}
        steps = [step for step in joined if step in seen]
        if steps:
            views = run_reader.ClosureViews(np.array(steps), np.stack([seen[step] for step in steps]))
            self.file(run_reader.CLOSURE_VIEWS, lambda path: run_reader.write_closure_views(path, views))

    def save_grid_map(self) -> None:
        """Writes map.pgm and map.yaml if the map is a grid; if the arena and the robot's start in it are
        known, which they are not of a localised session, arena.npz (the true grid) and gridscore.json too."""
        file = self.path / "grid.npz"
        if not file.exists():
            return
        grid = read_grid(file)
        write_nav2(self.path, grid)
        if not (self.path / "arena.txt").exists() or (self.path / "localisation.csv").exists():
            return
        arena = read_arena(self.path / "arena.txt")
        truth = true_grid(arena, grid)
        self.file("arena.npz", lambda path: write_grid_truth(path, truth, arena.start))
        score = score_grid(grid, truth, self.path.name)
        self.text("gridscore.json", score.model_dump_json(indent=2) + "\n")

    def save_changes(self, map: Map, config: TouchConfig) -> None:
        """Writes changes.csv of a session that was localised in a map."""
        if not isinstance(map, Localiser):
            return
        steps, same = map.visits().step, ("extent", "kind", "evidence", "alarms", "passes")
        rows = [
            ChangeRow(
                x=float(change.position[0]),
                y=float(change.position[1]),
                first_step=int(steps[change.keyframes[0]]),
                last_step=int(steps[change.keyframes[-1]]),
                **{name: getattr(change, name) for name in same},
            )
            for change in changes_of(map, config)
        ]
        self.file(CHANGES, lambda path: write_changes(path, rows))


def true_grid(arena: Arena, grid: OccupancyGrid) -> GridTruth:
    """The arena on the cells of a grid whose frame is the robot's start pose."""
    place = cell_centres(grid)
    there = compose(arena.start, np.concatenate([place, np.zeros((*place.shape[:2], 1))], axis=2))[..., :2]
    ends = wall_segments(arena).reshape(-1, 2)
    seen = compose(inverse(arena.start), np.column_stack([ends, np.zeros(len(ends))]))[:, :2]
    return GridTruth(~arena.in_free_space(there), arena.is_enclosed(there), seen.reshape(-1, 4))


def changes_of(localiser: Localiser, config: TouchConfig) -> list[Change]:
    """The places at which a localised session does not agree with its map, the surest first."""
    return session_changes(localiser.place, localiser.visits(), config)


class OnlineErrorLog:
    """Position error of the current pose after the online trajectory is aligned with the truth.

    It is computed at the end of a chunk, less often as the trajectory grows, because each value aligns the
    whole trajectory.

    Args:
        skipped: steps of the session's map that have no truth here: those of the run that it continues.

    Attributes:
        errors: values so far, m.
    """

    def __init__(self, skipped: int = 0) -> None:
        self.errors: list[float] = []
        self._skipped, self._due = skipped, skipped

    def update(self, session: Session, truth: Sequence[np.ndarray] | np.ndarray) -> float | None:
        """The error now, m; None between two values or if the last row of the truth [steps, 3] is NaN."""
        if session.steps < self._due or session.steps % CHUNK or not np.isfinite(truth[-1]).all():
            return None
        self._due = session.steps + max(CHUNK, session.steps // 256)
        true = np.asarray(truth)
        known = np.isfinite(true).all(axis=1)
        error = current_error(session.map.online_trajectory()[self._skipped :][known], true[known])
        self.errors.append(error)
        return error
