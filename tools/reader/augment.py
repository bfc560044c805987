"""From a labelled photograph to what the network sees: framed, turned, lit otherwise."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt
from brackets import draw_braces
from network import CENTRE_UNIT, HEIGHT, WIDTH
from samples import MIRRORED, UNNUMBERED, UNTOLD, Sample

Array = npt.NDArray[np.float32]
#: Brightness 0..1 is brought to about zero mean and unit spread.
MEAN, SPREAD = 0.45, 0.25
#: So many photographs get braces drawn onto them.
BRACES = 0.2


@dataclass(frozen=True)
class Example:
    """One input with what the answer should be.

    Attributes:
        image: [3, HEIGHT, WIDTH] float32, normalised; 0 outside the photograph.
        tooth, inside: [h, w] float32 0..1, at half the size.
        border: [h, w] float32: 1 where two crowns touch.
        centre: [2, h, w] float32 offset to the crown's centre in units.
        crowns: [h, w] uint8 one number per crown, 0: no tooth.
        number: [h, w] uint8 FDI, `UNNUMBERED` or 0.
        valid: [h, w] float32: inside the photograph, where the labels say something.
        tissue: [h, w] uint8, as in `Sample`.
        view, bite: as in `Sample`.
    """

    image: Array
    tooth: Array
    inside: Array
    border: Array
    centre: Array
    crowns: npt.NDArray[np.uint8]
    number: npt.NDArray[np.uint8]
    valid: Array
    tissue: npt.NDArray[np.uint8]
    view: int
    bite: int


def frame(shape: tuple[int, int]) -> npt.NDArray[np.float64]:
    """[2, 3] transform that fits a picture of a shape (height, width) into the input's middle."""
    height, width = shape
    scale = min(WIDTH / width, HEIGHT / height)
    return np.array(
        [[scale, 0, (WIDTH - scale * width) / 2], [0, scale, (HEIGHT - scale * height) / 2]]
    )


def _random_frame(sample: Sample, rng: np.random.Generator) -> npt.NDArray[np.float64]:
    height, width = sample.teeth.shape
    x, y, w, h = 0, 0, width, height
    sort = rng.random()
    if sort < 0.15 and sample.teeth.any():
        # A crown and its neighbours: where nothing can be counted, only looks tell.
        crown = rng.choice(np.unique(sample.crowns)[1:])
        x, y, w, h = cv2.boundingRect((sample.crowns == crown).astype(np.uint8))
        wide = max(w, h) * rng.uniform(3.0, 6.0)
        x, y, w, h = x + (w - wide) / 2, y + (h - 0.75 * wide) / 2, wide, 0.75 * wide
    elif sort < 0.6 and sample.teeth.any():
        # As the second look of the reader does it: the teeth fill the picture.
        x, y, w, h = cv2.boundingRect((sample.teeth > 0).astype(np.uint8))
        w, h = w * 1.25, h * 1.25 + 0.1 * w
        x, y = x - 0.1 * w, y - 0.15 * h
    scale = min(WIDTH / w, HEIGHT / h) * np.exp(rng.uniform(-0.45, 0.35))
    angle = rng.uniform(-45, 45) if rng.random() < 0.25 else rng.normal(0, 10)
    transform = cv2.getRotationMatrix2D((x + w / 2, y + h / 2), angle, scale)
    transform[:, 2] += [WIDTH / 2 - x - w / 2, HEIGHT / 2 - y - h / 2]
    transform[:, 2] += rng.uniform(-0.12, 0.12, 2) * [WIDTH, HEIGHT]
    squeeze = np.exp(rng.normal(0, 0.1))
    transform[0] *= squeeze
    transform[0, 2] += WIDTH / 2 * (1 - squeeze)
    return np.asarray(transform)


def _relit(image: npt.NDArray[np.uint8], rng: np.random.Generator) -> npt.NDArray[np.uint8]:
    """Other exposure, contrast, white balance, saturation; blur, highlights, things in front."""
    levels = np.linspace(1 / 512, 1, 256)
    gamma = np.exp(rng.normal(0, 0.25))
    gain = np.exp(rng.normal(0, 0.18) + rng.normal(0, 0.10, 3))
    contrast, middle = np.exp(rng.normal(0, 0.15)), rng.uniform(0.3, 0.6)
    curves = [np.clip((levels**gamma * g - middle) * contrast + middle, 0, 1) * 255 for g in gain]
    image = cv2.LUT(image, np.stack(curves, -1)[None].astype(np.uint8))
    if rng.random() < 0.5:
        grey = cv2.cvtColor(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), cv2.COLOR_GRAY2RGB)
        share = rng.uniform(-0.35, 0.6)
        image = cv2.addWeighted(image, 1 - share, grey, share, 0)
    if rng.random() < 0.25:
        image = cv2.GaussianBlur(image, (0, 0), rng.uniform(0.4, 1.8))
    if rng.random() < 0.15:
        small = rng.uniform(0.35, 0.8)
        shrunk = cv2.resize(image, None, fx=small, fy=small, interpolation=cv2.INTER_AREA)
        image = cv2.resize(shrunk, image.shape[1::-1], interpolation=cv2.INTER_LINEAR)
    if rng.random() < 0.4:
        noise = rng.normal(0, rng.uniform(1, 9), (HEIGHT // 2, WIDTH // 2, 3)).astype(np.float32)
        noise = (
            cv2.resize(noise, (WIDTH, HEIGHT)) if rng.random() < 0.5 else np.tile(noise, (2, 2, 1))
        )
        image = cv2.add(image, noise, dtype=cv2.CV_8U)
    if rng.random() < 0.3:
        _highlights(image, rng)
    if rng.random() < 0.15:
        quality = [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(25, 80))]
        image = cv2.imdecode(cv2.imencode(".jpg", image, quality)[1], cv2.IMREAD_COLOR)
    return image


def _highlights(image: npt.NDArray[np.uint8], rng: np.random.Generator) -> None:
    """Wet spots, in place."""
    for _ in range(int(rng.integers(1, 12))):
        centre = (int(rng.integers(WIDTH)), int(rng.integers(HEIGHT)))
        axes = (int(rng.integers(1, 9)), int(rng.integers(1, 5)))
        cv2.ellipse(image, centre, axes, rng.uniform(0, 180), 0, 360, (255, 255, 250), -1,
                    cv2.LINE_AA)  # fmt: skip


def _probe(image: npt.NDArray[np.uint8], rng: np.random.Generator) -> npt.NDArray[np.uint8]:
    """Draw a metal probe in place; returns [HEIGHT, WIDTH] uint8, 1 where it is."""
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    start = np.array([rng.uniform(0, WIDTH), 0 if rng.random() < 0.7 else HEIGHT])
    tip = np.array([rng.uniform(0.2, 0.8) * WIDTH, rng.uniform(0.3, 0.8) * HEIGHT])
    bend = tip + rng.normal(0, 25, 2)
    path = np.stack([start, bend, tip]).astype(np.int32)
    thick = int(rng.integers(2, 6))
    cv2.polylines(mask, [path], False, 1, thick, cv2.LINE_8)
    shade = rng.integers(20, 200)
    colour = tuple(int(c) for c in np.clip(shade + rng.normal(0, 8, 3), 0, 255))
    cv2.polylines(image, [path], False, colour, thick, cv2.LINE_AA)
    cv2.polylines(image, [path - [1, 0]], False, (235, 235, 235), 1, cv2.LINE_AA)
    return mask


def example(sample: Sample, rng: np.random.Generator | None) -> Example:
    """A photograph as the network sees it.

    Args:
        sample: the photograph.
        rng: changes it at random; None: as the reader's first look frames it.
    """
    shape = sample.teeth.shape
    transform = frame((shape[0], shape[1])) if rng is None else _random_frame(sample, rng)
    flip = rng is not None and rng.random() < 0.5
    scale = float(np.sqrt(abs(np.linalg.det(transform[:, :2]))))
    source = sample.image
    if scale < 0.7:
        source = cv2.blur(source, (max(1, round(1 / scale)),) * 2)
    # OpenCV counts pixel centres as whole numbers.
    whole = transform.copy()
    whole[:, 2] += whole[:, :2] @ [0.5, 0.5] - 0.5
    half = transform * 0.5
    half[:, 2] += half[:, :2] @ [0.5, 0.5] - 0.5
    size, small = (WIDTH, HEIGHT), (WIDTH // 2, HEIGHT // 2)
    image = cv2.warpAffine(source, whole, size, flags=cv2.INTER_LINEAR)
    inside = cv2.warpAffine(sample.inside, half, small, flags=cv2.INTER_LINEAR)
    crowns = cv2.warpAffine(sample.crowns, half, small, flags=cv2.INTER_NEAREST)
    number = cv2.warpAffine(sample.teeth, half, small, flags=cv2.INTER_NEAREST)
    tooth = cv2.warpAffine((sample.teeth > 0).astype(np.float32), half, small)
    ones = np.ones(shape, np.uint8)
    seen = cv2.warpAffine(ones, whole, size, flags=cv2.INTER_NEAREST)
    told = cv2.warpAffine(sample.told, half, small, flags=cv2.INTER_NEAREST)
    tissue = cv2.warpAffine(sample.tissue, half, small, flags=cv2.INTER_NEAREST, borderValue=UNTOLD)
    view, bite = sample.view, sample.bite
    if rng is not None:
        image = np.ascontiguousarray(image)
        if rng.random() < BRACES:
            draw_braces(image, sample, transform, rng)
        image = _relit(image, rng)
        if rng.random() < 0.15:
            hidden = cv2.resize(_probe(image, rng), small, interpolation=cv2.INTER_AREA) > 0
            for part in (tooth, inside, number, crowns):
                part[hidden] = 0
            tissue[hidden & (tissue != UNTOLD)] = 0
    if flip:
        image, inside, crowns, tooth, seen, told, tissue = (
            np.ascontiguousarray(part[:, ::-1])
            for part in (image, inside, crowns, tooth, seen, told, tissue)
        )
        number = MIRRORED[number[:, ::-1]]
        view = {1: 2, 2: 1}.get(view, view)
    if rng is not None and rng.random() < 0.08:
        image, inside, crowns, tooth, seen, told, tissue = (
            np.ascontiguousarray(part[::-1])
            for part in (image, inside, crowns, tooth, seen, told, tissue)
        )
        number = np.where(number[::-1] > 0, UNNUMBERED, 0).astype(np.uint8)
        view = bite = -1
    normal = (image.astype(np.float32) / 255 - MEAN) / SPREAD * seen[..., None]
    return Example(
        image=np.ascontiguousarray(normal.transpose(2, 0, 1)),
        tooth=np.asarray(tooth, np.float32),
        inside=inside.astype(np.float32) / 255,
        border=_borders(crowns),
        centre=_offsets(crowns),
        crowns=np.ascontiguousarray(crowns),
        number=np.ascontiguousarray(number),
        valid=(seen[::2, ::2] * told).astype(np.float32),
        tissue=tissue,
        view=view,
        bite=bite,
    )


def _borders(crowns: npt.NDArray[np.uint8]) -> Array:
    """[h, w] 1 where pixels of two crowns lie within one pixel."""
    around = np.ones((3, 3), np.uint8)
    highest = cv2.dilate(crowns, around)
    lowest = 255 - cv2.dilate(np.where(crowns > 0, 255 - crowns, 0).astype(np.uint8), around)
    return ((highest > 0) & (highest != lowest)).astype(np.float32)


def _offsets(crowns: npt.NDArray[np.uint8]) -> Array:
    """[2, h, w] from each pixel to the centre of its crown, in units of `CENTRE_UNIT`."""
    height, width = crowns.shape
    flat = crowns.ravel()
    count = np.maximum(np.bincount(flat, minlength=256), 1)
    result = np.empty((2, height, width), np.float32)
    for axis, grid in enumerate(np.meshgrid(np.arange(width), np.arange(height))):
        middle = np.bincount(flat, grid.ravel(), minlength=256) / count
        result[axis] = (middle[crowns] - grid) / CENTRE_UNIT * (crowns > 0)
    return result
