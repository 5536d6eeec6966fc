"""Settings that have moved: configurations, run directories and maps with their old names still open."""

from __future__ import annotations

import copy

from ratslam.runs.settings.yaml_document import Document, KeyPath

MOVED: dict[str, str | None] = {
    "pose_cells.excite_width": "attractor.excite_width",
    "pose_cells.excite_sigma": "attractor.excite_sigma",
    "pose_cells.inhibit_width": "attractor.inhibit_width",
    "pose_cells.inhibit_sigma": "attractor.inhibit_sigma",
    "pose_cells.global_inhibition": "attractor.global_inhibition",
    "pose_cells.settle_steps": "attractor.settle_steps",
    "pose_cells.engine": "attractor.engine",
    "recall.mode_decay": None,
    "recall.miss_weight": None,
    "recall.reach": None,
    "recall.reach_heading": None,
    "recall.modes": None,
    "recall.energy": None,
}
"""Old dotted path of a setting to the new one; None: the pose cells have no such setting."""


def with_moved_settings(document: Document) -> Document:
    """A configuration with the settings of `MOVED` under their new names, at the places of the old ones.

    A value that stands under the new name stays. Settings without a new name are left out of what the program
    wrote, which has all of them; a user's own are unknown keys.
    """
    data, places = copy.deepcopy(document.data), dict(document.places)
    paths: dict[KeyPath, KeyPath | None] = {
        tuple(old.split(".")): None if new is None else tuple(new.split(".")) for old, new in MOVED.items()
    }
    written = all(old in places for old, new in paths.items() if new is None)
    for old, new in paths.items():
        if old not in places or (new is None and not written):
            continue
        section = {} if new is None else data.setdefault(str(new[0]), {})
        if not isinstance(section, dict):
            continue
        value, place = data[str(old[0])].pop(old[1]), places.pop(old)
        if new is not None:
            section.setdefault(new[1], value)
            places.setdefault(new[:1], place)
            places.setdefault(new, place)
    return Document(data, places)
