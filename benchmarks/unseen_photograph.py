"""One of three photographs predicted from the other two: how well colours turn with the view.

    python benchmarks/unseen_photograph.py WORKSPACE ... [--left-out 0|1|2] [--set FIELD=VALUE ...]
                                           [--cut] [--pictures DIR] [--threads 2]

Each workspace is of three photographs, run up to `sap`: right, frontal, left. Cameras and surface
are those of all three; colours are fitted to two of them, at about half size. Compared is what the
third shows of surface that another one sees well, with a gain for each channel, as exposures
differ. Real patients have no other truth: this is the one figure of unseen views that they give.
What is a hole in the render counts as black: surface is known to be there. --set says a setting of
the fit anew: `--set headlight=0.6 --set headlight_shoulder=0`, `--set light=camera`.

With --cut only a part of it is left out, 40 % of what another one shows as well (of the frontal
photograph on both sides, of the others towards the front teeth), and no gains are allowed: what
lies beyond the border of a photograph should look from there as that photograph would show it.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import workspaces
import yaml

from stages.fit.config import FitConfig, resolve
from stages.fit.inputs.initial import Cloud
from stages.fit.inputs.scene import Scene, prepare
from stages.fit.numerics.light import sighted
from stages.splatting.rasterizer import use_threads

Array = npt.NDArray[np.float64]
Floats = npt.NDArray[np.float32]
Bools = npt.NDArray[np.bool_]

#: What is the same in all runs unless it is said anew: no light, and nothing of geometry.
FIXED = {"light": "none", "lambda_flow": 0.0, "detail": False, "optimize_poses": False}
#: Gaussians; the width of photographs is halved until it is at most this.
POINTS, WIDTH = 40_000, 700
#: How far a point may lie from what a photograph shows (a share of the depth), least cosine of a
#: good look at it, and what counts for one at more of a slant: some colour is better than none.
TOLERANCE, LEAST_COSINE, SLANTED = 0.01, 0.3, 0.05
#: What --cut leaves of the columns of what others show, from and to which share of it.
LEFT = ((0.0, 0.6), (0.2, 0.8), (0.4, 1.0))
#: Gains are found below this brightness.
BRIGHT = 0.97


@dataclass(frozen=True)
class Prediction:
    """Attributes:
    shown: [3, H, W] the photograph that was left out; predicted: the same, with the gains.
    compared: [H, W] where.
    gains: [3] of the channels; None where none are allowed.
    """

    shown: Floats
    predicted: Floats
    compared: Bools
    gains: Array | None

    @property
    def psnr(self) -> float:
        """Of the pixels that are compared, dB."""
        error = (self.predicted - self.shown)[:, self.compared]
        return float(-10 * np.log10((error.astype(np.float64) ** 2).mean()))


def read_scene(
    workspace: Path, settings: FitConfig, shown: int, masks: dict[str, Bools] | None = None
) -> tuple[Scene, Any, int]:
    """The scene of a workspace, the fit's settings, and the factor by which images are reduced.

    Args:
        shown: photographs that the fit will have.
        masks: by name, in place of the views' own.
    """
    cameras = workspaces.load(workspace, "align", "cameras").by_name()
    views = [view for name, view in workspaces.views(workspace).items() if name in cameras]
    views = [replace(view, mask=(masks or {}).get(view.name, view.mask)) for view in views]
    if len(views) != 3:
        raise SystemExit(f"{workspace}: {len(views)} photographs are placed, three are needed.")
    factor = 1
    while max(view.image.shape[1] for view in views) / factor > WIDTH:
        factor *= 2
    resolved = resolve(
        settings.model_copy(update={"coarse_factor": max(factor, 2), "coarse_fraction": 0.5}),
        shown, 0, True,
    )  # fmt: skip
    cameras_in_order = [cameras[view.name] for view in views]
    scene = prepare(
        views, cameras_in_order, workspaces.load(workspace, "sap", "points"), None, resolved
    )
    return scene, resolved.but(coarse_fraction=0.0), factor


@dataclass(frozen=True)
class Sight:
    """Attributes:
    row, column: [N] where a view would show each point.
    cosine: [N] of its normal with the line of sight; 0 where the view does not show it.
    """

    row: npt.NDArray[np.int64]
    column: npt.NDArray[np.int64]
    cosine: Array


def sights(scene: Scene) -> list[Sight]:
    """How each view sees the points."""
    cloud, found = scene.cloud, []
    for view, camera in zip(scene.views, scene.cameras, strict=True):
        row, column, seen = sighted(
            cloud.positions, cloud.positions, view.valid(), camera, TOLERANCE
        )
        ray = camera.centre - cloud.positions
        cosine = (cloud.normals * ray).sum(1) / np.linalg.norm(ray, axis=1)
        found.append(Sight(row, column, np.where(seen, np.maximum(cosine, SLANTED), 0)))
    return found


def coloured(scene: Scene, seen: list[Sight], views: list[int]) -> Cloud:
    """The points with the colours that some views show; those that none sees keep theirs."""
    cloud = scene.cloud
    total, mass = np.zeros_like(cloud.colors), np.zeros(len(cloud))
    for view in views:
        sight = seen[view]
        weight = sight.cosine**2
        total += weight[:, None] * scene.views[view].image[sight.row, sight.column]
        mass += weight
    known = mass > 0
    colors = np.where(known[:, None], total / np.maximum(mass, 1e-9)[:, None], cloud.colors)
    return replace(cloud, colors=colors)


def seen_elsewhere(scene: Scene, seen: list[Sight], view: int) -> Bools:
    """[H, W] where a view shows surface that another one sees well."""
    photo, own = scene.views[view], seen[view]
    best = np.max([sight.cosine for sight in seen if sight is not own], axis=0)
    good, bad = np.zeros((2, *photo.image.shape[:2]), np.uint8)
    for mask, points in ((good, best > LEAST_COSINE), (bad, best <= LEAST_COSINE)):
        shown = points & (own.cosine > 0)
        mask[own.row[shown], own.column[shown]] = 1
    good = cv2.morphologyEx(good, cv2.MORPH_CLOSE, np.ones((5, 5)))
    return (good > 0) & (cv2.dilate(bad, np.ones((3, 3))) == 0) & photo.valid()


def predict(workspace: Path, view: int, settings: FitConfig, cut: bool) -> Prediction:
    """Fit two photographs, or what is left of three, and look from where the other was taken."""
    shown = 3 if cut else 2
    scene, resolved, factor = read_scene(workspace, settings, shown)
    target = scene.targets[view][factor]
    seen = sights(scene)
    mask = seen_elsewhere(scene, seen, view)
    fitted = [0, 1, 2]
    if cut:
        gone = cut_away(mask, LEFT[view])
        photo = scene.views[view]
        masks = {photo.name: photo.valid() & ~gone}
        scene, resolved, factor = read_scene(workspace, settings, shown, masks)
        seen, mask = sights(scene), mask & gone
    else:
        fitted.remove(view)
    rest = replace(scene, cloud=coloured(scene, seen, fitted)).reduced(factor)
    trainer = (rest if cut else rest.without([view])).trainer(resolved, settings.light == "camera")
    trainer.run(None, lambda *_: None)
    for part in trainer.parts:
        part.end(trainer)
    drawn = trainer.look(trainer.viewpoint(scene.cameras[view].cam_from_world[:3], target))
    image = np.clip(trainer.composited(None, drawn), 0, 1)
    photograph = target.colour.target
    small = cv2.resize(
        mask.astype(np.uint8), photograph.shape[:0:-1], interpolation=cv2.INTER_NEAREST
    )
    compared = small > 0
    if cut:
        return Prediction(photograph, image.astype(np.float32), compared, None)
    ratios = [
        (photograph[c] / np.maximum(image[c], 0.02))[compared & (photograph[c] < BRIGHT)]
        for c in range(3)
    ]
    gains = np.array([np.median(ratio) for ratio in ratios])
    predicted = np.clip(image * gains[:, None, None], 0, 1).astype(np.float32)
    return Prediction(photograph, predicted, compared, gains)


def cut_away(mask: Bools, left: tuple[float, float]) -> Bools:
    """[H, W] the columns left and right of the share of a mask [H, W] that is left."""
    first, last = np.quantile(np.flatnonzero(mask) % mask.shape[1], left)
    columns = np.arange(mask.shape[1])
    return np.broadcast_to((columns < first) | (columns > last), mask.shape)


def picture(found: Prediction) -> npt.NDArray[np.uint8]:
    """Photograph and prediction beside each other, dark where they are not compared."""
    sides = [np.where(found.compared, image, image / 3) for image in (found.shown, found.predicted)]
    rgb = np.concatenate(sides, 2).transpose(1, 2, 0)
    return np.round(255 * rgb[..., ::-1]).astype(np.uint8)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("workspaces", nargs="*", type=Path)
    parser.add_argument(
        "--left-out",
        type=int,
        choices=(0, 1, 2),
        default=1,
        help="by order of the views; default 1",
    )
    parser.add_argument("--cut", action="store_true", help="leave out a part of it")
    parser.add_argument("--set", action="append", default=[], metavar="FIELD=VALUE")
    parser.add_argument("--pictures", type=Path)
    parser.add_argument("--threads", type=int, default=2)
    args = parser.parse_args()
    if not args.workspaces:
        print("benchmarks/unseen_photograph.py: nothing to do without a WORKSPACE")
        return
    use_threads(args.threads)
    said = {
        name: yaml.safe_load(value) for name, value in (item.split("=", 1) for item in args.set)
    }
    settings = FitConfig.model_validate({**FIXED, "initial_points": POINTS, **said})
    scores = []
    for workspace in args.workspaces:
        found = predict(workspace, args.left_out, settings, args.cut)
        scores.append(found.psnr)
        gains = ""
        if found.gains is not None:
            gains = ", gains " + ", ".join(f"{gain:.2f}" for gain in found.gains)
        share = found.compared.mean()
        print(f"{workspace.name}: {found.psnr:.2f} dB on {share:.0%} of it{gains}", flush=True)
        if args.pictures:
            args.pictures.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(args.pictures / f"{workspace.name}.jpg"), picture(found))
    low, high = min(scores), max(scores)
    print(f"mean {np.mean(scores):.2f} dB ({low:.2f} to {high:.2f}), {len(scores)} cases")


if __name__ == "__main__":
    main()
