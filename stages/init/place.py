"""The ways of finding cameras, each from views to a `Placement`."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from pipeline.artifacts.cameras import Camera
from pipeline.artifacts.space.scale import Scale
from pipeline.artifacts.views import View
from pipeline.errors import ReconstructionError
from pipeline.geometry.graph import Pair
from pipeline.geometry.models.known_cameras import KnownCamera, as_pinhole, rounded
from stages.init.config import CAMERAS
from stages.init.placement import Placement
from stages.init.sfm.diagnosis import HOW_TO_SHOOT, Limits, failure, warnings_of
from stages.init.sfm.matching.features import Features
from stages.init.sfm.matching.pictures import Links, match_pictures
from stages.init.sfm.matching.roll import rolls_of_cameras
from stages.init.sfm.matching.two_view import Correspondences
from stages.init.sfm.options import REFERENCE_SIDE, ClassicalOptions, RefinementOptions
from stages.init.sfm.reconstruct import Attempt, find_features, match_views, reconstruct
from stages.init.sfm.triangulate import agreeing_matches, link_tracks, triangulate
from stages.init.sfm.undistort import undistort_image
from stages.photographs.detail import BURNT_OUT, shows_nothing, white_share
from stages.photographs.sharpness import UNSHARP, weakest_direction

Progress = Callable[[str, int, int], None]
Warn = Callable[[str], None]

#: With fewer points than this in a view, its depth range can't be told.
LEAST_POINTS = 8
#: Of the coherent matches of a pair, nearly all lie on the epipolar lines of the right cameras, and
#: one in ten on those of wrong ones; below this share the cameras are wrong.
LEAST_AGREEMENT = 0.4
#: Pairs with fewer coherent matches say nothing about the cameras.
TELLING_MATCHES = 25


def photo_name(view: View) -> str:
    """How the user knows a photograph."""
    return view.source_name or view.name


def place_classical(
    views: list[View], focals: list[float | None], focal_given: bool, ordered: bool,
    least_views: int, options: ClassicalOptions, refinement: RefinementOptions, *, seed: int,
    threads: int, scratch: Path, progress: Progress, warn: Warn, pictures: int = 0,
    plain_features: list[Features] | None = None,
) -> Placement:  # fmt: skip
    """Cameras from features and COLMAP's mappers (`stages.init.sfm.reconstruct`).

    Args:
        focals: of each view in pixels, or None.
        focal_given: the user said them; they are not refined.
        ordered: the views are a sequence.
        least_views: with fewer placed it is a failure.
        pictures: at most so many pairs are drawn for the message of a failure.
        plain_features: those of the views without squeezed copies, if they have been found.

    Raises:
        ReconstructionError: the photographs don't allow it; the message is the diagnosis.
    """
    pixel = max(max(view.width, view.height) for view in views) / REFERENCE_SIDE
    attempt = reconstruct(
        [view.gray() for view in views], [view.valid() for view in views], focals, focal_given,
        ordered, options, seed=seed, threads=threads, scratch=scratch, progress=progress,
        refinement=refinement, plain_features=plain_features,
    )  # fmt: skip
    names = [photo_name(view) for view in views]
    limits = Limits(min_views=least_views, max_error=options.max_reprojection_error * pixel)
    bad = _bad_ones(views, attempt)
    diagnosis = failure(attempt, names, limits, *bad)
    if diagnosis:
        # All pairs that have any geometry: what is missing shows in the weak ones.
        links = replace(links_of(views, attempt), used=frozenset())
        drawn = match_pictures(links, pictures)
        raise ReconstructionError(diagnosis, drawn)
    for text in warnings_of(attempt, names, *bad):
        warn(text)
    return _from_attempt(views, attempt)


def _bad_ones(views: list[View], attempt: Attempt) -> tuple[list[int], list[int], list[int]]:
    """Photographs that are shaken or out of focus, those of an even surface and nothing else, and
    those that lack detail as well and are white in good part.

    Asked only where some could not be placed.
    """
    if attempt.solution is not None and len(attempt.solution.poses) == len(views):
        return [], [], []
    greys = [view.gray().astype(np.float32) for view in views]
    blank = [k for k, grey in enumerate(greys) if shows_nothing(grey)]
    soft = [
        k for k, grey in enumerate(greys) if k not in blank and weakest_direction(grey) < UNSHARP
    ]
    bright = [k for k in soft if white_share(greys[k]) > BURNT_OUT]
    return [k for k in soft if k not in bright], blank, bright


def links_of(views: list[View], attempt: Attempt) -> Links:
    """What links the photographs of an attempt, also of one that failed."""
    evidence, solution = attempt.evidence, attempt.solution
    return Links(
        views=tuple(views), matches=evidence.correspondences,
        verified={pair: edge.inliers for pair, edge in evidence.edges.items()},
        weights={pair: edge.evidence for pair, edge in evidence.edges.items()},
        used=frozenset(solution.edges if solution else ()),
    )  # fmt: skip


def _from_attempt(views: list[View], attempt: Attempt) -> Placement:
    solution = attempt.solution
    assert solution is not None
    order = sorted(solution.poses)
    number = {view: position for position, view in enumerate(order)}
    placed = [
        _straight(views[view], solution.focals[view], solution.distortions.get(view, 0.0))
        for view in order
    ]
    cameras = [
        Camera(
            name=view.name, width=view.width, height=view.height,
            fx=solution.focals[index], fy=solution.focals[index],
            cx=view.width / 2, cy=view.height / 2, cam_from_world=solution.poses[index],
        )
        for index, view in zip(order, placed, strict=True)
    ]  # fmt: skip
    weights = {
        (number[i], number[j]): edge.evidence
        for (i, j), edge in attempt.evidence.edges.items()
        if (i, j) in solution.edges and i in number and j in number
    }
    return Placement(
        views=tuple(placed), cameras=tuple(cameras), points=solution.points,
        seen=tuple(solution.points_of(index) for index in order), weights=weights,
        figures={
            "reprojection_error_px": round(solution.error, 3),
            "matches": sum(len(edge.inliers) for edge in attempt.evidence.edges.values()),
        },
        links=links_of(views, attempt),
    )  # fmt: skip


def _straight(view: View, focal: float, k1: float) -> View:
    """The view as a pinhole with its focal length shows it."""
    if k1 == 0:
        return view
    image, valid = undistort_image(view.image, view.valid(), focal, k1)
    lens = f"SIMPLE_RADIAL {view.width} {view.height} {focal:.6g} {view.width / 2:g} "
    return replace(
        view, image=rounded(image), mask=None if valid.all() else valid,
        lens_taken_out=f"{lens}{view.height / 2:g} {k1:.6g}",
    )  # fmt: skip


def place_known(
    views: list[View], known: dict[str, KnownCamera], scale: Scale, ordered: bool,
    options: ClassicalOptions, *, threads: int, progress: Progress, warn: Warn,
    scratch: Path | None = None,
) -> Placement:  # fmt: skip
    """The cameras that the user gave; only the points are found.

    Views without a camera are left out, with a warning. Distortion is taken out of the images.

    Args:
        known: name of a view -> its camera.
        scale: of the world of these cameras.
        scratch: folder for files that are needed meanwhile; None: the system's.

    Raises:
        ReconstructionError: too few matches agree with the cameras to tell where the scene is.
    """
    without = [photo_name(view) for view in views if view.name not in known]
    if without:
        warn(f"The model has no camera of {', '.join(without)}; left out.")
    pairs = [as_pinhole(view, known[view.name], CAMERAS) for view in views if view.name in known]
    placed, cameras = [view for view, _ in pairs], [camera for _, camera in pairs]
    pixel = max(max(view.width, view.height) for view in placed) / REFERENCE_SIDE
    max_error = options.max_reprojection_error * pixel

    def matched(
        rolls: list[float],
    ) -> tuple[list[Features], dict[Pair, Correspondences], dict[Pair, npt.NDArray[np.int64]]]:
        features = find_features(
            [view.gray() for view in placed], [view.valid() for view in placed], options, threads,
            progress, rolls, scratch,
        )  # fmt: skip
        matches = match_views(features, ordered, options, pixel, threads, progress)
        return features, matches, agreeing_matches(cameras, matches, max_error)

    features, matches, chosen = matched([0.0] * len(placed))
    linked = [pair for pair, those in chosen.items() if len(those) >= options.min_inliers]
    rolls = rolls_of_cameras(cameras, linked)
    if any(rolls):
        features, matches, chosen = matched(rolls)
    tracks = link_tracks(
        [feature.positions for feature in features], [feature.points for feature in features],
        matches, chosen,
    )  # fmt: skip
    points, tracks = triangulate(cameras, tracks, max_error, options.min_tri_angle)
    seen = [np.unique(tracks.point[tracks.view == number]) for number in range(len(placed))]
    wrong = _contradicted(matches, chosen)
    few = sum(len(those) >= LEAST_POINTS for those in seen) < 2
    if few or len(wrong) >= len(placed) - 1:
        number = sum(int(those.coherent.sum()) for those in matches.values())
        agreeing = sum(len(those) for those in chosen.values())
        if agreeing > LEAST_AGREEMENT * number:
            raise ReconstructionError(
                f"The cameras given tell no depth: {agreeing} of {number} matches lie where they "
                f"say, but {len(points)} of their points are seen from two places that are "
                f"{options.min_tri_angle:g}° apart (init.min_tri_angle). Do all cameras stand in "
                f"one place? {HOW_TO_SHOOT}"
            )
        raise ReconstructionError(
            f"The cameras given do not fit the photographs: of {number} matches {agreeing} lie "
            "where the cameras say. Are they the cameras of these photographs, at this zoom, with "
            "the axes of their format (a transforms.json has camera-to-world matrices, y up and z "
            f"back)? {HOW_TO_SHOOT}"
        )
    if wrong:
        warn(
            "The cameras given of these photographs contradict what the photographs show: "
            f"{', '.join(photo_name(placed[number]) for number in wrong)}."
        )
    errors = [
        np.linalg.norm(camera.project(points[tracks.point[mine]])[0] - tracks.pixel[mine], axis=1)
        for number, camera in enumerate(cameras)
        for mine in [tracks.view == number]
    ]
    return Placement(
        views=tuple(placed), cameras=tuple(cameras), points=points, seen=tuple(seen),
        weights={pair: float(len(those)) for pair, those in chosen.items() if len(those)},
        scale=scale,
        given=True,
        figures={
            "reprojection_error_px": round(float(np.sqrt(np.mean(np.concatenate(errors) ** 2))), 3),
            "matches": sum(len(those) for those in chosen.values()),
        },
        links=Links(
            tuple(placed), matches, chosen,
            {pair: float(len(those)) for pair, those in chosen.items()},
            frozenset(pair for pair, those in chosen.items() if len(those)),
        ),
    )  # fmt: skip


def _contradicted(
    matches: dict[Pair, Correspondences], chosen: dict[Pair, npt.NDArray[np.int64]]
) -> list[int]:
    """Views of whose telling pairs none agrees with the cameras."""
    best: dict[int, float] = {}
    for pair, found in matches.items():
        coherent = int(found.coherent.sum())
        if coherent >= TELLING_MATCHES:
            for view in pair:
                best[view] = max(best.get(view, 0.0), len(chosen[pair]) / coherent)
    return sorted(view for view, share in best.items() if share < LEAST_AGREEMENT)


def with_focals(views: Iterable[View], ratio: float | None) -> list[float | None]:
    """Focal length of each view in pixels: `ratio` times its long side, or what EXIF says."""
    return [
        ratio * max(view.width, view.height) if ratio else view.focal_px for view in views
    ]  # fmt: skip
