"""What each file of a run directory is."""

from __future__ import annotations

from pathlib import Path

FILES = {
    "config.yaml": "the completed configuration; `run` accepts it from any folder",
    "manifest.json": "status, versions, seed, and hashes of input and configuration",
    "scorecard.json": "the scores of the run",
    "gridscore.json": "the scores of the occupancy grid",
    "trajectory.tum": "final trajectory: that of the map, or odometry if the map is doubted",
    "map.tum": "final trajectory of the map, doubted or not",
    "pieces.csv": "piece of the map in which each step is; poses of different pieces cannot be compared",
    "localisation.csv": "state and probability of the pose in a saved map, a line for each step",
    "changes.csv": "places where a session does not agree with the saved map",
    "changes.png": "picture of the saved map with these places",
    "online.tum": "the pose at each step as it was known then",
    "odometry.tum": "dead reckoning of the raw odometry",
    "truth.tum": "true poses, where known",
    "steps.csv": "a line for each step: place, action, pose, spread, doubt, outcome, evidence",
    "online_error.csv": "error of the current pose while the run went on, m",
    "timing.csv": "computing time of each chunk of steps, s; differs from run to run",
    "health.json": "probability that the map is worse than odometry; null with its reason",
    "closures.csv": "loop closures that the map considered, with evidence and verdicts",
    "closure_views.npz": "the views that loop closures join, as 8-bit images",
    "views.npz": "whisker images of all steps",
    "map.json": "experiences and their links as a node-link graph",
    "map.g2o": "the pose graph, for other optimisers",
    "map.npz": "the map; `run --continue` goes on from it",
    "calibration.yaml": "calibration of the odometry, as settings for the next session",
    "grid.npz": "occupancy grid: probability, origin, cell",
    "map.pgm": "occupancy grid as an image, for nav2",
    "map.yaml": "description of map.pgm, for nav2",
    "maze.txt": "the maze",
    "walls.csv": "the walls of the maze, m",
    "arena.txt": "the arena",
    "arena.npz": "the true occupancy of the arena",
    "map.png": "picture of the map",
    "whiskers.png": "picture of the whisker images",
    "experiences.png": "picture of the current experience at each step",
    "grid.png": "picture of the occupancy grid",
    "cells.png": "picture of recorded pose cells",
    "cells.npz": "recorded pose cells",
    "cells.rows": "pose cells recorded so far, of a run that goes on or was killed",
    "watch.png": "picture by `watch` of the run in progress",
    "report.html": "this kind of page",
    "session.mcap": "recording of a live session",
    "live.json": "report of a live session",
    "mapper.log": "log of a live session",
}
"""In the order of the page."""
OTHER = "not a file of ratslam's own"


def list_run_files(directory: Path) -> list[tuple[str, int, str]]:
    """Name, size in bytes and content of the files of a run directory, known ones first; no hidden ones."""
    found = {path.name: path for path in sorted(directory.iterdir()) if path.is_file()}
    order = [name for name in FILES if name in found]
    order += [name for name in found if name not in FILES and not name.startswith(".")]
    return [(name, found[name].stat().st_size, FILES.get(name, OTHER)) for name in order]
