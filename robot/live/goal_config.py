"""Settings of a session that drives to goals on a saved map."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, NonNegativeFloat, NonNegativeInt, PositiveFloat, PositiveInt

from tactile.base.settings import Settings

Point = tuple[float, float]


class GoalConfig(Settings):
    """Goals on a saved map. The head moves only along links between experiences, which were driven before."""

    map: Path
    """The map: a run directory or its `map.npz`."""
    to: Annotated[tuple[Point | NonNegativeInt, ...], Field(min_length=1)]
    """Goals in order: x, y in the map (m), or the number of an experience."""
    start: Literal["here", "unknown"] = "here"
    """Where the robot stands at first: where the map ended, or anywhere: then the head rests until its
    place is found, and if it is not, the session ends as lost."""
    at: tuple[float, float, float] | None = None
    """Where the arm begins: x, y (m) and heading (degrees), as `live.waypoints`. null: where the session of
    the map ended by the truth.tum beside it; without one, at the end of the path or of `live.waypoints`."""
    mode: Literal["time", "temporal"] = "time"
    """The way: `time` by least expected time, `temporal` by RatSLAM's goal temporal map."""
    farthest: PositiveFloat = 0.1
    """Largest distance of a goal, or of the robot, from the nearest experience, m."""
    tolerance: PositiveFloat = 0.02
    """Distance from the goal at which it is reached, by the estimate, m."""
    standoff: PositiveFloat = 0.045
    """Contacts nearer than this to the way ahead block it, m; less than half a corridor, whose walls are
    beside the way."""
    confirm: PositiveInt = 2
    """Consecutive whisks with such a contact after which the way counts as blocked; the head rests from the
    first one on."""
    off_way: PositiveFloat = 1.2
    """Distance of the estimate from the way above which a new way is planned, pose cells."""
    coast: NonNegativeFloat = 1.0
    """Way that the arm drives by its own motion while the method is lost and the contacts of the last whisks
    agree with the map, m; then the head rests."""
    patience: PositiveInt = 20
    """Consecutive whisks at rest without an estimate, or with one away from all experiences, after which the
    session is lost."""
    returns: NonNegativeInt = 2
    """Number of times that some of the way is driven back and again while the pose at a goal is not sure;
    then the session is lost."""
    replans: NonNegativeInt = 5
    """Number of new ways for a goal, after which it counts as blocked."""

    def resolved(self, folder: Path) -> GoalConfig:
        """A copy with a relative path of the map taken from the folder."""
        return self.model_copy(update={"map": folder / self.map})
