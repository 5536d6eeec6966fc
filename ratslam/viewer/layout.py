"""The arrangement of the views in the viewer."""

from __future__ import annotations

from typing import Any

from ratslam.pipeline.progress import RunDescription


def blueprint(run: RunDescription) -> Any:
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
