"""What stands on the page, and the file."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.artifacts.cameras import Camera
from pipeline.artifacts.dental.fdi import universal_number
from pipeline.artifacts.views import to_uint8
from pipeline.pages.page import write_page
from pipeline.pages.pictures import Picture, picture
from pipeline.pages.tables import Cell, Table, cell
from pipeline.studies.register.comparing import Comparison, Moved
from pipeline.studies.register.geometry import inverted
from pipeline.studies.register.movement import OPPOSITE, PARTS, words
from pipeline.studies.register.page.live import live_scenes
from pipeline.studies.register.visit import Visit, in_frame
from pipeline.studies.register.writing import FARTHEST, color_of, warning

Image = npt.NDArray[np.uint8]

PAGE = "register.html"
#: Arrows are so many times as long as the way.
ARROW = 4.0
#: Share of a tooth's colour in the picture.
TINT = 0.6


def write_register_page(found: Comparison, out: Path, live: bool = True) -> Path:
    """Write the page into a folder: both scenes to turn if `live`, else pictures alone."""
    certain = [tooth for tooth in found.teeth if tooth.certain]
    return write_page(
        "pipeline.studies.register.page", "register.html", out / PAGE,
        title=f"{found.first.name} and {found.second.name}", found=found, certain=certain,
        table=movement_table(found), scenes=scenes(found),
        live=live_scenes(found, shown_cameras(found.first)) if live else None,
        tinted=tinted(found),
        warning=warning(found),
        said=[(t.tooth, words(t.parts, t.half)) for t in certain], farthest=FARTHEST,
        faint=", ".join(str(t.tooth) for t in found.teeth if t.basis == "flow"),
        still=", ".join(map(str, found.still)), missing=", ".join(map(str, found.missing)),
    )  # fmt: skip


def movement_table(found: Comparison) -> Table:
    """Per tooth what it did, each figure with half of its 95 % interval."""
    head = ["tooth (FDI)", "Universal", "state", "distance mm", "turn °"]
    head += [f"{a} / {b} mm" for a, b in zip(PARTS[:3], OPPOSITE[:3], strict=True)]
    head += [f"{name} °" for name in PARTS[3:]]
    rows = [_row(tooth) for tooth in found.teeth]
    return Table(head, rows, caption="Bold: beyond the uncertainty.", sortable=True, stacked=True)


def _row(tooth: Moved) -> list[Cell]:
    state = "moved" if tooth.certain else "reference" if tooth.still else "not certain"
    row = [cell(tooth.tooth), Cell(universal_number(tooth.tooth)), Cell(state)]
    row += [_measure(*tooth.distance, 2, "", False), _measure(*tooth.angle, 1, "", False)]
    for k, (value, half) in enumerate(zip(tooth.parts, tooth.half, strict=True)):
        beyond = tooth.certain and abs(value) > half
        row.append(_measure(float(value), float(half), 2 if k < 3 else 1, "+", beyond))
    return row


def _measure(value: float, half: float, digits: int, sign: str, best: bool) -> Cell:
    return Cell(f"{value:{sign}z.{digits}f} ± {half:.{digits}f}", value, best)


def shown_cameras(visit: Visit) -> list[tuple[str, Camera]]:
    """A few of a visit's cameras, each after what its photograph is called: the first, the middle
    and the last from right to left."""
    order = sorted((look for look in visit.looks), key=lambda look: float(look.camera.centre[0]))
    picks = sorted({0, len(order) // 2, len(order) - 1})
    cameras = [order[k].camera for k in picks]
    return [(visit.labels.get(camera.name, camera.name), camera) for camera in cameras]


def scenes(found: Comparison) -> list[tuple[Picture, Picture]]:
    """Both scenes as the same cameras of the first visit see them."""
    if found.first.gaussians is None or found.second.gaussians is None:
        return []
    from stages.splatting.rendering import render

    result = []
    to_first = inverted(found.first.frame)
    to_second = inverted(found.first_from_second @ found.second.frame)
    for name, camera in shown_cameras(found.first):
        before, after = (
            to_uint8(np.clip(render(scene, in_frame(camera, back)).image, 0, 1))
            for scene, back in (
                (found.first.gaussians, to_first), (found.second.gaussians, to_second),
            )
        )  # fmt: skip
        result.append(
            (
                picture(before, f"The first visit's scene from the place of photograph {name}"),
                picture(after, f"The second visit's scene from the same place ({name})"),
            )
        )
    return result


def tinted(found: Comparison) -> list[Picture]:
    """Photographs of the first visit, teeth coloured by how far they went, with arrows."""
    by_name = {look.camera.name: look for look in found.first.looks}
    result = []
    for name, camera in shown_cameras(found.first):
        look = by_name[camera.name]
        image = np.repeat(look.image[..., None], 3, 2).astype(np.float64)
        for tooth in found.teeth:
            inside = look.labels == tooth.tooth
            image[inside] = (1 - TINT) * image[inside] + TINT * color_of(tooth) * np.clip(
                image[inside] + 0.25, 0, 1
            )
        drawn = to_uint8(np.clip(image, 0, 1))
        moved = [t for t in found.teeth if t.certain and (look.labels == t.tooth).any()]
        for tooth in moved:
            _arrow(drawn, tooth, camera)
        arrows = f"; arrows {ARROW:.0f} times as long" if moved else ""
        alt = f"Photograph {name} of the first visit, coloured by how far each tooth went"
        result.append(picture(drawn, alt, f"photograph {name}{arrows}"))
    return result


def _arrow(image: Image, tooth: Moved, camera: Camera) -> None:
    ends = np.stack([tooth.at, tooth.at + ARROW * tooth.displacement[:3]])
    pixels, depth = camera.project(ends)
    if (depth <= 0).any():
        return
    start, end = (tuple(int(v) for v in np.round(p)) for p in pixels)
    for color, width in (((255, 255, 255), 4), ((20, 40, 120), 2)):
        cv2.arrowedLine(image, start, end, color, width, cv2.LINE_AA, tipLength=0.3)
