"""A finished scene before photographs: renders, figures and pictures of one view after another."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from pipeline.artifacts.cameras import Camera
from pipeline.artifacts.views import View, to_uint8, write_png
from stages.evaluate.config import EvaluateConfig
from stages.evaluate.images import pictures
from stages.evaluate.images.flip import flip_map
from stages.evaluate.images.score import COVERED, Figures, score_view
from stages.evaluate.support import overlay, support_map, unsupported_share
from stages.splatting.support import SeenSurface, seen_surface

Image = npt.NDArray[np.uint8]
Mask = npt.NDArray[np.bool_]

#: Error (0..1) that has the brightest colour in the pictures.
ERROR_RANGE = 0.25
#: Relative difference of depth within which an input view saw the same surface.
SAME_SURFACE = 0.02


class Rendered(Protocol):
    """What a renderer returns: see `stages.splatting.rendering.RenderedView`."""

    @property
    def image(self) -> npt.NDArray[np.float32]: ...
    @property
    def alpha(self) -> npt.NDArray[np.float32]: ...
    @property
    def depth(self) -> npt.NDArray[np.float32]: ...


@dataclass
class Examiner:
    """Compares renders with photographs: one code path for every view and protocol.

    Attributes:
        render: draws the scene as a camera sees it.
        config: of the stage.
        folder: for the pictures.
        regions: view name -> part that is scored by itself.
        lpips: as `score_view` has it.
    """

    render: Callable[[Camera], Rendered]
    config: EvaluateConfig
    folder: Path
    regions: Mapping[str, Mask]
    lpips: Callable[[Image, Image, Mask | None], float] | None

    def examine(
        self,
        view: View,
        camera: Camera,
        prefix: str = "",
        pictured: bool = True,
        saved: bool = True,
        surfaces: Sequence[SeenSurface] | None = None,
    ) -> tuple[Figures, SeenSurface]:
        """Figures of one view, and what it shows of the scene.

        Args:
            view: the photograph; some of its pixels count.
            camera: for its image size.
            prefix: of the names of its pictures.
            pictured: whether a comparison is written, where the config wants them.
            saved: whether the render itself is, where the config wants it.
            surfaces: what the input views show, for a view that is none of them.
        """
        result = self.render(camera)
        image, photo, valid = to_uint8(np.asarray(result.image)), to_uint8(view.image), view.valid()
        alpha = np.asarray(result.alpha)
        figures = score_view(
            image, photo, alpha, valid, region=self.regions.get(view.name), lpips=self.lpips,
            flip=flip_map if self.config.flip else None,
        )  # fmt: skip
        if surfaces is not None:
            figures["unsupported"] = self._support(
                camera, result, image, valid, surfaces, view.name if pictured else None
            )
        if self.config.comparisons and pictured:
            picture = pictures.comparison(image, photo, ERROR_RANGE, view.mask)
            write_png(self.folder / f"{prefix}comparison_{view.name}.png", picture)
        if self.config.save_renders and saved:
            write_png(self.folder / f"{prefix}render_{view.name}.png", image)
        return figures, seen_surface(camera, np.asarray(result.depth), alpha > COVERED, valid)

    def novel(self, camera: Camera, surfaces: Sequence[SeenSurface]) -> dict[str, Any]:
        """Support of a view that nobody photographed."""
        result = self.render(camera)
        everywhere = np.ones(np.asarray(result.alpha).shape, bool)
        share = self._support(
            camera, result, to_uint8(np.asarray(result.image)), everywhere, surfaces,
            f"novel_{camera.name}",
        )  # fmt: skip
        rendered = float((np.asarray(result.alpha) > COVERED).mean())
        return {"unsupported": share, "coverage": rendered}

    def _support(
        self, camera: Camera, result: Rendered, image: Image, valid: Mask,
        surfaces: Sequence[SeenSurface], picture: str | None,
    ) -> float:  # fmt: skip
        rendered = (np.asarray(result.alpha) > COVERED) & valid
        count = support_map(camera, np.asarray(result.depth), rendered, surfaces, SAME_SURFACE)
        if self.config.support_pictures and picture is not None:
            write_png(self.folder / f"support_{picture}.png", overlay(image, count, rendered))
        return unsupported_share(count, rendered)
