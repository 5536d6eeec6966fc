"""Changes between a map and a session localised in it: the file changes.csv."""

from __future__ import annotations

from collections.abc import Sequence

from evaluation.artifacts.change_table import NAME, ChangeRow, write_changes
from ratslam.core.backend import Map
from ratslam.places.change import Change
from ratslam.places.localiser import Localiser
from ratslam.places.session_changes import Touch, session_changes
from ratslam.runs.run_directory import RunDirectory
from tactile.frontend import TouchConfig
from tactile.whiskers.head_geometry import ur10_head


def save_changes(map: Map, config: TouchConfig, directory: RunDirectory) -> None:
    """Writes changes.csv of a session that was localised in a map."""
    if isinstance(map, Localiser):
        rows = change_rows(map, changes_of(map, config))
        directory.file(NAME, lambda path: write_changes(path, rows))


def changes_of(localiser: Localiser, config: TouchConfig) -> list[Change]:
    """The places at which a localised session does not agree with its map, the surest first."""
    touch = Touch(ur10_head(config.head), config.image.tallest)
    return session_changes(localiser.place, localiser.visits(), touch)


def change_rows(localiser: Localiser, changes: Sequence[Change]) -> list[ChangeRow]:
    """The lines of changes.csv."""
    steps = localiser.visits().step
    return [
        ChangeRow(
            x=float(change.position[0]),
            y=float(change.position[1]),
            extent=change.extent,
            kind=change.kind,
            evidence=change.evidence,
            alarms=change.alarms,
            passes=change.passes,
            first_step=int(steps[change.keyframes[0]]),
            last_step=int(steps[change.keyframes[-1]]),
        )
        for change in changes
    ]
