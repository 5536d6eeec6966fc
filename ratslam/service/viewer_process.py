"""The process that draws a run with rerun: reads messages from its standard input and logs them.

python -m ratslam.service.viewer_process TARGET
"""

from __future__ import annotations

import os
import pickle
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from ratslam.core.arrays import GrowableArray
from ratslam.core.estimates import GridDrawing, PoseCellActivity
from ratslam.runs.runner import MapReport, RunDescription, StepReport
from ratslam.service.viewer_link import GONE
from tactile.base.errors import tell
from tactile.whisker_geometry import Head

APPLICATION = "ratslam"
GREY, BLUE, GREEN, RED, ORANGE = (128, 128, 128), (60, 120, 216), (30, 160, 60), (200, 30, 30), (230, 140, 30)
VERDICTS = {1: ("accepted", GREEN), 0: ("open", ORANGE), -1: ("removed", RED)}
"""Name and colour of a verdict on a candidate, see `Map.judged_closures`."""
STEP, TIME = "step", "session_time"
"""Timelines: number of the step, and s since the first one."""


def open_recording(target: str) -> Any:
    """A rerun recording that goes to a file or to a viewer (`ratslam.service.viewer_link`)."""
    import rerun

    if target.endswith(".rrd"):
        recording = rerun.RecordingStream(APPLICATION, recording_id=Path(target).stem)
        recording.save(target)
    else:
        recording = rerun.RecordingStream(APPLICATION)
        recording.connect_grpc(f"rerun+http://{target}/proxy")
    recording.set_log_time_enabled(False)
    recording.set_log_tick_enabled(False)
    return recording


class Drawing:
    """Draws into a recording. Of steps that were dropped only gaps are seen.

    Args:
        recording: a `rerun.RecordingStream`.
    """

    def __init__(self, recording: Any) -> None:
        import rerun

        self._rr, self._recording, self._log = rerun, recording, recording.log
        self._run = RunDescription("", "")
        self._start: float | None = None
        self._path = GrowableArray((3,), np.float64)  # of all steps: as last reported, then online
        self._odometry = GrowableArray((3,), np.float64)  # of the steps drawn
        self._online = GrowableArray((3,), np.float64)  # of the same
        self._whole = 0  # number of steps drawn when the whole path was
        self._place_step: dict[int, int] = {}
        self._links: set[tuple[int, int]] = set()
        self._verdicts: dict[tuple[int, int], int] = {}  # the last one on each candidate

    def begin(self, run: RunDescription) -> None:
        """Draws what does not change."""
        self._run = run
        self._recording.send_recording_name(f"{run.name}, {run.backend}")
        self._recording.send_blueprint(_blueprint(run))
        self._log("world", self._rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        arrow = self._rr.Arrows3D(vectors=[[0.15, 0.0, 0.0]], colors=[BLUE])
        self._log("world/robot/heading", arrow, static=True)
        for name, colour in (("doubt", RED), ("lost", ORANGE), ("novelty", GREY)):
            self._log(f"health/{name}", self._rr.SeriesLines(colors=[colour], names=[name]), static=True)
        if run.head is not None:
            self._log("world/robot/head/bases", self._rr.Points3D(run.head.base, radii=0.003), static=True)

    def update(self, steps: Sequence[StepReport], map: MapReport | None) -> None:
        """Draws steps, and the map after them."""
        for step in steps:
            self._draw_step(step)
        if map is not None:
            self._draw_map(map)

    def finish(self, map: MapReport) -> None:
        """Draws the final map."""
        if len(self._online.rows):
            self._draw_map(map)

    def _log_lines(self, name: str, strips: list[Any], colour: tuple[int, int, int], width: float) -> None:
        radius = self._rr.Radius.ui_points(width)
        self._log(f"world/{name}", self._rr.LineStrips3D(strips, colors=[colour], radii=radius))

    def _draw_step(self, step: StepReport) -> None:
        self._start = step.time if self._start is None else self._start
        self._recording.set_time(STEP, sequence=step.number)
        self._recording.set_time(TIME, duration=step.time - self._start)
        # Path, place and link of the step; steps that were dropped get its pose.
        self._odometry.append(step.odometry)
        self._online.append(step.pose)
        for _ in range(len(self._path.rows), step.number + 1):
            self._path.append(step.pose)
        if step.place >= 0:
            self._place_step.setdefault(step.place, step.number)
            if step.previous >= 0 and step.previous != step.place:
                self._links.add((step.previous, step.place))
        turn = self._rr.RotationAxisAngle([0, 0, 1], radians=float(step.pose[2]))
        place = [*step.pose[:2], 0.0]
        self._log("world/robot", self._rr.Transform3D(translation=place, rotation_axis_angle=turn))
        if np.isfinite(step.doubt):
            self._log("health/doubt", self._rr.Scalars(step.doubt))
        self._log("health/lost", self._rr.Scalars(float(step.lost)))
        observation = step.observation
        if observation.view_seen and observation.view.size:
            pixels = np.rint(255 * np.clip(observation.view, 0.0, 1.0)).astype(np.uint8)
            self._log("view", self._rr.Image(pixels if pixels.shape[2] == 3 else pixels[..., 0]))
        if self._run.head is not None:
            self._draw_whiskers(observation)

    def _draw_whiskers(self, observation: Any) -> None:
        head = self._run.head
        assert head is not None
        touching = observation.contact & observation.alive
        height = self._run.tallest * observation.view[..., 0].reshape(-1)
        colours = np.where(touching[:, None], ORANGE, np.where(observation.alive[:, None], BLUE, GREY))
        curves = whisker_curves(head, touching, observation.point, height)
        strips = self._rr.LineStrips3D(list(curves), colors=colours.astype(np.uint8), radii=0.0015)
        self._log("world/robot/head/whiskers", strips)
        tips = self._rr.Points3D(curves[touching, -1], colors=[ORANGE], radii=0.004)
        self._log("world/robot/head/contacts", tips)

    def _draw_map(self, map: MapReport) -> None:
        if map.activity is not None:
            self._draw_activity(map.activity)
        if map.path is not None:
            self._path.replace(np.array(map.path))
            self._whole = len(self._online.rows)
            self._draw_path("odometry", self._odometry.rows, GREY)
            self._draw_path("online", self._online.rows, BLUE)
            self._draw_path("path", map.path, GREEN)
        recent = slice(max(0, self._whole - 1), None)
        self._draw_path("odometry/recent", self._odometry.rows[recent], GREY)
        self._draw_path("online/recent", self._online.rows[recent], BLUE)
        places = _on_floor(self._path.rows[list(self._place_step.values())])
        if len(places):
            radius = self._rr.Radius.ui_points(3.0)
            self._log("world/experiences", self._rr.Points3D(places, colors=[BLUE], radii=radius))
            known = [(a, b) for a, b in sorted(self._links) if a in self._place_step]
            ends = np.array([[self._place_step[a], self._place_step[b]] for a, b in known], int)
            self._draw_pairs("links", ends, GREY)
        self._draw_closures(map.closures)
        if map.grid is not None:
            self._draw_grid(map.grid)

    def _draw_path(self, name: str, poses: np.ndarray, colour: tuple[int, int, int]) -> None:
        if len(poses) > 1:
            self._log_lines(name, [_on_floor(poses)], colour, 1.5)

    def _draw_pairs(self, name: str, ends: np.ndarray, colour: tuple[int, int, int]) -> None:
        """Lines between pairs of steps [n, 2]."""
        strips = list(_on_floor(self._path.rows[ends.ravel()]).reshape(-1, 2, 3))
        self._log_lines(name, strips, colour, 1.0)

    def _draw_closures(self, closures: np.ndarray) -> None:
        """Candidates by their verdict, and as text each change of one: `dropped` was accepted before."""
        for earlier, later, sign in closures.tolist():
            before = self._verdicts.get((earlier, later))
            if before != sign:
                self._verdicts[earlier, later] = sign
                verdict = "dropped" if before == 1 else VERDICTS[sign][0]
                self._log("judgements", self._rr.TextLog(f"step {later} with step {earlier}: {verdict}"))
        known = closures[(closures[:, :2] < len(self._path.rows)).all(axis=1)]
        for sign, (name, colour) in VERDICTS.items():
            self._draw_pairs(f"closures/{name}", known[known[:, 2] == sign, :2], colour)

    def _draw_activity(self, activity: PoseCellActivity) -> None:
        # Rows of an image count downwards, y upwards.
        picture = activity.xy[::-1].astype(np.float32)
        colours = self._rr.components.Colormap.Viridis
        self._log("pose_cells/activity", self._rr.DepthImage(picture, colormap=colours))
        self._log("pose_cells/heading", self._rr.BarChart(activity.heading))
        if activity.packets is not None:
            heading, mass = activity.packets[:, 2:].T
            arrows = self._rr.Arrows3D(
                origins=_on_floor(activity.packets),
                vectors=0.15 * np.column_stack([np.cos(heading), np.sin(heading), np.zeros(len(mass))]),
                colors=[[*ORANGE, round(255 * min(1.0, share))] for share in mass.tolist()],
                labels=[f"{share:.0%}" for share in mass],
            )
            self._log("world/packets", arrows)
            novelty = max(0.0, 1.0 - float(activity.heading.sum()))
            self._log("health/novelty", self._rr.Scalars(novelty))

    def _draw_grid(self, grid: GridDrawing) -> None:
        cells = np.rint(100 * grid.probability).astype(np.uint8)[::-1]
        height, width = cells.shape
        picture = self._rr.components.ImageFormat(
            width=width, height=height, color_model="L", channel_datatype="U8"
        )
        self._log(
            "world/grid",
            self._rr.GridMap(
                data=np.ascontiguousarray(cells).tobytes(),
                format=picture,
                cell_size=grid.cell,
                translation=[*grid.origin, -0.001],
                colormap=self._rr.components.Colormap.RvizMap,
            ),
        )


def _on_floor(poses: np.ndarray) -> np.ndarray:
    """Points [n, 3] of poses [n, 3] at height 0."""
    return np.column_stack([poses[:, :2], np.zeros(len(poses))]) if len(poses) else np.zeros((0, 3))


def _blueprint(run: RunDescription) -> Any:
    """The map and the loop closures on the left; on the right what the run has of pose cells, view and
    whiskers, and its health."""
    import rerun.blueprint as rrb

    left = rrb.Vertical(
        rrb.Spatial3DView(origin="world", name="map", line_grid=True),
        rrb.TextLogView(origin="judgements", name="loop closures"),
        row_shares=[4, 1],
    )
    cells = rrb.Horizontal(
        rrb.Spatial2DView(origin="pose_cells/activity", name="pose cells, x and y"),
        rrb.BarChartView(origin="pose_cells/heading", name="pose cells, heading"),
    )
    view: Any = rrb.Spatial2DView(origin="view", name="view")
    if run.head is not None:
        whiskers = rrb.Spatial3DView(origin="world/robot/head", name="whiskers", line_grid=False)
        view = rrb.Horizontal(view, whiskers)
    health = rrb.TimeSeriesView(origin="health", name="health")
    right = rrb.Vertical(*([cells] if run.pose_cells else []), view, health)
    return rrb.Blueprint(
        rrb.Horizontal(left, right, column_shares=[3, 2]),
        rrb.TimePanel(timeline="step", state="collapsed"),
        rrb.SelectionPanel(state="hidden"),
        rrb.BlueprintPanel(state="hidden"),
    )


POINTS = 9
"""Points along a drawn whisker."""


def whisker_curves(head: Head, contact: np.ndarray, point: np.ndarray, height: np.ndarray) -> np.ndarray:
    """Curves [W, POINTS, 3] in base_link, m.

    A whisker in contact is a parabola from its base, where it keeps its direction at rest, to the point that
    it touches.

    Args:
        contact: [W] bool. point: [W, 2] contact points, m. height: [W] of the contacts above the floor, m.
    """
    rest = head.base + head.length[:, None] * head.rest
    end = np.where(contact[:, None], np.column_stack([point, height]), rest)
    middle = (head.base + rest) / 2
    share = np.linspace(0.0, 1.0, POINTS)[None, :, None]
    base, middle, end = (corner[:, None] for corner in (head.base, middle, end))
    return (1 - share) ** 2 * base + 2 * share * (1 - share) * middle + share**2 * end


PATIENCE = 30.0
"""Time that a viewer may take for one message, s."""


def main(target: str, source: BinaryIO) -> int:
    """Draws all messages; returns the exit code."""
    recording = open_recording(target)
    drawing = Drawing(recording)
    try:
        while True:
            try:
                message = pickle.load(source)
            except (EOFError, pickle.UnpicklingError):
                break
            if isinstance(message, RunDescription):
                drawing.begin(message)
            elif isinstance(message, MapReport):
                drawing.finish(message)
            else:
                drawing.update(*message)
            _flush(recording)
        if target.endswith(".rrd"):
            recording.disconnect()  # completes the file; with a viewer this may wait for ever
    except (RuntimeError, TimeoutError) as error:
        tell(f"warning: the view at {target} is gone ({error}); the run goes on without it")
        return GONE
    return 0


def _flush(recording: Any) -> None:
    """Waits until the viewer has the data, so that no more than one message is ever on the way.

    Raises:
        RuntimeError: the connection is broken, or the disk refuses the data.
        TimeoutError: the viewer has taken nothing for `PATIENCE`.
    """
    due = time.monotonic() + PATIENCE
    while True:
        try:
            recording.flush(timeout_sec=1.0)
        except RuntimeError as error:
            if "timed out" not in str(error):
                raise
            if time.monotonic() > due:
                raise TimeoutError(f"it has taken no data for {PATIENCE:g} s") from None
        else:
            return


if __name__ == "__main__":
    code = main(sys.argv[1], sys.stdin.buffer)
    os._exit(code)  # at a normal exit rerun would wait for a viewer that takes no data
