"""A finished run as a visit: its photographs, cameras in millimetres, and teeth in 3D."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from shlex import quote
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.artifacts.cameras import Camera
from pipeline.artifacts.dental.sizes import TEXTBOOK_DEVIATION, millimetres_per_unit
from pipeline.artifacts.gaussians import Gaussians
from pipeline.artifacts.space.scale import UNSAID_PERCENT
from pipeline.errors import RequestError
from pipeline.geometry.world import move_camera
from pipeline.pages.case import Case
from pipeline.store import Store
from pipeline.studies.register.pictures.hardware import painted_over
from pipeline.studies.register.pictures.originals import larger_photographs

Array = npt.NDArray[np.float64]
Floats = npt.NDArray[np.float32]
Labels = npt.NDArray[np.uint8]

#: Where the scene is more transparent than this it has no depth.
LEAST_ALPHA = 0.5
#: A tooth is known in 3D from this many pixels on.
LEAST_PIXELS = 40
#: Share of a tooth's points, by depth, that may be off: what outlines take in beside the tooth.
TRIMMED = 0.04


@dataclass(frozen=True)
class Look:
    """One photograph of a visit.

    Attributes:
        camera: in the frame of its visit, mm.
        image: [H, W] float32 grey, 0..1.
        labels: [H, W] uint8 FDI number of the crown at each pixel, 0: none.
        depth: [H, W] float32 z of the scene, mm; 0 where it is not known.
        valid: [H, W] bool, where the photograph may be used.
        hardware: [H, W] bool, brackets and wires; None: there are no braces.
        larger: [H', W'] float32 `image` with more pixels, where the photograph has them and is at
            hand; None: it does not.
    """

    camera: Camera
    image: Floats
    labels: Labels
    depth: Floats
    valid: npt.NDArray[np.bool_]
    hardware: npt.NDArray[np.bool_] | None = None
    larger: Floats | None = None

    @property
    def enamel(self) -> Labels:
        """[H, W] `labels`, 0 on hardware."""
        if self.hardware is None:
            return self.labels
        return np.where(self.hardware, 0, self.labels).astype(np.uint8)

    @property
    def density(self) -> float:
        """Pixels per mm on the crowns; 0 where no depth is known."""
        depth = self.depth[(self.labels > 0) & (self.depth > 0)]
        return self.camera.fx / float(np.median(depth)) if len(depth) else 0.0

    @property
    def without_hardware(self) -> Floats:
        """[H, W] `image` with enamel painted over hardware."""
        if self.hardware is None:
            return self.image
        return painted_over(self.image, self.hardware, self.enamel > 0, self.density)

    @cached_property
    def points(self) -> Array:
        """[H, W, 3] what each pixel sees, mm; meaningless where depth is 0."""
        return self.camera.unproject(self.depth)

    def points_at(self, where: npt.NDArray[np.bool_]) -> Array:
        """[N, 3] what pixels see, mm, of those marked in [H, W]."""
        row, column = np.nonzero(where)
        z = self.depth[row, column].astype(np.float64)
        x = (column + 0.5 - self.camera.cx) / self.camera.fx * z
        y = (row + 0.5 - self.camera.cy) / self.camera.fy * z
        local = np.stack([x, y, z], -1) - self.camera.translation
        return np.asarray(local @ self.camera.rotation)

    @property
    def enlarged(self) -> Look:
        """The photograph with all the pixels that are at hand."""
        if self.larger is None:
            return self
        size = self.larger.shape[1], self.larger.shape[0]

        def nearest(pixels: npt.NDArray[Any]) -> npt.NDArray[Any]:
            kept = cv2.resize(pixels.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST)
            return np.asarray(kept).astype(pixels.dtype)

        depth = cv2.resize(self.depth, size, interpolation=cv2.INTER_LINEAR)
        return replace(
            self, camera=self.camera.resized(*size), image=self.larger, larger=None,
            labels=nearest(self.labels), valid=nearest(self.valid),
            depth=np.where(nearest(self.depth > 0), depth, 0).astype(np.float32),
            hardware=None if self.hardware is None else nearest(self.hardware),
        )  # fmt: skip


@dataclass(frozen=True)
class Visit:
    """A visit.

    Attributes:
        name: for messages.
        looks: photographs with cameras and teeth, in the order of the run.
        teeth: FDI number -> [N, 3] points of its crown's enamel, mm.
        scale_percent: relative standard deviation of its millimetres, percent; None: not known.
        scale_source: where millimetres come from, in words.
        gaussians: the scene, in the run's own world; None in tests.
        frame: [4, 4] similarity from that world to this frame.
        covered: FDI number -> [3] middle of a crown with the hardware on it; none without braces.
        files: hash -> name of each file that its photographs were read from.
        labels: how pages call its photographs, by their names.
        lost: files of photographs that have more pixels, and are not as the run read them.
        changed: what of its files has changed since the run, in words, such as a `teeth.yaml`.
    """

    name: str
    looks: tuple[Look, ...]
    teeth: Mapping[int, Array]
    scale_percent: float | None = None
    scale_source: str = ""
    gaussians: Gaussians | None = None
    frame: Array = field(default_factory=lambda: np.eye(4))
    covered: Mapping[int, Array] = field(default_factory=dict)
    files: Mapping[str, str] = field(default_factory=dict)
    labels: Mapping[str, str] = field(default_factory=dict)
    lost: tuple[str, ...] = ()
    changed: tuple[str, ...] = ()

    @property
    def scale_doubt(self) -> float:
        """`scale_percent` to compare visits by."""
        return UNSAID_PERCENT if self.scale_percent is None else self.scale_percent

    def in_frame(self, frame: Array) -> Visit:
        """The visit in a frame that a similarity [4, 4] leads to."""
        scale = scale_of(frame)
        return replace(
            self,
            looks=tuple(
                replace(
                    look, camera=in_frame(look.camera, frame),
                    depth=(look.depth * scale).astype(np.float32),
                ) for look in self.looks
            ),
            teeth={n: p @ frame[:3, :3].T + frame[:3, 3] for n, p in self.teeth.items()},
            frame=frame @ self.frame,
            covered={n: frame[:3, :3] @ p + frame[:3, 3] for n, p in self.covered.items()},
        )  # fmt: skip

    @cached_property
    def centres(self) -> dict[int, Array]:
        """FDI number -> [3] middle of what is seen of the crown, mm."""
        middles = {number: np.median(points, axis=0) for number, points in self.teeth.items()}
        return middles | dict(self.covered)


def read_visit(workspace: Path) -> Visit:
    """Read a finished run.

    Raises:
        RequestError: no run, an unfinished one, one that was begun anew, or one without teeth.
    """
    from pipeline.studies.report.reading import read_case, renewed
    from stages.dentition.working import labels_in_view
    from stages.splatting.rendering import Painter
    from stages.views.find import MASK_PREFIX

    case = read_case(workspace)
    if case.failed is not None:
        raise RequestError(
            f"{workspace}: the run ended in {case.failed.name} and has no scene to compare. "
            f"What says why: pipeline status -w {quote(str(workspace))}"
        )
    views, cameras, gaussians, teeth = (
        case.latest(kind) for kind in ("views", "cameras", "gaussians", "teeth")
    )
    for made, stage in ((views, "views"), (teeth, "teeth"), (cameras, "init"), (gaussians, "fit")):
        if made is None:
            raise RequestError(
                f"{workspace} holds no result of the stage '{stage}': finish the run first "
                f"(pipeline run -w {quote(str(workspace))})."
            )
    fitted = case.by_name[case.providers("gaussians")[-1]].result
    if fitted and (other := renewed(Store(workspace), fitted)):
        raise RequestError(
            f"{workspace}: its scene was made from another result of '{other}' than there is now. "
            f"Run the pipeline to its end first: pipeline run -w {quote(str(workspace))}"
        )
    frame = np.asarray(cameras.input_from_world, np.float64)
    read, by_name = teeth.by_name(), views.by_name()
    larger, lost = larger_photographs(case, views.views)
    paint, looks, pictures = Painter(gaussians), [], []
    for camera in cameras.cameras:
        dentition = read.get(camera.name)
        view = by_name.get(camera.name)
        if dentition is None or view is None or dentition.set_aside:
            continue
        rendered = paint(camera)
        known = (rendered.alpha >= LEAST_ALPHA) & (rendered.depth > 0)
        numbers = [crown.number for crown in dentition.all_crowns]
        labels = labels_in_view(dentition, view, numbers).astype(np.uint8)
        pictures.append(view.image)
        looks.append(
            Look(
                camera, cv2.cvtColor(view.image, cv2.COLOR_RGB2GRAY), labels,
                np.where(known, rendered.depth, 0).astype(np.float32), view.valid(),
                larger=larger.get(camera.name),
            )
        )  # fmt: skip
    points = teeth_points(looks)
    if len(points) < 2:
        raise RequestError(
            f"{workspace}: no numbered teeth were found in the photographs that were placed; "
            "visits are compared by their teeth."
        )
    percent, source = cameras.scale.uncertainty_percent, SOURCES.get(cameras.scale.source, "")
    if cameras.scale.unit != "mm":
        middles = {n: np.median(p, axis=0) for n, p in points.items()}
        frame = np.diag([textbook_scale(middles)] * 3 + [1.0])
        percent, source = 100 * TEXTBOOK_DEVIATION, SOURCES["textbook_teeth"]
    read_from = case.by_name["views"].manifest["key_material"]["sources"]
    files = {hashed: name for name, hashed in read_from if not name.startswith(MASK_PREFIX)}
    made = Visit(
        workspace.resolve().name, tuple(looks), points, 1.0, "", gaussians, files=files,
        labels=case.labels, lost=lost, changed=_changed(case),
    )  # fmt: skip
    made = made.in_frame(frame)
    made = without_braces(made, pictures)
    return replace(made, scale_percent=percent, scale_source=source)


def names_of(workspaces: Sequence[Path]) -> list[str]:
    """What visits are called: their folders, with those above where these are called alike."""
    ways = [workspace.resolve().parts for workspace in workspaces]
    for depth in range(1, max(map(len, ways)) + 1):
        names = ["/".join(way[-depth:]) for way in ways]
        if len({*names}) == len({*ways}):
            break
    return names


def warning_of(first: Visit, second: Visit) -> str:
    """What has to be known of the photographs of two visits; mostly nothing.

    Of photographs that both hold it comes out that nothing moved. Of such as can't be read again
    turns are measured in the smaller pictures of the run. What a person has put right since a run
    is not in it.
    """
    said = [
        f"'{visit.name}' was run before this: {'; '.join(visit.changed)}. It is not in the "
        "figures. Run the pipeline there again first."
        for visit in (first, second)
        if visit.changed
    ]
    shared = [name for hashed, name in first.files.items() if hashed in second.files]
    if shared:
        said.append(
            f"Both runs are of {_some(shared)}, byte for byte: what these photographs show did not "
            "move. If one came into the wrong folder, take it out and run that visit again."
        )
    said += [
        f"{_some(visit.lost)} of '{visit.name}' can't be read where the run read them, or have "
        "changed, so their smaller pictures of the run are compared: turns come out less exactly."
        for visit in (first, second)
        if visit.lost
    ]
    return " ".join(said)


def _changed(case: Case) -> tuple[str, ...]:
    """What of the files of a scene has changed since it was made."""
    made = case.by_name[case.providers("gaussians")[-1]]
    until = case.stages[: case.stages.index(made) + 1]
    reasons = (r for stage in until if stage.state == "stale" for r in stage.reasons)
    return tuple(dict.fromkeys(r for r in reasons if r.startswith("input file")))


def _some(names: Sequence[str]) -> str:
    return ", ".join(names[:4]) + (f" and {len(names) - 4} more" if len(names) > 4 else "")


def without_braces(visit: Visit, pictures: Sequence[Floats]) -> Visit:
    """The visit with its brackets and wires told, if it has some: they belong to no crown.

    Args:
        visit: in mm.
        pictures: [H, W, 3] float32 sRGB in 0..1 of each of its photographs.
    """
    from stages.init.dental.surface.photos.braces import braces_in

    crowns, densities = [k.labels > 0 for k in visit.looks], [k.density for k in visit.looks]
    found = braces_in(pictures, crowns, densities)
    if found is None:
        return visit
    looks = tuple(replace(k, hardware=h) for k, h in zip(visit.looks, found, strict=True))
    return replace(visit, looks=looks, teeth=teeth_points(looks), covered=visit.centres)


#: Where a run's millimetres come from, in words, by `Scale.source`.
SOURCES = {
    "length": "a given length",
    "cameras": "the cameras that were given",
    "tooth_widths": "widths of teeth that were given",
    "textbook_teeth": "textbook teeth",
    "none": "the run, which does not say from where",
}


def textbook_scale(centres: Mapping[int, Array]) -> float:
    """Millimetres per unit, if neighbouring crowns are as far apart as the textbook's.

    Args:
        centres: FDI number -> [3] centre of the crown, in any unit.

    Raises:
        RequestError: no two neighbours.
    """
    found = millimetres_per_unit(centres)
    if found is None:
        raise RequestError(
            "no two neighbouring teeth are known, so nothing says how large they are"
        )
    return found


def scale_of(frame: Array) -> float:
    """Millimetres per unit of a similarity [4, 4]."""
    return float(np.cbrt(np.linalg.det(frame[:3, :3])))


def in_frame(camera: Camera, frame: Array) -> Camera:
    """The camera in a frame that a similarity [4, 4] leads to; depths scale with it."""
    scale = scale_of(frame)
    return move_camera(camera, (scale, frame[:3, :3] / scale, frame[:3, 3]))


def teeth_points(looks: list[Look] | tuple[Look, ...]) -> dict[int, Array]:
    """FDI number -> [N, 3] points inside its outlines of all photographs, without stray ones."""
    found: dict[int, list[Array]] = {}
    for look in looks:
        enamel = look.enamel
        for number in (int(n) for n in np.unique(enamel) if n):
            inner = cv2.erode((enamel == number).astype(np.uint8), np.ones((3, 3), np.uint8))
            inside = (inner > 0) & (look.depth > 0)
            if inside.sum() >= LEAST_PIXELS:
                found.setdefault(number, []).append(look.points[inside])
    teeth = {}
    for number, parts in sorted(found.items()):
        # A photograph that gave the number to another tooth, or none, is outvoted.
        middles = np.array([np.median(part, axis=0) for part in parts])
        middle = np.median(middles, axis=0)
        kept = [p for p, m in zip(parts, middles, strict=True) if np.linalg.norm(m - middle) < 5]
        if not kept:
            continue
        points = np.concatenate(kept)
        away = np.linalg.norm(points - np.median(points, axis=0), axis=1)
        teeth[number] = points[away <= np.quantile(away, 1 - TRIMMED)]
    return teeth
