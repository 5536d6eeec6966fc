"""The sense of touch as a whole: from what a head reports to what an engine is given."""

from __future__ import annotations

from tactile.base.config import Settings
from tactile.base.errors import InputError
from tactile.base.types import Cycle, Observation, Report, Whisk
from tactile.features.calibration import Calibration
from tactile.features.contact import ContactConfig, detect_contacts
from tactile.features.whisker_image import ImageConfig, view_shape, whisk_observation
from tactile.wall_estimation.report_frontend import ReportFrontendConfig
from tactile.whiskers.head_geometry import HeadConfig, ur10_head


class TouchConfig(Settings):
    """How touch is sensed."""

    head: HeadConfig = HeadConfig()
    """The whiskers; a recording that knows its own goes before what is not set here."""
    contact: ContactConfig = ContactConfig()
    """From raw samples to contacts."""
    image: ImageConfig = ImageConfig()
    """From contacts to a view."""
    reports: ReportFrontendConfig = ReportFrontendConfig()
    """Of a Create: from reports of its steps to contacts and walls."""


class Frontend:
    """Turns readings of whiskers into observations, each for itself.

    Args:
        calibration: of the head, for raw readings.

    Attributes:
        view_shape: of the views. whiskers: W.
    """

    def __init__(self, config: TouchConfig, calibration: Calibration | None = None) -> None:
        self.config, self.calibration = config, calibration
        self.head = ur10_head(config.head)
        self.view_shape = view_shape(config.image, self.head)
        self.whiskers = len(self.head.length)

    def features(self, reading: Cycle | Whisk) -> Whisk:
        """What each whisker felt; a whisker that the head's configuration calls dead does not report.

        Raises:
            InputError: raw samples without a calibration, or that cannot be used.
        """
        if isinstance(reading, Cycle):
            if self.calibration is None:
                raise InputError(
                    "calibration", "raw whisker samples without one", "a record of free whisking with them"
                )
            reading = detect_contacts(self.config.contact, self.calibration, reading)
        alive = reading.alive & self.head.alive
        return reading._replace(alive=alive, contact=reading.contact & alive, held=reading.held & alive)

    def observe(self, reading: Observation | Cycle | Whisk | Report) -> Observation:
        """What an engine is given; an observation stays as it is.

        Raises:
            InputError: the report of another robot.
        """
        if isinstance(reading, Observation):
            return reading
        if isinstance(reading, Report):
            raise InputError("recording.file", "reports of a Create", "whisk cycles of a head")
        return whisk_observation(self.config.image, self.head, self.features(reading))
