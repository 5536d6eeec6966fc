"""The arrangement of the views in the viewer."""

from __future__ import annotations

from typing import Any


def blueprint() -> Any:
    """The map on the left; pose cells, view, whiskers and health on the right."""
    import rerun.blueprint as rrb

    left = rrb.Vertical(
        rrb.Spatial3DView(origin="world", name="map", line_grid=True),
        rrb.TextLogView(origin="judgements", name="loop closures"),
        row_shares=[4, 1],
    )
    right = rrb.Vertical(
        rrb.Horizontal(
            rrb.Spatial2DView(origin="pose_cells/activity", name="pose cells, x and y"),
            rrb.BarChartView(origin="pose_cells/heading", name="pose cells, heading"),
        ),
        rrb.Horizontal(
            rrb.Spatial2DView(origin="view", name="view"),
            rrb.Spatial3DView(origin="world/robot/head", name="whiskers", line_grid=False),
        ),
        rrb.TimeSeriesView(origin="health", name="health"),
    )
    return rrb.Blueprint(
        rrb.Horizontal(left, right, column_shares=[3, 2]),
        rrb.TimePanel(timeline="step", state="collapsed"),
        rrb.SelectionPanel(state="hidden"),
        rrb.BlueprintPanel(state="hidden"),
    )
