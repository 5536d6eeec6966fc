"""Nested settings by their dotted names."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from ratslam.runs.map_settings import flat_settings

NAMES = st.text("abc_", min_size=1, max_size=3)
SECTIONS = st.recursive(st.integers() | st.just({}), lambda inner: st.dictionaries(NAMES, inner, max_size=3))


@given(st.dictionaries(NAMES, SECTIONS, max_size=3))
def test_every_value_is_found_by_its_name(settings):
    for name, value in flat_settings(settings).items():
        assert value == {} or not isinstance(value, dict)
        at = settings
        for part in name.split("."):
            at = at[part]
        assert at == value


@given(st.dictionaries(NAMES, st.dictionaries(NAMES, st.integers(), max_size=3), max_size=3))
def test_no_value_is_left_out(settings):
    expected = sum(max(len(section), 1) for section in settings.values())
    assert len(flat_settings(settings)) == expected
