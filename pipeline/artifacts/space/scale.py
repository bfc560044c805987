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
    "none": "of which no source is recorded",
}
#: What counts where nothing says how sure millimetres are, as with cameras of other programs: surer
#: than textbook teeth (10 %), less so than a length that somebody has measured (1 %).
UNSAID_PERCENT = 5.0


@dataclass(frozen=True)
class Scale:
    """The scale of a scene.

    Attributes:
        unit: ``mm``, or ``none``: nothing can be measured. With a source it is known what a
            millimetre is, but the frame of the exports is in other units.
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
        if self.put_aside:
            return (
                "Lengths are in the reconstruction's own units, as the frame 'world' has them, so "
                "nothing can be measured in them; in the other frames they are in millimetres."
            )
        if self.unit == "none":
            return "Lengths have no unit: no scale is known, so nothing can be measured in them."
        said = f"Lengths are in millimetres, {_SOURCES[self.source]}"
        if self.uncertainty_percent is None:
            said += "; how far these may be off is not known, and taken to be"
        else:
            said += ":"
        return f"{said} \u00b1{self.counted_percent:.2g} % (one standard deviation)."

    @property
    def put_aside(self) -> bool:
        """Is a scale known that these lengths do not have?"""
        return self.unit == "none" and self.source != "none"

    @property
    def units(self) -> str:
        """``"mm"`` or ``"arbitrary"``."""
        return "mm" if self.unit == "mm" else "arbitrary"

    @property
    def counted_percent(self) -> float:
        """The uncertainty as it counts in what is measured: `UNSAID_PERCENT` where it is not
        known, none where there is no unit."""
        if self.unit == "none":
            return 0.0
        return UNSAID_PERCENT if self.uncertainty_percent is None else self.uncertainty_percent

    @property
    def short(self) -> str:
        """A few ASCII letters for headers of files: ``mm +-15% (textbook_teeth)``."""
        if self.unit == "none":
            return "no scale"
        percent = self.uncertainty_percent
        sure = "" if percent is None else f" +-{percent:.2g}%"
        return f"mm{sure} ({self.source})"

    def as_dict(self) -> dict[str, Any]:
        """The record as files hold it."""
        return {
            "unit": self.unit,
            "source": self.source,
            "uncertainty_percent": self.uncertainty_percent,
            "counted_percent": self.counted_percent,
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
