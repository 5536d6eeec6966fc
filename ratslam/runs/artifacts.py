"""Writes the world, views and the grid map to a run directory, for scores, plots and the report."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from evaluation.artifacts import closure_views
from evaluation.artifacts.closure_table import read_closure_table
from evaluation.artifacts.closure_views import ClosureViews, write_closure_views
from evaluation.artifacts.grid_npz import read_grid, write_grid_truth
from evaluation.artifacts.nav2 import write_nav2
from evaluation.artifacts.run_reader import write_walls
from evaluation.artifacts.whisker_views import WhiskerViews, write_whisker_views
from evaluation.metrics.occupancy_grid import GridTruth, OccupancyGrid, cell_centres
from evaluation.metrics.occupancy_score import score_grid
from ratslam.runs.run_directory import RunDirectory
from robot.sources.source_info import SourceInfo
from robot.world.arena import Arena, is_enclosed, is_occupied, read_arena, wall_segments
from robot.world.maze import read_maze, wall_boxes
from tactile.base.random_streams import stream
from tactile.base.se2 import compose, inverse
from tactile.frontend import TouchConfig
from tactile.whiskers.head_geometry import ur10_head

WhiskerView = tuple[np.ndarray, np.ndarray]
"""A whisker image: brightness [R, C, K] in 0..1, and bool [W], the whisker has a signal."""


def save_world(info: SourceInfo, directory: RunDirectory) -> None:
    """Writes maze.txt and walls.csv of a source in a maze, arena.txt of one in an arena."""
    if info.arena is not None:
        directory.text("arena.txt", info.arena)
    maze = info.maze
    if maze is None:
        return
    directory.text("maze.txt", maze.text)
    boxes = wall_boxes(
        read_maze(directory.path / "maze.txt"), stream(maze.seed, "maze.heights"), maze.heights
    )
    directory.file("walls.csv", lambda path: write_walls(path, np.column_stack(boxes)))


def save_whisker_views(views: list[WhiskerView], config: TouchConfig, directory: RunDirectory) -> None:
    """Writes views.npz, if the views are images of the whiskers of a head."""
    head = ur10_head(config.head)
    if not views or views[0][0].shape[:2] != head.shape or len(views[0][1]) != len(head.length):
        return
    columns = head.shape[1]
    images = WhiskerViews(
        view=np.array([view[..., 0] for view, _ in views]),
        alive=np.array([alive.reshape(head.shape) for _, alive in views]),
        azimuth=np.arctan2(head.rest[:columns, 1], head.rest[:columns, 0]),
        length=head.length[::columns],
        tallest=config.image.tallest,
    )
    directory.file("views.npz", lambda path: write_whisker_views(path, images))


def save_closure_views(images: Sequence[np.ndarray | None], directory: RunDirectory) -> None:
    """Writes closure_views.npz: the images [R, C] of this run's steps that closures join; None: no view."""
    joined = np.unique(read_closure_table(directory.path).steps).tolist()
    seen = {step: image for step, image in enumerate(images) if image is not None}
    steps = [step for step in joined if step in seen]
    if steps:
        views = ClosureViews(np.array(steps), np.stack([seen[step] for step in steps]))
        directory.file(closure_views.NAME, lambda path: write_closure_views(path, views))


def save_grid_map(directory: RunDirectory) -> None:
    """Writes map.pgm and map.yaml if the map is a grid; if the arena and the robot's start in the grid are
    known, which they are not of a localised session, also arena.npz (the true grid) and gridscore.json."""
    file = directory.path / "grid.npz"
    if not file.exists():
        return
    grid = read_grid(file)
    write_nav2(directory.path, grid)
    if not (directory.path / "arena.txt").exists() or (directory.path / "localisation.csv").exists():
        return
    arena = read_arena(directory.path / "arena.txt")
    truth = true_grid(arena, grid)
    directory.file("arena.npz", lambda path: write_grid_truth(path, truth, arena.start))
    score = score_grid(grid, truth, directory.path.name)
    directory.text("gridscore.json", score.model_dump_json(indent=2) + "\n")


def true_grid(arena: Arena, grid: OccupancyGrid) -> GridTruth:
    """The arena on the cells of a grid whose frame is the robot's start pose."""
    place = cell_centres(grid)
    there = compose(arena.start, np.concatenate([place, np.zeros((*place.shape[:2], 1))], axis=2))[..., :2]
    ends = wall_segments(arena).reshape(-1, 2)
    seen = compose(inverse(arena.start), np.column_stack([ends, np.zeros(len(ends))]))[:, :2]
    return GridTruth(is_occupied(arena, there), is_enclosed(arena, there), seen.reshape(-1, 4))
