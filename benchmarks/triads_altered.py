"""The triads as other cameras and other hands would have taken them: for `triads.py --data`.

    python benchmarks/triads_altered.py --data DIR --out OUT [--seed 0] [--sorts balance,turned,...]

Writes OUT/triads/CASE__SORT/ with three altered photographs and their truth, one folder for each
patient and sort. Twelve patients are few; whatever fails on one of these would fail on a
thirteenth. Truth points that leave the picture are left out.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
from triads_data import SLOTS

Floats = npt.NDArray[np.float64]
Rng = np.random.Generator
#: sRGB in 0..1 and the affine map [2, 3] of its pixels -> both altered.
Altered = tuple[Floats, Floats]
#: A truth point nearer to the border than this share of the picture is left out.
MARGIN = 0.01
#: Of linear sRGB.
LUMINANCE = np.array([0.2126, 0.7152, 0.0722])


def _linear(image: Floats) -> Floats:
    return np.where(image <= 0.04045, image / 12.92, ((image + 0.055) / 1.055) ** 2.4)


def _encoded(light: Floats) -> Floats:
    light = np.clip(light, 0, 1)
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)


def _warped(image: Floats, change: Floats, size: tuple[int, int]) -> Floats:
    return cv2.warpAffine(
        image, change, size, flags=cv2.INTER_AREA, borderMode=cv2.BORDER_REFLECT_101
    ).astype(np.float64)


def balance(image: Floats, rng: Rng) -> Altered:
    """Each photograph with a white balance of its own, as phones choose it (8 % a channel)."""
    gains = np.exp(rng.normal(size=3) * 0.08)
    return _encoded(_linear(image) * gains / gains.mean()), np.eye(2, 3)


def exposure(image: Floats, rng: Rng) -> Altered:
    """Up to a stop darker, or .4 brighter, with a tone curve of its own."""
    light = _linear(image) * 2 ** rng.uniform(-1, 0.4)
    return _encoded(light) ** np.exp(rng.normal() * 0.12), np.eye(2, 3)


def turned(image: Floats, rng: Rng) -> Altered:
    """Tilted by up to 15 degrees and cut to what stays whole in the middle."""
    height, width = image.shape[:2]
    change = cv2.getRotationMatrix2D((width / 2, height / 2), rng.uniform(-15, 15), 1.08)
    return _warped(image, change, (width, height)), change


def cut(image: Floats, rng: Rng) -> Altered:
    """Cut tighter: up to a twelfth from each side."""
    height, width = image.shape[:2]
    left, right = rng.uniform(0, 1 / 12, 2) * width
    top, bottom = rng.uniform(0, 1 / 12, 2) * height
    change = np.array([[1, 0, -left], [0, 1, -top]])
    return _warped(image, change, (int(width - left - right), int(height - top - bottom))), change


def small(image: Floats, rng: Rng) -> Altered:
    """Sent by a messenger: 480 pixels, much compressed."""
    height, width = image.shape[:2]
    scale = 480 / max(height, width)
    reduced = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    quality = [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(40, 60))]
    pixels = np.round(reduced[..., ::-1] * 255).astype(np.uint8)
    data = cv2.imencode(".jpg", pixels, quality)[1]
    decoded = cv2.imdecode(data, cv2.IMREAD_COLOR)[..., ::-1] / 255
    return decoded, np.array([[scale, 0, 0], [0, scale, 0]])


def soft(image: Floats, rng: Rng) -> Altered:
    """Out of focus a little (1/700 of the long side) and noisy (2 %)."""
    sigma = max(image.shape) / 700
    blurred = cv2.GaussianBlur(image, (0, 0), sigma)
    return np.clip(blurred + rng.normal(size=image.shape) * 0.02, 0, 1), np.eye(2, 3)


def everything(image: Floats, rng: Rng) -> Altered:
    """Each of the others (but `small`) or not, by the toss of a coin."""
    change = np.eye(2, 3)
    for alter in (balance, exposure, turned, cut, soft):
        if rng.random() < 0.5:
            continue
        image, step = alter(image, rng)
        change = step @ np.vstack([change, (0, 0, 1)])
    return image, change


def over(image: Floats, rng: Rng) -> Altered:
    """Each upside down or not, by the toss of a coin: a phone held flat can't tell."""
    height, width = image.shape[:2]
    if rng.random() < 0.5:
        return image, np.eye(2, 3)
    return image[::-1, ::-1], np.array([[-1.0, 0, width], [0, -1, height]])


def grey(image: Floats, rng: Rng) -> Altered:
    """Black and white."""
    light = _linear(image) @ LUMINANCE
    return np.repeat(_encoded(light)[..., None], 3, axis=2), np.eye(2, 3)


def bright(image: Floats, rng: Rng) -> Altered:
    """A stop too bright: enamel in the flash is white."""
    return _encoded(2 * _linear(image)), np.eye(2, 3)


def dark(image: Floats, rng: Rng) -> Altered:
    """Two stops too dark, with the noise of that."""
    noisy = _encoded(_linear(image) / 4) + rng.normal(size=image.shape) * 0.02
    return np.clip(noisy, 0, 1), np.eye(2, 3)


def hazy(image: Floats, rng: Rng) -> Altered:
    """Through breath on the lens: a quarter of the light scattered all over, some of it near by."""
    light = _linear(image)
    around = cv2.GaussianBlur(light, (0, 0), max(image.shape) / 20)
    veil = 0.5 * around + 0.5 * light.mean()
    return _encoded(0.75 * light + 0.25 * veil + 0.05), np.eye(2, 3)


def warm(image: Floats, rng: Rng) -> Altered:
    """Under a lamp of 3,200 K that the camera took for daylight."""
    return _encoded(_linear(image) * (1.35, 1.0, 0.6)), np.eye(2, 3)


def vivid(image: Floats, rng: Rng) -> Altered:
    """As phones beautify: colours and contrast half as strong again, edges sharpened."""
    grey_ = image.mean(axis=2, keepdims=True)
    strong = grey_ + 1.5 * (image - grey_)
    strong = strong.mean() + 1.3 * (strong - strong.mean())
    near = cv2.GaussianBlur(strong, (0, 0), max(image.shape) / 500)
    return np.clip(strong + 0.8 * (strong - near), 0, 1), np.eye(2, 3)


def flash(image: Floats, rng: Rng) -> Altered:
    """A flash that lights the middle: corners two stops darker, each photograph's elsewhere."""
    height, width = image.shape[:2]
    x, y = rng.uniform(0.35, 0.65, 2) * (width, height)
    v, u = np.mgrid[:height, :width]
    far = np.hypot(u - x, v - y) / (np.hypot(width, height) / 2)
    return _encoded(_linear(image) * (1.3 * 2 ** (-2 * far**2))[..., None]), np.eye(2, 3)


SORTS: dict[str, Callable[[Floats, Rng], Altered]] = {
    made.__name__: made
    for made in (
        balance, exposure, turned, cut, small, soft, everything, over, grey, bright, dark, hazy,
        warm, vivid, flash,
    )
}  # fmt: skip


def _moved(entry: dict[str, Any], size: tuple[int, int], altered: Altered) -> dict[str, Any] | None:
    """A truth point in the altered photograph; None where that does not show it."""
    image, change = altered
    at = change @ (entry["x"] * size[0], entry["y"] * size[1], 1)
    x, y = at / image.shape[1::-1]
    inside = min(x, y) > MARGIN and max(x, y) < 1 - MARGIN
    return {**entry, "x": float(x), "y": float(y)} if inside else None


def write_case(case: Path, folder: Path, alter: Callable[[Floats, Rng], Altered], rng: Rng) -> None:
    """One patient, altered in one way."""
    truth = json.loads((case / "truth.json").read_text())
    folder.mkdir(parents=True, exist_ok=True)
    for stem in SLOTS:
        image = cv2.imread(str(case / f"{stem}.jpg"))[..., ::-1] / 255
        altered = alter(image, rng)
        size = (image.shape[1], image.shape[0])
        moved = (_moved(entry, size, altered) for entry in truth["photos"][stem])
        truth["photos"][stem] = [entry for entry in moved if entry is not None]
        pixels = np.round(np.clip(altered[0][..., ::-1], 0, 1) * 255).astype(np.uint8)
        cv2.imwrite(str(folder / f"{stem}.jpg"), pixels, [cv2.IMWRITE_JPEG_QUALITY, 92])
    (folder / "truth.json").write_text(json.dumps(truth))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, required=True, help="folder with triads/")
    parser.add_argument("--out", type=Path, required=True, help="where triads/ is written")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--sorts", default=",".join(SORTS), help=f"some of {', '.join(SORTS)}")
    options = parser.parse_args()
    for number, case in enumerate(sorted((options.data / "triads").iterdir())):
        for sort in options.sorts.split(","):
            rng = np.random.default_rng((options.seed, number, list(SORTS).index(sort)))
            write_case(case, options.out / "triads" / f"{case.name}__{sort}", SORTS[sort], rng)


if __name__ == "__main__":
    main()
