"""What the reader learns from: labelled photographs, and mouths of our own generator."""

from __future__ import annotations

import json
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

#: FDI number -> that of the tooth in the same place on the other side.
MIRRORED = np.arange(256, dtype=np.uint8)
for _tooth in range(10, 90):
    _quadrant, _place = divmod(_tooth, 10)
    if 1 <= _quadrant <= 8:
        MIRRORED[_tooth] = 10 * (_quadrant + 1 if _quadrant % 2 else _quadrant - 1) + _place
#: A crown whose number nobody knows.
UNNUMBERED = 255
#: Nobody said whether it is tooth or gum.
UNTOLD = 255
#: What gum is in the labels of generated mouths.
GUM = 1
#: Pictures smaller than this show nothing.
LEAST_SIDE = 60
#: Long side to which pictures are brought.
LONG_SIDE = 720


@dataclass(frozen=True)
class Sample:
    """A labelled photograph.

    Attributes:
        name: where it is from.
        image: [H, W, 3] uint8 RGB.
        crowns: [H, W] uint8, one number per crown, 0: no tooth.
        teeth: [H, W] uint8 FDI numbers; `UNNUMBERED` where not known, 0: no tooth.
        inside: [H, W] uint8: distance to the crown's own border, 255 at its middle.
        told: [H, W] uint8, 0 where the labels say nothing (`unlabelled`), else 1.
        tissue: [H, W] uint8, 1: tooth or gum, 0: something else, `UNTOLD`.
        view: index into `network.VIEWS`, -1: unknown.
        bite: 0 closed, 1 open, -1 unknown.
    """

    name: str
    image: npt.NDArray[np.uint8]
    crowns: npt.NDArray[np.uint8]
    teeth: npt.NDArray[np.uint8]
    inside: npt.NDArray[np.uint8]
    told: npt.NDArray[np.uint8]
    tissue: npt.NDArray[np.uint8]
    view: int
    bite: int


def distance_inside(crowns: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
    """[H, W] distance of each pixel to the border of its own crown, 255 at the crown's middle.

    Args:
        crowns: [H, W] one number per crown, 0: none.
    """
    result = np.zeros(crowns.shape, np.uint8)
    for number in np.unique(crowns):
        if number == 0:
            continue
        x, y, w, h = cv2.boundingRect((crowns == number).astype(np.uint8))
        part = (crowns[y : y + h, x : x + w] == number).astype(np.uint8)
        depth = cv2.distanceTransform(cv2.copyMakeBorder(part, 1, 1, 1, 1, cv2.BORDER_CONSTANT),
                                      cv2.DIST_L2, 5)[1:-1, 1:-1]  # fmt: skip
        whole = result[y : y + h, x : x + w]
        np.maximum(whole, (255 * depth / max(float(depth.max()), 1e-6)).astype(np.uint8), out=whole)
    return result


def _sample(
    name: str, image: npt.NDArray[np.uint8], crowns: npt.NDArray[np.uint8],
    teeth: npt.NDArray[np.uint8], told: npt.NDArray[np.uint8] | None,
    tissue: npt.NDArray[np.uint8] | None, view: int, bite: int,
) -> Sample:  # fmt: skip
    told = np.ones_like(crowns) if told is None else told
    tissue = np.full_like(crowns, UNTOLD) if tissue is None else tissue
    scale = LONG_SIDE / max(image.shape[:2])
    if scale < 1:
        size = (round(image.shape[1] * scale), round(image.shape[0] * scale))
        image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
        crowns = cv2.resize(crowns, size, interpolation=cv2.INTER_NEAREST)
        teeth = cv2.resize(teeth, size, interpolation=cv2.INTER_NEAREST)
        told = cv2.resize(told, size, interpolation=cv2.INTER_NEAREST)
        tissue = cv2.resize(tissue, size, interpolation=cv2.INTER_NEAREST)
    inside = distance_inside(crowns)
    return Sample(name, image, crowns, teeth, inside, told, tissue, view, bite)


def drawn_tissue(
    entry: Mapping[str, list[list[list[float]]]], crowns: npt.NDArray[np.uint8]
) -> npt.NDArray[np.uint8]:
    """[H, W] of `Sample.tissue`, from polygons (shares of width and height) and outlined crowns.

    Args:
        entry: polygons of the `region` of teeth and gum, what is `not` in it, and `unsure`.
        crowns: [H, W] one number per crown, 0: none.
    """
    result = np.zeros(crowns.shape, np.uint8)
    for name, value in (("region", 1), ("not", 0), ("unsure", UNTOLD)):
        for polygon in entry.get(name, []):
            points = np.rint(np.array(polygon) * crowns.shape[::-1] * 16 - 8).astype(np.int32)
            cv2.fillPoly(result, [points], value, cv2.LINE_8, 4)
    result[crowns > 0] = 1
    return result


def read_labelled(
    folder: Path, split: str, views: tuple[str, ...], extra: Path | None = None,
    unlabelled: Path | None = None, tissue: Path | None = None,
) -> list[Sample]:  # fmt: skip
    """The photographs of `split` with an outline per tooth, and numbers where they are known.

    Args:
        folder: of the data set: `train/`, `valid/`, `fdi.json`.
        split: `train` or `valid`.
        views: names of the kinds of photographs.
        extra: further numbers in the form of `fdi.json`.
        unlabelled: folder that says where teeth have no outline (`unlabelled.py`).
        tissue: JSON file that outlines teeth and gum of some of them (`drawn_tissue`).
    """
    drawn = {} if tissue is None else json.loads(tissue.read_text())
    known = json.loads((folder / "fdi.json").read_text())
    if extra is not None:
        known = {**json.loads(extra.read_text()), **known}

    def read(path: Path) -> Sample | None:
        image = cv2.imread(str(path.with_suffix(".jpg")))
        crowns = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        if image is None or min(image.shape[:2]) < LEAST_SIDE:
            return None
        label = known.get(f"{split}/{path.stem}", {})
        numbers = np.full(256, UNNUMBERED, np.uint8)
        numbers[0] = 0
        for crown, tooth in label.get("fdi", {}).items():
            if int(crown) not in label.get("unsure", []):
                numbers[int(crown)] = tooth
        view = label.get("view", "")
        if view == "occlusal":
            quadrants = {int(tooth) // 10 for tooth in label["fdi"].values()}
            view = "upper" if quadrants <= {1, 2, 5, 6} else "lower"
        bite = {"closed": 0, "open": 1}.get(label.get("bite", ""), -1)
        told = None
        if unlabelled is not None:
            hidden = cv2.imread(str(unlabelled / path.name), cv2.IMREAD_GRAYSCALE)
            if hidden is None:
                raise FileNotFoundError(f"{unlabelled} lacks {path.name}: run unlabelled.py again")
            told = (hidden == 0).astype(np.uint8)
        entry = drawn.get(f"{split}/{path.stem}")
        return _sample(
            f"{split}/{path.stem}", np.ascontiguousarray(image[..., ::-1]), crowns,
            numbers[crowns], told, drawn_tissue(entry, crowns) if entry else None,
            views.index(view) if view in views else -1, bite,
        )  # fmt: skip

    with ThreadPoolExecutor() as pool:
        samples = pool.map(read, sorted((folder / split).glob("*.png")))
        return [sample for sample in samples if sample is not None]


def read_generated(folder: Path, views: tuple[str, ...]) -> list[Sample]:
    """Photographs of generated mouths (`data_samples/mouths`): every number is known.

    Occlusal ones say nothing of tissue: a palate is neither.
    """
    index = json.loads((folder / "index.json").read_text())

    def read(name: str) -> Sample:
        image = cv2.imread(str(folder / f"{name}.jpg"))
        labels = cv2.imread(str(folder / f"{name}.png"), cv2.IMREAD_GRAYSCALE)
        teeth = np.where(labels == GUM, 0, labels).astype(np.uint8)
        entry = index[name]
        occlusal = entry["view"] in ("upper", "lower")
        return _sample(
            name, np.ascontiguousarray(image[..., ::-1]), teeth, teeth, None,
            None if occlusal else (labels > 0).astype(np.uint8),
            views.index(entry["view"]), {"closed": 0, "open": 1}[entry["bite"]],
        )  # fmt: skip

    with ThreadPoolExecutor() as pool:
        return list(pool.map(read, sorted(index)))
