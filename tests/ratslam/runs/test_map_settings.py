"""Settings by which a map is refused, and those by which it is not."""

from __future__ import annotations

from ratslam.runs.map_settings import differing_settings
from ratslam.runs.settings.run_config import load_config


def test_a_map_goes_on_whether_or_not_its_keyframes_were_merged() -> None:
    """Maps of views say 0 where an earlier version wrote them."""
    now, before = (load_config("square", [f"keyframes.merge_stood={stood}"]) for stood in (4, 0))
    assert differing_settings([before, now]) == {}
    other = load_config("square", ["keyframes.min_length=3"])
    assert differing_settings([before, other]) == {"keyframes.min_length": [2, 3]}
