"""Is there a light beside the lens? And spherical harmonics for viewers that know no such light."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from pipeline.artifacts.cameras import Camera
from pipeline.artifacts.confidence import MEASURED
from pipeline.errors import ReconstructionError
from pipeline.geometry.order import viewing_order
from stages.fit.arrays import Floats
from stages.fit.config import FitSettings
from stages.fit.inputs.initial import SH_C0, camera_share, facing, headlight_harmonics
from stages.fit.inputs.scene import Scene
from stages.fit.numerics.harmonics import Nearest
from stages.fit.numerics.light import prediction_errors
from stages.fit.parts.light import Light
from stages.splatting.harmonics import seen_from
from stages.splatting.kernels.projection import HARMONICS

if TYPE_CHECKING:
    from stages.fit.trainer import Trainer

#: the two that are compared, and whether a fit is lit
LIGHTS = (("none", False), ("camera", True))
#: what a trial goes without: it is over before any of this shows
QUICK = {
    "coarse_fraction": 0.0, "detail": False, "extension": 0.0, "lambda_flow": 0.0, "densify": False,
    "opacity_reset_interval": 0, "sh_degree_interval": 0,
}  # fmt: skip
#: Gaussians of a trial: how the light moves shows long before any detail
TRIAL_POINTS = 8000
#: dB by which a light has to be better on the photographs that a trial leaves out
MARGIN = 0.3
#: On a held surface there is a light if its shading lowers the error of predicting the photographs
#: from one another to this share, and leaves no more than this (mean, 0..1). A light that is there
#: leaves .024 to .067 (samples, scan video, generated mouths).
EVIDENCE, UNEXPLAINED = 0.7, 0.07
#: From this error up a trial has the last word: photographs of which each had a flash, an exposure
#: and a white balance of its own may look lit (.061 to .073 with the share of the three nearest of
#: fourteen real sets), and are 5 to 13 dB worse with one light for all.
CERTAIN = 0.045
#: Steps of that trial, and how much more error (RMS, 0..1) a light may leave than none. It leaves
#: .0014 more at most where there is one (seventeen triples of the samples and the scan video,
#: neighbours 9 to 48 degrees apart), and .0042 to .035 more on thirteen sets of real photographs.
CHECK_ITERATIONS, CHECK_MARGIN = 80, 0.0025
#: how much a matte surface counts against one camera, for harmonics of each degree
MATTE = (1e-3, 0.03, 0.1, 0.3)


def choose_light(scene: Scene, settings: FitSettings) -> tuple[str, dict[str, float]]:
    """Whether a light beside the lens explains the photographs better than none.

    On a held surface the photographs may be too far apart to predict one another as a whole; what
    surface they share says whether there is a light at all, and a trial whether it is the same for
    all of them.

    Returns:
        ``"camera"`` or ``"none"``, and the figures that say so.
    """
    if not settings.hold_surface:
        return _by_prediction(scene, settings)
    light, figures = _by_shading(scene, settings)
    if light == "none" or figures["light_error_camera"] <= CERTAIN:
        return light, figures
    light, tried = _by_training(scene, settings)
    return light, figures | tried


def _by_shading(scene: Scene, settings: FitSettings) -> tuple[str, dict[str, float]]:
    """From what surface they share, how well photographs are predicted from one another."""
    cloud = scene.cloud
    errors = prediction_errors(
        cloud.select(cloud.weight > MEASURED),
        [view.image for view in scene.views], [view.valid() for view in scene.views],
        scene.cameras, settings.light_gamma,
    )  # fmt: skip
    if errors is None:
        return "none", {}
    without, lit = errors
    better = lit <= min(EVIDENCE * without, UNEXPLAINED)
    figures = {"light_error_none": round(without, 4), "light_error_camera": round(lit, 4)}
    return ("camera" if better else "none"), figures


def _by_training(scene: Scene, settings: FitSettings) -> tuple[str, dict[str, float]]:
    """Which fit comes nearer to the photographs in its first steps.

    Photographs of which each had an exposure and a white balance of its own may look lit by the
    shading of what they share. A light that is the same for all can't come near them, while
    harmonics with exposures do; where there is one light for all, shading comes as near.
    """
    quick = settings.but(iterations=CHECK_ITERATIONS, **QUICK)
    few, scores, errors = scene.reduced(settings.light_trial_factor), {}, {}
    for name, lit in LIGHTS:
        trainer = _tried(few, quick, lit)
        every = trainer.training_scores()[0] if trainer else np.zeros(1)
        scores[name], errors[name] = float(every.mean()), float((10 ** (-every / 20)).mean())
    better = errors["camera"] <= errors["none"] + CHECK_MARGIN
    return ("camera" if better else "none"), _tried_figures(scores)


def _by_prediction(scene: Scene, settings: FitSettings) -> tuple[str, dict[str, float]]:
    """Fit most photographs, with and without a light, and see which predicts the others.

    Those left out have a neighbour on either side: the model is to fill gaps, not to extrapolate.
    Small images and few Gaussians, but not few steps: a light takes longer to find than harmonics,
    and would lose to them at first.
    The figures are the mean PSNR of either on the photographs that were left out.
    """
    left_out, factor = between_others(scene.cameras), settings.light_trial_factor
    rest, scores = scene.reduced(factor).without(left_out), {}
    held = [view for view in left_out if scene.targets[view][factor].colour.mask.any()]
    quick = settings.but(
        iterations=settings.light_trial_iterations, **QUICK,
        optimize_poses=False, exposure=False, warp_levels=0,
    )  # fmt: skip
    for name, lit in LIGHTS:
        trainer, every = _tried(rest, quick, lit), []
        if trainer is None:
            scores[name] = 0.0
            continue
        for view in held:
            target = scene.targets[view][factor]
            viewpoint = trainer.viewpoint(scene.cameras[view].cam_from_world[:3], target)
            image = trainer.composited(None, trainer.look(viewpoint))
            every.append(target.colour(np.clip(image, 0, 1), settings.lambda_dssim).psnr)
        scores[name] = float(np.mean(every)) if every else 0.0
    better = scores["camera"] >= scores["none"] + MARGIN
    return ("camera" if better else "none"), _tried_figures(scores)


def _tried(scene: Scene, settings: FitSettings, lit: bool) -> Trainer | None:
    """A quick fit of few Gaussians; None if it diverged (if the real one does as well, it says)."""
    trainer = scene.trainer(settings.but(initial_points=TRIAL_POINTS), lit)
    try:
        trainer.run(None, lambda *_: None)
    except ReconstructionError:
        return None
    return trainer


def _tried_figures(scores: Mapping[str, float]) -> dict[str, float]:
    """PSNR (dB) with and without a light, as figures of the fit."""
    return {f"light_trial_{name}": round(score, 2) for name, score in scores.items()}


def between_others(cameras: Sequence[Camera]) -> list[int]:
    """Every third camera in viewing order, neither the first nor the last; two: the first."""
    order = viewing_order(np.array([camera.centre for camera in cameras]))
    return order[1:-1:3] or order[:1]


def harmonics_for_viewers(fit: Trainer, cameras: Sequence[Camera]) -> Floats:
    """A lit scene for viewers that know no light: what it looks like from where photographs are.

    For each Gaussian the harmonics that come nearest to its lit colours at all cameras, and to a
    matte surface lit from the camera in all that these leave open: a linear problem of its own.

    Args:
        fit: a finished one with a light.
        cameras: in its frame.

    Returns:
        [N, 11 + 3 K] packed Gaussians.
    """
    part, s = fit.find(Light), fit.settings
    assert part is not None
    packed, terms = fit.packed.copy(), (s.sh_degree + 1) ** 2
    positions = packed[:, :3].astype(np.float64)
    normals = part.normals().astype(np.float64)
    cosine = facing(positions, normals, cameras)
    albedo = np.clip(part.material[:, :3].astype(np.float64), 0, 1.2)
    share = camera_share(albedo, s.headlight, s.headlight_shoulder)
    colours = albedo * (1 - share + share * cosine[:, None])
    matte = headlight_harmonics(colours, normals, cosine, share, s.sh_degree)
    degrees = np.sqrt(np.arange(terms)).astype(int)
    nearest = Nearest(matte, np.array(MATTE)[degrees])
    for view, target in enumerate(fit.targets):
        viewpoint = fit.viewpoint(view, target[1])
        part.shade(packed, viewpoint)
        # the kernels' constant harmonic
        seen = SH_C0 * packed[:, HARMONICS : HARMONICS + 3]
        nearest.add(seen_from(viewpoint.centre, positions)[:, :terms], seen)
    sh = nearest.found.reshape(len(packed), -1).astype(np.float32)
    return np.concatenate([packed[:, :HARMONICS], sh], 1)
