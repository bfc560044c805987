"""What a unit of length is worth, where that comes from, and how sure it is."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal, get_args

Unit = Literal["mm", "none"]
Source = Literal["length", "cameras", "tooth_widths", "textbook_teeth", "none"]

_SOURCES: dict[str, str] = {
    "length": "from the length that was given",
    "cameras": "as the cameras that were given say",
    "tooth_widths": "from the widths of teeth that were given",
    "textbook_teeth": "from the widths of textbook teeth",
}


@dataclass(frozen=True)
class Scale:
    """The scale of a scene.

    Attributes:
        unit: ``mm``, or ``none``: nothing can be measured.
        source: a given length (`init.length`), cameras whose file says millimetres, widths of
            teeth that the user gave, those of textbook teeth, or none that is known.
        uncertainty_percent: one standard deviation of all lengths together, in percent of them;
            None: not known, or there is no unit. It is that of the scale alone: how well two spots
            lie to each other is another matter.
    """

    unit: Unit = "none"
    source: Source = "none"
    uncertainty_percent: float | None = None

    @property
    def text(self) -> str:
        """The sentence that every place shows."""
        if self.unit == "none":
            return "Lengths have no unit: no scale is known, so nothing can be measured in them."
        if self.source not in _SOURCES:
            return "Lengths are in millimetres; where their scale comes from is not recorded."
        if self.uncertainty_percent is None:
            return (
                f"Lengths are in millimetres, {_SOURCES[self.source]}; how far these may be off is "
                "not known."
            )
        return (
            f"Lengths are in millimetres, {_SOURCES[self.source]}: \u00b1{self.percent} % (one "
            "standard deviation)."
        )

    @property
    def percent(self) -> str:
        """The uncertainty with two significant digits, for people."""
        return "unknown" if self.uncertainty_percent is None else f"{self.uncertainty_percent:.2g}"

    @property
    def short(self) -> str:
        """A few ASCII letters for headers of files: ``mm +-15% (textbook_teeth)``."""
        if self.unit == "none":
            return "no scale"
        sure = "" if self.uncertainty_percent is None else f" +-{self.percent}%"
        return f"mm{sure} ({self.source})"

    def as_dict(self) -> dict[str, Any]:
        """The record as files hold it."""
        return {
            "unit": self.unit,
            "source": self.source,
            "uncertainty_percent": self.uncertainty_percent,
            "text": self.text,
        }

    @classmethod
    def from_dict(cls, record: Mapping[str, Any]) -> Scale:
        """What `as_dict` gave; a value that is not known counts as none."""
        percent = record.get("uncertainty_percent")
        unit: Unit = "mm" if record.get("unit") == "mm" else "none"
        known: tuple[Source, ...] = get_args(Source)
        source: Source = next((name for name in known if name == record.get("source")), "none")
        return cls(unit, source, None if percent is None else float(percent))


#: Nothing is known.
NO_SCALE = Scale()


def said_by_cameras(units: str) -> Scale:
    """The scale of cameras that the user gave, by what their file says (``mm`` or another)."""
    return Scale("mm", "cameras") if units == "mm" else NO_SCALE
