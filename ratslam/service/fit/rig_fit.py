"""A rig: the quantities found in a record, what a configuration includes of them, and both as text."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

from ratslam.runs.settings.includes import merge_settings
from ratslam.runs.settings.strict_yaml import dump_data
from ratslam.service.fit.wheel_fit import KEPT_SDS

HEADING = ("quantity", "assumed", "now", "+-", "unit", "setting")


class Quantity(NamedTuple):
    """A quantity of the rig.

    Attributes:
        name: in words. assumed: by the configuration; None where nothing is. value: found. sd: its standard
            deviation; None where it is exact or unknown. unit: as text. setting: path of the setting that
            takes the value; '' for none.
    """

    name: str
    assumed: float | None
    value: float
    sd: float | None
    unit: str
    setting: str = ""

    @property
    def differs(self) -> bool:
        """Whether the value is another one than that assumed, by `KEPT_SDS`."""
        if self.assumed is None or self.sd is None:
            return True
        return abs(self.value - self.assumed) > KEPT_SDS * self.sd


class Rig(NamedTuple):
    """What a record tells of a rig.

    Attributes:
        quantities: found. settings: further settings, nested. notes: what was found, in words. unknown: what
            this record does not tell, each with the reason.
    """

    quantities: tuple[Quantity, ...] = ()
    settings: dict[str, Any] = {}  # noqa: RUF012
    notes: tuple[str, ...] = ()
    unknown: tuple[str, ...] = ()


def join_rigs(rigs: Iterable[Rig]) -> Rig:
    """All parts as one rig."""
    parts = list(rigs)
    settings: dict[str, Any] = {}
    for part in parts:
        settings = merge_settings(settings, part.settings)
    return Rig(
        tuple(quantity for part in parts for quantity in part.quantities),
        settings,
        tuple(note for part in parts for note in part.notes),
        tuple(reason for part in parts for reason in part.unknown),
    )


def rig_settings(rig: Rig) -> dict[str, Any]:
    """The settings of a rig, nested, for a configuration to include; quantities within `KEPT_SDS` of what was
    assumed are left out."""
    settings = rig.settings
    for quantity in rig.quantities:
        if quantity.setting and quantity.differs:
            value: Any = float(f"{quantity.value:.6g}")
            for key in reversed(quantity.setting.split(".")):
                value = {key: value}
            settings = merge_settings(settings, value)
    return settings


def render_rig(rig: Rig) -> str:
    """The quantities as a table, with notes and what the record does not tell."""
    lines = aligned([HEADING, *map(_row, rig.quantities)]) if rig.quantities else []
    return "\n".join([*lines, *rig.notes, *(f"not determined: {reason}" for reason in rig.unknown)])


def rig_file(rig: Rig, record: str) -> str:
    """The file that a configuration includes: the settings, below the table as comments."""
    text = f"The rig from {record}, written by `python -m ratslam fit`.\n{render_rig(rig)}"
    comment = "\n".join(f"# {line}".rstrip() for line in text.splitlines())
    settings = rig_settings(rig)
    use = "# A configuration takes these settings, where it has none of its own, by `include: [FILE]`."
    if not settings:
        use = "# No setting differs from what was assumed: there is nothing to include."
    return f"{comment}\n{use}\n{dump_data(settings)}"


def _row(quantity: Quantity) -> Sequence[str]:
    assumed = "-" if quantity.assumed is None else f"{quantity.assumed:.4g}"
    sd = "-" if quantity.sd is None else f"{quantity.sd:.2g}"
    setting = quantity.setting and (
        quantity.setting if quantity.differs else f"unchanged, within {KEPT_SDS:g} sd"
    )
    return quantity.name, assumed, f"{quantity.value:.4g}", sd, quantity.unit, setting


def aligned(rows: Sequence[Sequence[str]]) -> list[str]:
    """Rows of cells as lines, in columns."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return ["  ".join(map(str.ljust, row, widths)).rstrip() for row in rows]
