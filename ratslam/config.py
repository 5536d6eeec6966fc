"""The whole configuration of a run, each part kept beside the code it configures."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, NonNegativeInt

from evaluation.exm import ExmConfig
from ratslam.experience import ExperienceConfig
from ratslam.places import PlaceConfig
from ratslam.posecells import PoseCellConfig
from ratslam.rat import RatConfig
from ratslam.templates import TemplateConfig
from robot.formats import RecordingConfig
from tactile.settings import Settings


class SessionConfig(Settings):
    """How the engine runs."""

    precision: Literal["float64", "float32"] = "float64"
    """Of the kernel."""
    seed: NonNegativeInt = 0
    """Of every random stream."""
    reserve: Annotated[int, Field(ge=0, le=2**24)] = 0
    """Rows of memory made room for at the start; 0 grows as needed and compiles anew at each power of two."""


class ScoreConfig(Settings):
    """How a run is judged when truth is known."""

    experience_metric: ExmConfig = ExmConfig()
    """Of the Experience Metric."""
    relations: Path | None = None
    """Relative true poses to judge by (t1,t2,x,y,z,roll,pitch,yaw); none: all but these figures."""


class RunConfig(Settings):
    """A run: `python -m ratslam run config.yaml`."""

    recording: RecordingConfig
    """What to run on."""
    backend: Literal["rat"] = "rat"
    """The method."""
    pose_cells: PoseCellConfig = PoseCellConfig()
    """The attractor network."""
    templates: TemplateConfig = TemplateConfig()
    """View matching."""
    places: PlaceConfig = PlaceConfig()
    """When a place is made, reached or kept."""
    experience: ExperienceConfig = ExperienceConfig()
    """The map."""
    session: SessionConfig = SessionConfig()
    """Precision, seed and memory."""
    score: ScoreConfig = ScoreConfig()
    """Judgement."""

    def rat(self) -> RatConfig:
        """The rat backend's part."""
        return RatConfig(
            pose_cells=self.pose_cells,
            templates=self.templates,
            places=self.places,
            experience=self.experience,
        )
