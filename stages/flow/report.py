"""What the page about a run says of the flow."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.artifacts.flow import Flow
from pipeline.artifacts.views import to_uint8
from pipeline.pages.page import number
from pipeline.pages.parts import Block, Grid, Heading, Legend, Section
from pipeline.pages.pictures import SMALL, picture
from pipeline.stage import Parts

if TYPE_CHECKING:
    from pipeline.pages.case import Case

Image = npt.NDArray[np.uint8]

#: Pairs on the page at most, and the long side of each picture.
MOST_PAIRS, MEDIUM = 6, SMALL + 100


def pairs(case: Case) -> Iterator[Section]:
    """Some pairs: the photograph, the flow in colours, and where it is trusted."""
    artifact: Flow | None = case.latest("flow")
    if artifact is None or not len(artifact):
        return
    views = case.latest("views")
    by_name = views.by_name() if views else {}
    labels = case.labels
    wheel = picture(flow_wheel(), "Colour wheel: hue is direction, saturation is length.")
    blocks: list[Block] = [
        Legend(
            wheel, "Hue is the direction in which a spot moves to the next photograph, saturation "
            "how far. Grey is not trusted: the two directions of flow disagree there, or it is "
            "masked, without texture, or hidden in the other photograph.",
        )
    ]  # fmt: skip
    step = max(1, -(-len(artifact.pairs) // MOST_PAIRS))
    shown = artifact.pairs[::step]
    for pair in shown:
        trusted, largest = flow_colors(pair.forward, pair.mask_forward)
        full, _ = flow_colors(pair.forward, largest=largest)
        first, second = labels.get(pair.name_i, pair.name_i), labels.get(pair.name_j, pair.name_j)
        share = float(pair.mask_forward.mean())
        tiles = []
        if pair.name_i in by_name:
            image = to_uint8(by_name[pair.name_i].image)
            tiles.append(picture(image, f"Photograph {first}.", first, MEDIUM))
        tiles += [
            picture(full, f"Flow from {first} to {second} in colours.", "flow", MEDIUM),
            picture(trusted, f"The same, {100 * share:.0f} % of it trusted, the rest grey.",
                    f"trusted: {100 * share:.0f} %", MEDIUM),
        ]  # fmt: skip
        blocks += [
            Heading(f"{first} → {second}", f"full colour: {number(largest, 0)} px"),
            Grid(tiles, "three"),
        ]
    yield Section("Flow", blocks, f"{len(shown)} of {len(artifact)} pairs")


def flow_colors(
    flow: npt.NDArray[np.float32],
    trusted: npt.NDArray[np.bool_] | None = None,
    largest: float | None = None,
) -> tuple[Image, float]:
    """Flow [H, W, 2] as colours: hue is the direction, saturation the length.

    Args:
        flow: pixels.
        trusted: [H, W]; other pixels turn grey.
        largest: the length in pixels that has full saturation; None: that of nearly all.

    Returns:
        ([H, W, 3] uint8, the length in pixels that has full saturation).
    """
    length = np.linalg.norm(flow, axis=-1)
    finite = np.isfinite(length)
    usable = finite if trusted is None or not trusted.any() else finite & trusted
    if largest is None:
        largest = float(np.percentile(length[usable], 98)) if usable.any() else 1.0
    largest = max(largest, 1e-6)
    safe = np.where(finite[..., None], flow, 0)
    angle = (np.degrees(np.arctan2(safe[..., 1], safe[..., 0])) % 360) / 2
    saturation = np.clip(np.where(finite, length, 0) / largest, 0, 1) * 255
    hsv = np.stack([angle, saturation, np.full_like(angle, 245)], -1)
    rgb = np.asarray(cv2.cvtColor(hsv.astype(np.uint8), cv2.COLOR_HSV2RGB))
    if trusted is not None:
        rgb = np.where(trusted[..., None], rgb, np.uint8(110))
    return np.ascontiguousarray(rgb, np.uint8), largest


def flow_wheel(size: int = 96) -> Image:
    """The legend of `flow_colors`: the colour of each direction and length, [size, size, 3]."""
    v, u = np.mgrid[:size, :size].astype(np.float32) - (size - 1) / 2
    disc = np.hypot(u, v) <= size / 2
    wheel, _ = flow_colors(np.stack([u, v], -1), disc)
    return np.where(disc[..., None], wheel, np.uint8(255))


PARTS: Parts = {"flow": pairs}
