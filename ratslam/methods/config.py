"""The sections of a configuration that each method reads; `RunConfig` inherits all of them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, PositiveFloat

from ratslam.classic.config import AttractorConfig
from ratslam.classic.experience_map import ExperienceConfig, PlaceConfig
from ratslam.classic.view_templates import TemplateConfig
from ratslam.grid.config import GridConfig
from ratslam.mapping.config import KeyframeMapConfig
from ratslam.network.config import PoseCellConfig
from ratslam.recall.config import RecallConfig
from tactile.base.settings import Settings

Start = Literal["here", "unknown"]
"""Where a session begins in a finished map: where the map ended, or anywhere."""


class PoseCellBackendConfig(Settings):
    """Sections common to the methods with pose cells."""

    pose_cells: PoseCellConfig = PoseCellConfig()
    """The pose cells: a torus over x, y and heading."""
    templates: TemplateConfig = TemplateConfig()
    """View preprocessing and, for `backend: classic`, view matching."""
    experience: ExperienceConfig = ExperienceConfig()
    """The experience map of `backend: classic`; `closures` holds for `backend: recall` too."""


class ClassicBackendConfig(PoseCellBackendConfig):
    """Sections of `backend: classic`."""

    attractor: AttractorConfig = AttractorConfig()
    """The attractor network that moves the packet of activity."""
    places: PlaceConfig = PlaceConfig()
    """When a place is created, reached or kept."""


class RecallBackendConfig(PoseCellBackendConfig):
    """Sections of `backend: recall`."""

    recall: RecallConfig = RecallConfig()
    """View cells, and what they tell the pose cells."""
    keyframes: KeyframeMapConfig = KeyframeMapConfig()
    """The keyframe map."""
    min_fit_share: Annotated[float, Field(ge=0, le=1)] = 0.25
    """Share of fitting revisits below which the robot is reported lost (see `RecallEvidence.health`)."""


class LocaliseConfig(Settings):
    """Localisation in a finished map."""

    map: Path | None = None
    """The map: a file map.npz; `python -m ratslam localise` sets it."""
    log_odds: PositiveFloat | None = None
    """Log-odds at which a pose is found, beyond the logarithm of the number of places in the map. By default
    7.5 in a map of `backend: recall`, and 15 in one of `backend: grid`."""
    particles: Annotated[int, Field(ge=100, le=1_000_000)] = 20_000
    """Number of supposed poses in a map of `backend: grid`."""
    start: Start = "unknown"
    """Where the robot stands at first: `here`, where the map ended, which is believed until what is seen
    contradicts it, or anywhere."""


class LocaliseBackendConfig(RecallBackendConfig):
    """Sections of `backend: localise`: those that the map was made with, and its file."""

    localise: LocaliseConfig = LocaliseConfig()
    """Localisation in a finished map."""


class GridBackendConfig(Settings):
    """Sections of `backend: grid`."""

    grid: GridConfig = GridConfig()
    """The grid particle filter."""


class GridLocaliseBackendConfig(GridBackendConfig):
    """Sections of `backend: localise_grid`: those that the map was made with, and its file."""

    localise: LocaliseConfig = LocaliseConfig()
    """Localisation in a finished map."""
