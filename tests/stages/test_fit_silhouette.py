"""What lies beyond the masks and was empty at the start stays so."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from stages.fit.config import FitConfig, resolve
from stages.fit.inputs.scene import prepare
from stages.fit.parts.objectives import Silhouette
from tests.stages.fit_case import HEIGHT, WIDTH, case

#: So far from the middle the points end, in units of the sheet.
END = 22.0
HELD = {
    "light": "none",
    "hold_surface": True,
    "lining": 0.0,
    "initial_points": 600,
    "detail": False,
}


def trainer(masked: bool = True, **config):
    """Of three views of a round piece of a sheet that goes on; masks end where the piece does."""
    views, cameras, points = case()
    inside = np.hypot(points.positions[:, 0], points.positions[:, 1]) < END
    piece = points[inside]
    few = []
    for view, camera in zip(views.views, cameras.cameras, strict=True):
        pixels, _ = camera.project(piece.positions.astype(np.float64))
        mask = np.zeros((HEIGHT, WIDTH), bool)
        column, row = np.clip(np.floor(pixels).astype(int), 0, [WIDTH - 1, HEIGHT - 1]).T
        mask[row, column] = True
        few.append(replace(view, mask=mask) if masked else view)
    settings = resolve(FitConfig(**{**HELD, **config}), 3, 0, True, WIDTH * HEIGHT)
    scene = prepare(few, cameras.cameras, piece, None, settings)
    return scene.trainer(settings, lit=False)


def beyond(fit, outside) -> float:
    """How much is drawn where a fit with the part says that nothing was."""
    found = [(outside[view][1] * (1 - fit.render(view).transmittance)).sum() for view in fit.views]
    return float(np.mean(found))


def test_the_rim_of_a_held_surface_stays_where_it_is() -> None:
    fits = {weight: trainer(lambda_silhouette=weight, iterations=80) for weight in (0.0, 0.1)}
    assert fits[0.0].find(Silhouette) is None
    outside = fits[0.1].find(Silhouette).outside
    assert all(factors[1].any() for factors in outside)
    grown = {}
    for weight, fit in fits.items():
        fit.run(None, lambda *_: None)
        grown[weight] = beyond(fit, outside)
    assert grown[0.1] < 0.25 * grown[0.0]
    # what the masks hold is explained as well
    psnr = {weight: fit.training_scores()[0].mean() for weight, fit in fits.items()}
    assert psnr[0.1] > psnr[0.0] - 0.3


def test_its_gradient_is_that_of_what_is_drawn() -> None:
    fit = trainer(lambda_silhouette=0.5)
    step = fit._next()
    step.rendering = fit.render(step.view, step.factor)
    step.d_transmittance = np.zeros_like(step.rendering.transmittance)
    part = fit.find(Silhouette)
    part.compare(fit, step)
    mask, outside = step.target.colour.mask, part.outside[step.view][step.factor]
    assert not (outside * mask).any() and (outside > 0).sum() > 100
    drawn = 1 - step.rendering.transmittance
    assert step.loss == pytest.approx(0.5 * (outside * drawn).sum() / mask.sum(), rel=1e-5)
    np.testing.assert_allclose(step.d_transmittance, -0.5 * outside / mask.sum(), rtol=1e-5)


def test_without_masks_there_is_nothing_beyond_them() -> None:
    assert trainer(masked=False, lambda_silhouette=0.5).find(Silhouette) is None
    assert trainer().find(Silhouette) is not None
