"""What a run directory keeps of the world and of what was felt, for scores and pictures."""

from __future__ import annotations

import numpy as np

from evaluation.artifacts.grid_npz import read_grid, write_grid_truth
from evaluation.artifacts.nav2 import write_nav2
from evaluation.artifacts.run_directory import write_walls
from evaluation.artifacts.whisker_views import WhiskerViews, write_whisker_views
from evaluation.metrics.grid_score import score_grid
from evaluation.metrics.occupancy_grid import GridTruth, OccupancyGrid, cell_centres
from ratslam.pipeline.run_directory import RunDirectory
from robot.sources.source import Source
from robot.world.arena import Arena, is_enclosed, is_occupied, read_arena, wall_segments
from robot.world.maze import read_maze, wall_boxes
from tactile.base.random_streams import stream
from tactile.base.se2 import compose, inverse
from tactile.frontend import TouchConfig
from tactile.whiskers.head_geometry import ur10_head

Felt = tuple[np.ndarray, np.ndarray]
"""A whisker image: brightness [R, C, K], and which whiskers [W] report at all."""


def keep_world(source: Source, store: RunDirectory) -> None:
    """maze.txt and walls.csv, for the pictures, of a source that knows its maze; arena.txt of one that knows
    its arena."""
    if source.info.arena is not None:
        store.text("arena.txt", source.info.arena)
    maze = source.info.maze
    if maze is None:
        return
    store.text("maze.txt", maze.text)
    boxes = wall_boxes(read_maze(store.path / "maze.txt"), stream(maze.seed, "maze.heights"), maze.heights)
    store.file("walls.csv", lambda path: write_walls(path, np.column_stack(boxes)))


def keep_images(felt: list[Felt], config: TouchConfig, store: RunDirectory) -> None:
    """views.npz, for the pictures, of a source whose views are whisker images."""
    head = ur10_head(config.head)
    if not felt or felt[0][0].shape[:2] != head.shape or len(felt[0][1]) != len(head.length):
        return
    columns = head.shape[1]
    images = WhiskerViews(
        view=np.array([view[..., 0] for view, _ in felt]),
        alive=np.array([alive.reshape(head.shape) for _, alive in felt]),
        azimuth=np.arctan2(head.rest[:columns, 1], head.rest[:columns, 0]),
        length=head.length[::columns],
        tallest=config.image.tallest,
    )
    store.file("views.npz", lambda path: write_whisker_views(path, images))


def keep_chart(source: Source, store: RunDirectory) -> None:
    """map.pgm and map.yaml of a run whose map is a grid; with a known arena also arena.npz, what is really
    there in the frame of the map, and gridscore.json."""
    file = store.path / "grid.npz"
    if not file.exists():
        return
    grid = read_grid(file)
    write_nav2(store.path, grid)
    if not (store.path / "arena.txt").exists():
        return
    arena = read_arena(store.path / "arena.txt")
    truth = truth_of(arena, grid)
    store.file("arena.npz", lambda path: write_grid_truth(path, truth, arena.start))
    score = score_grid(grid, truth, store.path.name)
    store.text("gridscore.json", score.model_dump_json(indent=2) + "\n")


def truth_of(arena: Arena, grid: OccupancyGrid) -> GridTruth:
    """What is really there, on the cells and in the frame of a map that begins where the robot starts."""
    place = cell_centres(grid)
    there = compose(arena.start, np.concatenate([place, np.zeros((*place.shape[:2], 1))], axis=2))[..., :2]
    ends = wall_segments(arena).reshape(-1, 2)
    seen = compose(inverse(arena.start), np.column_stack([ends, np.zeros(len(ends))]))[:, :2]
    return GridTruth(is_occupied(arena, there), is_enclosed(arena, there), seen.reshape(-1, 4))
