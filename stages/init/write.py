"""Writing what the stage found: dense points, pointmaps, cameras with their scale."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from pipeline.artifacts.cameras import Cameras
from pipeline.artifacts.pictures import Pictures
from pipeline.artifacts.pointmaps import PointmapPair, Pointmaps
from pipeline.artifacts.points import Points
from pipeline.artifacts.space.scale import Scale, Source
from pipeline.artifacts.views import View, Views
from pipeline.errors import RequestError
from pipeline.stage import StageContext
from stages.dentition.working import outline_in_view
from stages.init.config import InitConfig
from stages.init.mouth import mouth_frame, primary_places, textbook_scale, tooth_places
from stages.init.scale import mm_per_unit, photo_named
from stages.init.sfm.matching.pictures import Links, match_pictures, match_table

if TYPE_CHECKING:
    from pipeline.artifacts.teeth import Teeth

Map = npt.NDArray[np.float32]
#: [2] pixel.
Place = npt.NDArray[np.float64]


def save_matches(context: StageContext, links: Links, most: int) -> None:
    """Write pictures of at most so many pairs, and `matches.json` with all of them."""
    context.save(Pictures(match_pictures(links, most)))
    text = json.dumps(match_table(links), indent=1)
    (context.output("pictures") / "matches.json").write_text(text + "\n")


def save_all(
    context: StageContext, views: Views, placed: tuple[View, ...], cameras: Cameras,
    depths: list[Map], points: Points, pairs: list[PointmapPair], teeth: Teeth | None = None,
) -> None:  # fmt: skip
    """Write the outputs, with the scale that is known.

    Args:
        views: all that the stage was given.
        placed: the views of the cameras; written too where their images or masks have changed.
        depths: z-depth [H, W] of each, to measure in.
        teeth: numbered by what placed the views; None: what was read is numbered by the depths.
    """
    config: InitConfig = context.config
    # points of a model alone have no depth to see a tooth at
    if teeth is None and context.has("teeth") and len(depths) == len(placed):
        teeth = _agreed(context, views, placed, cameras, depths)
    if teeth is not None:
        context.save(teeth)
        if cameras.mouth_from_world is None and len(depths) == len(placed):
            cameras = _with_mouth(teeth, placed, cameras, depths)
    if config.length.mm is not None:
        cameras = _scaled(context, views, placed, cameras, depths)
    elif config.dental.tooth_widths and cameras.scale.source != "tooth_widths":
        context.warn(
            "init.dental.tooth_widths is not used: it gives the scale where the teeth themselves "
            "place the photographs, which was not needed here. Give a length between two spots "
            "instead (init.length), such as that tooth's width."
        )
    context.save(cameras)
    context.save(points)
    context.save(Pointmaps(pairs))
    before = views.by_name()
    changed = {view.name: view for view in placed if _differs(view, before[view.name])}
    if changed:
        context.save(replace(views, views=tuple(changed.get(v.name, v) for v in views.views)))
    bent = sum(view.lens_taken_out != before[view.name].lens_taken_out for view in placed)
    if bent:
        context.summarize(undistorted=bent)
    focals = [camera.fx / max(camera.width, camera.height) for camera in cameras.cameras]
    context.summarize(
        views_registered=len(cameras), views_total=len(views),
        focal=round(float(np.median(focals)), 4), points=len(points),
    )  # fmt: skip


def _agreed(
    context: StageContext, views: Views, placed: tuple[View, ...], cameras: Cameras,
    depths: list[Map],
) -> Teeth | None:  # fmt: skip
    """The teeth with the numbers that the placed photographs agree on; None: there are none."""
    from stages.dentition.joint_numbers import agreed_numbers
    from stages.dentition.overlay import labelled_overlay
    from stages.init.dental.read import labelled_teeth

    read = labelled_teeth(context, views)
    if not read.chosen:
        return None
    teeth = agreed_numbers(read, placed, cameras.cameras, depths)
    seen, by_name = {view.name for view in placed}, views.by_name()
    by_name |= {v.name: v for v in placed if v.turned_over}
    drawn = {
        dentition.name: labelled_overlay(by_name[dentition.name].image, dentition)
        for dentition in teeth.chosen if dentition.name in seen
    }  # fmt: skip
    others = {name: read.pictures[name] for name in read.pictures if name not in drawn}
    numbers = {c.number for view in teeth.chosen if view.name in seen for c in view.all_crowns}
    context.summarize(teeth=len(numbers - {0}))
    return replace(teeth, pictures={**others, **drawn})


def _with_mouth(
    teeth: Teeth, placed: tuple[View, ...], cameras: Cameras, depths: list[Map]
) -> Cameras:
    """The cameras with what the numbered teeth say: how the mouth lies, and how large it is."""
    places = tooth_places(teeth, placed, cameras.cameras, depths)
    cameras = replace(cameras, mouth_from_world=mouth_frame(places))
    scale = textbook_scale(places, primary_places(teeth))
    # given cameras keep their own world
    if scale is None or cameras.given or cameras.scale.unit == "mm":
        return cameras
    return _in_millimetres(cameras, scale[0], "textbook_teeth", scale[1])


def _in_millimetres(cameras: Cameras, factor: float, source: Source, deviation: float) -> Cameras:
    """The cameras with `factor` millimetres per unit of our world."""
    before = np.cbrt(np.linalg.det(cameras.input_from_world[:3, :3]))
    input_from_world = np.diag([factor / before] * 3 + [1.0]) @ cameras.input_from_world
    scale = Scale("mm", source, round(100 * deviation, 2))
    return replace(cameras, input_from_world=input_from_world, scale=scale)


def _differs(view: View, before: View) -> bool:
    same = view.image is before.image and view.mask is before.mask
    return not same or view.focal_px != before.focal_px


def place_in(placed: View, view: View, pixel: Place) -> Place:
    """A pixel of a photograph as it was taken, in the picture that its camera belongs to."""
    if placed.turned_over:
        pixel = np.array([view.width - pixel[0], pixel[1]])
    if placed.lens_taken_out == view.lens_taken_out:
        return pixel
    return np.asarray(outline_in_view(pixel[None], (view.width, view.height), placed)[0])


def _scaled(
    context: StageContext, views: Views, placed: tuple[View, ...], cameras: Cameras,
    depths: list[Map],
) -> Cameras:  # fmt: skip
    """The cameras with the way to millimetres that the known length gives."""
    length = context.config.length
    assert length.mm is not None
    view = photo_named(views, length.photo)
    number = next((k for k, other in enumerate(placed) if other.name == view.name), None)
    if number is None:
        raise RequestError(
            f"init.length.photo: {length.photo} could not be placed, so that nothing can be "
            "measured in it. Name another photograph."
        )
    factor, deviation = mm_per_unit(
        view, cameras.cameras[number], depths[number], length.start, length.end, length.mm,
        lambda pixel: place_in(placed[number], view, pixel),
    )  # fmt: skip
    context.summarize(
        mm_per_unit=round(factor, 4), scale_uncertainty_percent=round(100 * deviation, 2)
    )
    return _in_millimetres(cameras, factor, "length", deviation)
