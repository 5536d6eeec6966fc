"""Settings that have moved: configurations, run directories and maps with their old names still open."""

from __future__ import annotations

import copy

from ratslam.runs.settings.yaml_document import Document, KeyPath

TO_ATTRACTOR = (
    "excite_width", "excite_sigma", "inhibit_width", "inhibit_sigma", "global_inhibition", "settle_steps",
    "engine",
)  # fmt: skip
LEFT_RECALL = ("mode_decay", "miss_weight", "reach", "reach_heading", "modes", "energy")
MOVED: dict[str, str | None] = {
    **{f"pose_cells.{name}": f"attractor.{name}" for name in TO_ATTRACTOR},
    **dict.fromkeys(f"recall.{name}" for name in LEFT_RECALL),
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
