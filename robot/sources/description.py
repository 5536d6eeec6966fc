"""Description of readings that the caller brings, such as those of a robot or a simulator of one's own."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import ClassVar

from robot.sources.source import ClosedSource, Sample, Source
from robot.sources.source_info import SourceInfo
from tactile.base.bounded import SPOILT, reason
from tactile.base.errors import InputError


@dataclass(frozen=True)
class SourceDescription(ClosedSource):
    """A `Source` without samples: it only says what the readings are like.

    Attributes:
        view_shape: (R, C, K) of every view, seen or masked.
        whiskers: W, 0 for cameras, lasers and given labels.
        rate_hz: readings per second; 0 if unknown.
        info: devices, world and origin. name: short name for reports.

    Raises:
        InputError: a size is not positive, or the number of whiskers or the rate is negative.
    """

    view_shape: tuple[int, int, int]
    whiskers: int = 0
    rate_hz: float = 0.0
    info: SourceInfo = field(default_factory=SourceInfo)
    name: str = "readings"
    length: ClassVar[int | None] = None
    digest: ClassVar[str] = ""

    def __post_init__(self) -> None:
        if len(self.view_shape) != 3 or min(self.view_shape) < 1:
            found = f"the view shape {tuple(self.view_shape)}"
            raise InputError("view_shape", found, "rows, columns and channels of at least 1")
        if self.whiskers < 0 or not self.rate_hz >= 0:
            raise InputError("whiskers, rate_hz", f"{self.whiskers}, {self.rate_hz}", "numbers from 0 on")

    def __iter__(self) -> Iterator[Sample]:
        return iter(())

    def to_json(self) -> str:
        """The description as a JSON document.

        Raises:
            TypeError, ValueError: a value in the provenance is not JSON, or a number in it is not finite.
        """
        content = {"view_shape": self.view_shape, "whiskers": self.whiskers, "rate_hz": self.rate_hz}
        return json.dumps(content | {"name": self.name, "info": json.loads(self.info.to_json())})

    @classmethod
    def from_json(cls, text: str) -> SourceDescription:
        """Raises `ValueError` for text that `to_json` cannot have written."""
        try:
            content = json.loads(text)
            rows, columns, channels = content.pop("view_shape")
            info = SourceInfo.model_validate(content.pop("info"))
            return cls(view_shape=(rows, columns, channels), info=info, **content)
        except SPOILT as error:
            raise ValueError(f"not a description of a source ({reason(error)})") from None


def describe(source: Source) -> SourceDescription:
    """The description of a source."""
    return SourceDescription(source.view_shape, source.whiskers, source.rate_hz, source.info, source.name)
