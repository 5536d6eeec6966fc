"""The tactile front end: from readings of a whisker head to observations for a SLAM backend."""

from __future__ import annotations

import numpy as np

from tactile.base.errors import InputError
from tactile.base.plugins import PluginConfig
from tactile.base.settings import Settings
from tactile.base.types import Cycle, Observation, Report, Whisk
from tactile.calibration import Calibration, RestBaseline, RestBaselineConfig, follow_baseline
from tactile.contact_threshold import ContactConfig, detect_contacts
from tactile.pokes import PokeConfig, image_depths, poke_points
from tactile.wall_estimation.report_frontend import ReportFrontendConfig
from tactile.whisker_geometry import HeadConfig, image_points, ur10_head
from tactile.whisker_image import ImageConfig, view_shape, whisk_observation


class TouchConfig(Settings):
    """Settings of the tactile front end."""

    head: HeadConfig = HeadConfig()
    """The whisker head; a recording's own head replaces settings that are not given here."""
    contact: ContactConfig = ContactConfig()
    """Contact detection."""
    baseline: RestBaselineConfig | None = RestBaselineConfig()
    """Tracking of the whiskers' baselines; none keeps those of the calibration."""
    image: ImageConfig = ImageConfig()
    """Whisker image."""
    pokes: PokeConfig = PokeConfig()
    """Pokes of an arm without a whisker head."""
    reports: ReportFrontendConfig = ReportFrontendConfig()
    """Front end of a Create's reports: contacts and wall directions."""
    frontend: PluginConfig | None = None
    """A registered front end (`ratslam.touch`) in place of ours."""


def touched_points(config: TouchConfig, image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where touch images [..., D] met something: points [..., D, 2] in base_link, m, and [..., D] bool, there
    is one. An image has a pixel per whisker of the head, or per poke of an arm without one."""
    if np.shape(image)[-1] == config.pokes.directions:
        depth, there = image_depths(config.pokes, image)
        return poke_points(config.pokes, depth), there
    return image_points(ur10_head(config.head), image, config.image.tallest)


def has_points(config: TouchConfig, pixels: int) -> bool:
    """Whether images of so many pixels are touch images of this configuration."""
    return pixels in (config.pokes.directions, len(ur10_head(config.head).length))


class Frontend:
    """Turns readings of a whisker head into observations, in the order of the readings and each once.

    Between readings it remembers the whiskers' baselines.

    Args:
        calibration: of the head; needed for raw readings.

    Attributes:
        view_shape: shape of the views. whiskers: W. baseline: of the whiskers, as last followed.
    """

    def __init__(self, config: TouchConfig, calibration: Calibration | None = None) -> None:
        self.config, self.calibration = config, calibration
        self.head = ur10_head(config.head)
        self.view_shape = view_shape(config.image, self.head)
        self.whiskers = len(self.head.length)
        self.baseline = RestBaseline(np.zeros((self.whiskers, 2)), np.zeros(self.whiskers, int))

    def features(self, reading: Cycle | Whisk) -> Whisk:
        """The contact features of a reading; whiskers configured as dead or found bent are not alive.

        Raises:
            InputError: raw samples without a calibration, or with gaps.
        """
        if isinstance(reading, Cycle):
            if self.calibration is None:
                found = "raw whisker samples without a calibration"
                raise InputError("calibration", found, "a free-whisking record")
            here, config = self.calibration, self.config.baseline
            if config is not None:
                self.baseline = follow_baseline(config, here, self.baseline, reading)
                alive = here.alive & (self.baseline.away < config.bent_cycles)
                here = here._replace(mean=here.mean + self.baseline.offset, alive=alive)
            reading = detect_contacts(self.config.contact, here, reading)
        alive = reading.alive & self.head.alive
        return reading._replace(alive=alive, contact=reading.contact & alive, held=reading.held & alive)

    def observe(self, reading: Observation | Cycle | Whisk | Report) -> Observation:
        """The observation of a reading; an `Observation` is returned unchanged.

        Raises:
            InputError: a report of the Create (see `wall_estimation.report_frontend`).
        """
        if isinstance(reading, Observation):
            return reading
        if isinstance(reading, Report):
            raise InputError("recording.file", "reports of a Create", "whisk cycles of a head")
        return whisk_observation(self.config.image, self.head, self.features(reading))

    def arrays(self) -> dict[str, np.ndarray]:
        """The baselines of the whiskers, for a checkpoint."""
        return self.baseline._asdict()

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        """Replaces the baselines by those of `arrays`."""
        self.baseline = RestBaseline(**{name: arrays[name] for name in RestBaseline._fields})
