"""From the dental path's result to what the stage writes."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from pipeline.artifacts.cameras import Camera
from pipeline.artifacts.pictures import Pictures
from pipeline.artifacts.points import Points
from pipeline.artifacts.space.scale import Scale, Source
from pipeline.artifacts.teeth import Dentition
from pipeline.artifacts.teeth import Teeth as TeethArtifact
from pipeline.artifacts.views import View, Views
from pipeline.errors import ReconstructionError, RequestError
from pipeline.stage import StageContext
from stages.dentition.corrections import LEFT_OUT, SIDES, says_side
from stages.init.config import DentalConfig, InitConfig
from stages.init.dental.numbering.arch_options import ArchOptions
from stages.init.dental.read import (
    said_to_show,
    said_to_use,
    set_aside_reasons,
    teeth_to_place_by,
    turned_as_said,
)
from stages.init.dental.reconstruct import Reconstruction, as_sentence, reconstruct_teeth
from stages.init.dental.scale import scale_from_widths, width_doubts
from stages.init.dental.surface.options import SurfaceOptions
from stages.init.mouth import mouth_frame
from stages.init.place import photo_name, with_focals
from stages.init.placement import Placement
from stages.init.write import save_all

Map = npt.NDArray[np.float32]

#: Photographs of a sitting are taken within so many seconds: a patient's mostly within two minutes,
#: and the next one has sat down after ten.
_SITTING = 600.0
_DAY = 86400.0
#: Why a photograph without which the others agree is set aside.
MISFIT = "it does not fit the others, which agree without it"
#: Where fewer take part and there is no scene, it is said why others do not.
_COMPLETE = 3


def from_teeth(context: StageContext, views: Views) -> None:
    """Place the views by their teeth, and write what came out.

    Raises:
        ReconstructionError: no teeth, or a doubtful result, with labelled pictures.
        RequestError: the settings of `init.dental` don't fit the photographs.
    """
    config: InitConfig = context.config
    read = teeth_to_place_by(context, views)
    given, views = views, turned_as_said(context, views)
    ordered = config.dental.order is not None
    dentitions = chosen_dentitions(read, views, ordered)
    names = [photo_name(view) for view in views.views]
    try:
        teeth = reconstruct_teeth(
            list(views.views), names, dentitions, with_focals(views.views, config.focal),
            arch_options(context, views, dentitions), surface_options(config.dental),
            accept_doubtful=config.dental.accept_doubtful, threads=context.threads,
            progress=context.progress, kept=said_to_use(context, views),
            said=said_to_show(context, views),
        )  # fmt: skip
    except ReconstructionError as doubtful:
        kept = doubtful.artifacts.get("teeth")
        if isinstance(kept, TeethArtifact):
            doubtful.artifacts["teeth"] = updated(read, kept.views)
        aside = "" if ordered else set_aside_reasons(read, views)
        if aside and len(read.chosen) < _COMPLETE:
            raise ReconstructionError(
                f"{doubtful} {aside}. If one was set aside wrongly, say so in check.html.",
                doubtful.pictures, {"teeth": read, **doubtful.artifacts},
            ) from doubtful  # fmt: skip
        raise
    for doubt in (
        *left_out(names, teeth), *teeth.fit.doubts, *only_two(names, teeth),
        *in_another_light(names, teeth),
        *turned_back(names, teeth), *misnamed(names, teeth),
        *numbered_otherwise(teeth),
        *of_several_days(taking_part(views, teeth.dentitions)),
    ):  # fmt: skip
        context.warn(doubt)
    misfits = [
        replace(d, set_aside=MISFIT) for k in teeth.left_out if (d := dentitions[k]) is not None
    ]
    new = [*(d for d in teeth.dentitions if d is not None), *misfits]
    numbered = replace(updated(read, new), pictures=teeth.labelled)
    _write(context, given, teeth, numbered)


def chosen_dentitions(read: TeethArtifact, views: Views, ordered: bool) -> list[Dentition | None]:
    """View by view its crowns, None where it takes no part.

    Args:
        ordered: a person has said what each photograph shows: only what a person leaves out is set
            aside.
    """
    kept = read.chosen
    if ordered:
        kept = tuple(replace(d, set_aside="") for d in read.views if d.set_aside != LEFT_OUT)
    chosen = {dentition.name: dentition for dentition in kept}
    return [chosen.get(view.name) for view in views.views]


def taking_part(views: Views, dentitions: Sequence[Dentition | None]) -> list[View]:
    """The views whose crowns are used."""
    return [view for view, seen in zip(views.views, dentitions, strict=True) if seen is not None]


def updated(read: TeethArtifact, numbered: Iterable[Dentition]) -> TeethArtifact:
    """The teeth with some photographs' numbers replaced."""
    new = {dentition.name: dentition for dentition in numbered}
    return replace(read, views=tuple(new.get(view.name, view) for view in read.views), pictures={})


def only_two(names: list[str], teeth: Reconstruction) -> list[str]:
    """What to say where only a photograph from the front and one from a side are in the scene."""
    placed = [name for name, view in zip(names, teeth.fit.views, strict=True) if view is not None]
    if len(placed) > 2:
        return []
    return [
        f"The scene rests on two photographs alone ({' and '.join(placed)}): what a photograph of "
        "the other side would show is missing or seen from the front only, and that one of the "
        "two is a mirror image, or of another patient, shows less surely than with three. Add the "
        "other side if there is one."
    ]


def left_out(names: list[str], teeth: Reconstruction) -> list[str]:
    """What to say of photographs without which the others agree."""
    if not teeth.left_out:
        return []
    odd = " and ".join(names[k] for k in teeth.left_out)
    one = len(teeth.left_out) == 1
    why = " ".join(as_sentence(doubt, names) for doubt in teeth.reasons)
    return [
        f"{odd} {'does' if one else 'do'} not fit the others, which agree without "
        f"{'it' if one else 'them'}: left out. With {'it' if one else 'them'}: {why} If "
        f"{'it is' if one else 'they are'} to be used all the same, say so on the page check.html."
    ]


def turned_back(names: list[str], teeth: Reconstruction) -> list[str]:
    """What to say of photographs that were mirror images."""
    return [
        f"{names[k]} is a mirror image: the patient's right is on its left where the other "
        "photographs have it on theirs. It was turned over."
        for k in teeth.mirrored
    ]


def in_another_light(names: list[str], teeth: Reconstruction) -> list[str]:
    """What to say of a photograph whose colours alone would make it another patient's."""
    figures = teeth.fit.figures
    if not figures.get("same_mouth_one_light", 0.0) < 0 <= figures.get("same_mouth", 0.0):
        return []
    placed = [name for name, view in zip(names, teeth.fit.views, strict=True) if view is not None]
    odd = max(range(len(placed)), key=lambda k: figures[f"colour_{k}"])
    return [
        f"{placed[odd]} was taken in another light than the others, or with another white balance "
        "(phones choose one for each photograph). Teeth and gums agree in what that does not "
        "change; if it shows another patient all the same, leave it out. --set fit.exposure=true "
        "evens the colours out."
    ]


def numbered_otherwise(teeth: Reconstruction) -> list[str]:
    """What to say where other numbers of teeth that one photograph shows are nearly as good."""
    margin, wanted = teeth.fit.figures.get("numbers_margin", np.inf), ArchOptions.min_margin
    if margin >= wanted:
        return []
    return [
        f"Another numbering explains the photographs nearly as well (margin {margin:.0f}, wanted "
        f"{wanted:.0f}). It renames teeth that one photograph alone shows, such as those "
        "behind a tooth that may be missing: the scene does not rest on it, their numbers are "
        "marked. Check them on the page check.html."
    ]


def one_sitting(views: Sequence[View]) -> bool | None:
    """Were some photographs taken within minutes, or on several days, by the camera's clock?

    None where it says neither: photographs lose their times when they are sent or edited.
    """
    times = [view.taken_after for view in views if view.taken_after is not None]
    if len(times) < max(2, len(views)):
        return None
    between = max(times) - min(times)
    return True if between <= _SITTING else False if between >= _DAY else None


def of_several_days(views: Sequence[View]) -> list[str]:
    """What to say of photographs that were taken on several days."""
    if one_sitting(views) is not False:
        return []
    times = [view.taken_after or 0.0 for view in views]
    days = round((max(times) - min(times)) / _DAY)
    first, last = (photo_name(views[times.index(pick(times))]) for pick in (min, max))
    return [
        f"{last} was taken {days} day{'s' if days > 1 else ''} after {first}, by the camera's "
        "clock: are they of one patient and one visit? Teeth that have moved between would be seen "
        "in two places."
    ]


def misnamed(names: list[str], teeth: Reconstruction) -> list[str]:
    """What to say of photographs whose names call them the other side than their teeth show."""
    sides = [
        (name, placed.role)
        for name, placed in zip(names, teeth.fit.views, strict=True)
        if placed is not None and placed.role in SIDES and says_side(name)
    ]
    wrong = [
        f"{name} shows the patient's {role} side by its teeth, although its name says "
        f"{SIDES[role]}; the teeth are believed."
        for name, role in sides if says_side(name) != role
    ]  # fmt: skip
    if wrong and len(wrong) == len(sides):
        wrong[-1] += (
            " If it is not the names that are wrong, all photographs are mirror images (taken in a "
            "mirror, or turned over by a phone), and left and right are wrong in the whole scene: "
            "say of each on the page check.html that it is one."
        )
    return wrong


def _write(
    context: StageContext, views: Views, teeth: Reconstruction, numbered: TeethArtifact
) -> None:
    config: InitConfig = context.config
    surface = teeth.surface
    order = [number for number, placed in enumerate(teeth.fit.views) if placed is not None]
    mm, uncertainty = scale_from_widths(teeth.fit, config.dental.tooth_widths)
    source: Source = "tooth_widths" if config.dental.tooth_widths else "textbook_teeth"
    mask = config.dental.mask_rest is not False
    cameras = tuple(_camera(teeth.views[k], teeth, k) for k in order)
    rolls = [d.roll if (d := teeth.dentitions[k]) else 0.0 for k in order]
    downs = [
        np.array([-np.sin(r), np.cos(r), 0]) @ c.rotation
        for r, c in zip(rolls, cameras, strict=True)
    ]
    placement = Placement(
        views=tuple(_masked(teeth.views[k], teeth, k, mask) for k in order),
        cameras=cameras,
        points=surface.positions.astype(np.float64), seen=(), weights={},
        input_from_world=np.diag([mm, mm, mm, 1.0]),
        scale=Scale("mm", source, round(100 * uncertainty, 2)),
    ).normalised(downs)  # fmt: skip
    scale = mm / np.cbrt(np.linalg.det(placement.input_from_world[:3, :3]))
    world_from_mm = np.linalg.inv(placement.input_from_world) @ np.diag([mm, mm, mm, 1.0])
    rotation = world_from_mm[:3, :3] / scale
    maps = [surface.views[k] for k in order]
    depths = [(found.depth * scale).astype(np.float32) for found in maps if found]
    points = Points(
        positions=placement.points.astype(np.float32),
        colors=surface.colors,
        normals=(surface.normals @ rotation.T).astype(np.float32),
        confidence=surface.confidence,
        scale=np.full(len(surface.positions), config.dental.cloud_spacing * scale, np.float32),
    )
    mouth = mouth_frame(
        {
            (mark.kind, mark.tooth): scale * rotation @ place + world_from_mm[:3, 3]
            for mark, place in teeth.fit.landmarks.items() if mark.kind in ("tip", "zenith")
        }
    )  # fmt: skip
    # The cloud has each piece of the one surface once, and evenly. Pointmaps of it, for `align` to
    # fuse, would lose what one photograph sees close behind what another one shows.
    save_all(
        context, views, placement.views,
        replace(placement.placed(), mouth_from_world=mouth), depths, points, [], numbered,
    )  # fmt: skip
    context.save(Pictures({"surface_turned": teeth.turned}))
    context.summarize(
        method="dental", **tooth_counts(teeth),
        scale_uncertainty_percent=round(100 * uncertainty, 1),
    )  # fmt: skip
    if config.dental.tooth_widths:
        for doubt in width_doubts(teeth.fit, config.dental.tooth_widths):
            context.warn(doubt)
    elif config.length.mm is None:
        context.warn(
            f"{placement.scale.text} Pass a known width for a true scale, as in --set "
            "'init.dental.tooth_widths={11: 8.6}'."
        )


def _camera(view: View, teeth: Reconstruction, number: int) -> Camera:
    placed = teeth.fit.views[number]
    assert placed is not None
    return placed.camera(view.name, view.width, view.height)


def _masked(view: View, teeth: Reconstruction, number: int, mask_rest: bool) -> View:
    """The view with what is not teeth or gum masked out."""
    found = teeth.surface.views[number]
    if not mask_rest or found is None:
        return view
    return masked(view, found.depth)


def masked(view: View, depth: Map) -> View:
    """The view with what has no depth masked out."""
    return replace(view, mask=(depth > 0) & view.valid())


def tooth_counts(teeth: Reconstruction) -> dict[str, float]:
    """Figures of the teeth found, for the summary."""
    placed = [view for view in teeth.fit.views if view is not None]
    # no other numbering of a few crowns may have been worth a try
    margin = {"label_margin": round(teeth.fit.margin, 1)} if np.isfinite(teeth.fit.margin) else {}
    return {
        "upper_teeth": len({tooth for view in placed for tooth in view.upper if tooth}),
        "lower_teeth": len({tooth for view in placed for tooth in view.lower if tooth}),
        **margin,
        "teeth_confidence": round(teeth.fit.confidence, 3),
        "landmark_error_px": round(float(np.median([view.error for view in placed])), 2),
    }


def arch_options(
    context: StageContext, views: Views, dentitions: Sequence[Dentition | None]
) -> ArchOptions:
    """The settings of the arch fit.

    Args:
        views: the photographs, or some of them.
        dentitions: of each, None: it takes no part.

    Raises:
        RequestError: an order that doesn't fit the photographs.
    """
    order = context.config.dental.order
    if order is not None:
        every = context.load("views").views
        if len(order) != len(every):
            raise RequestError(
                f"init.dental.order names {len(order)} photographs ({','.join(order)}), but there "
                f"are {len(every)}."
            )
        said = {view.name: role for view, role in zip(every, order, strict=True)}
        order = tuple(said[view.name] for view in views.views)
    return ArchOptions(
        order=order, one_sitting=one_sitting(taking_part(views, dentitions)), one_film=views.ordered
    )


def surface_options(config: DentalConfig) -> SurfaceOptions:
    """The settings of the dense surface."""
    shared = set(DentalConfig.model_fields) & set(SurfaceOptions.__dataclass_fields__)
    settings = {name: getattr(config, name) for name in sorted(shared)}
    return SurfaceOptions(**{name: value for name, value in settings.items() if value is not None})
