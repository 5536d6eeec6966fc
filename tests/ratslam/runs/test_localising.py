"""Maps in which nothing can be localised are refused with the reason and the cure."""

from __future__ import annotations

from pathlib import Path

import pytest

from ratslam.methods.method_registry import LOCALISING
from ratslam.runs.localise import localising
from ratslam.runs.saved_map import FORMAT, SavedMap
from ratslam.runs.settings.run_config import LoopConfig
from robot.sources.source import SourceDescription
from tactile.base.errors import InputError


def map_of(backend):
    """A map file of a method, without its arrays."""
    config = LoopConfig.model_validate({"backend": backend})
    return SavedMap(Path("map.npz"), FORMAT, "", config, SourceDescription((1, 36, 1), 0, 10.0), "", {})


@pytest.mark.parametrize(
    ("backend", "reason"), [("localise_grid", "a session in another map"), ("classic", "classic")]
)
def test_other_methods_are_refused_with_the_cure(backend, reason):
    saved = map_of(backend)
    with pytest.raises(InputError, match=reason) as error:
        localising(saved.config, saved)
    assert "map the place again with `backend: recall`" in str(error.value)


@pytest.mark.parametrize(("backend", "method"), LOCALISING.items())
def test_other_maps_are_not_refused(backend, method):
    saved = map_of(backend)
    assert localising(saved.config, saved).backend == method
