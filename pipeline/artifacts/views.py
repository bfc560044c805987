"""`views`: the prepared input photographs, their masks, and how they relate to the originals."""

from __future__ import annotations

import json
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar, Self

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.artifacts.base import Artifact


@dataclass(frozen=True)
class View:
    """One photograph at working size.

    Attributes:
        name: neutral name, ``"000"``, ``"001"``, ...; the only name that exports may carry.
        image: [H, W, 3] float32 sRGB in 0..1 (8 bits at rest).
        mask: [H, W] bool, True where the pixel may be used, or None for all. Outside it there are
            no points, no matches and no loss.
        working_from_source: [3, 3] float64 affine map of pixel coordinates (centres at .5) from the
            stored pixel grid of the source file (before EXIF orientation) to `image`.
        source_size: (width, height) of that grid.
        source_name: file name, ``video.mp4#123``, or ``sheet.jpg#1`` for the first of several
            photographs in a picture. Stays in the workspace, never exported.
        source_sha256: of the source file's bytes.
        focal_px: focal-length prior in pixels of `image`, or None where nothing is known.
        timestamp: seconds from the start of the video, or None.
        taken_after: by the cameras' clocks, seconds after the first photograph of the case was
            taken (of those that are not held out), or None. The date itself is not kept.
        lens_taken_out: where the image has been undistorted, the lens that it had before, as a line
            of COLMAP's ``cameras.txt`` without number (model, width, height, parameters);
            `working_from_source` then leads to pixels of the image before.
        turned_over: the photograph is a mirror image, and `image` is turned back: left is where the
            photograph has right.
    """

    name: str
    image: npt.NDArray[np.float32]
    mask: npt.NDArray[np.bool_] | None = None
    working_from_source: npt.NDArray[np.float64] = field(default_factory=lambda: np.eye(3))
    source_size: tuple[int, int] = (0, 0)
    source_name: str = ""
    source_sha256: str = ""
    focal_px: float | None = None
    timestamp: float | None = None
    taken_after: float | None = None
    lens_taken_out: str = ""
    turned_over: bool = False

    @property
    def width(self) -> int:
        return int(self.image.shape[1])

    @property
    def height(self) -> int:
        return int(self.image.shape[0])

    @property
    def upright_size(self) -> tuple[int, int]:
        """(width, height) in pixels of the photograph as it was taken, turned upright."""
        width, height = self.source_size
        if min(width, height) <= 0:
            return self.width, self.height
        linear = self.working_from_source[:2, :2]
        lying = abs(linear[0, 1]) > abs(linear[0, 0])  # stored on its side
        return (height, width) if lying else (width, height)

    @property
    def working_from_upright(self) -> npt.NDArray[np.float64]:
        """[3, 3] map of pixel coordinates from the photograph as it was taken, turned upright."""
        if min(self.source_size) <= 0:
            return np.eye(3)
        upright_from_source = np.eye(3)
        turn = np.sign(np.round(self.working_from_source[:2, :2], 9))
        if self.turned_over:
            turn[0] *= -1
        upright_from_source[:2, :2] = turn
        upright_from_source[:2, 2] = -np.minimum(turn, 0) @ self.source_size
        return np.asarray(self.working_from_source @ np.linalg.inv(upright_from_source))

    def working_place(self, upright: tuple[float, float]) -> npt.NDArray[np.float64]:
        """[2] pixel of `image` for a pixel of the upright photograph."""
        return np.asarray((self.working_from_upright @ (*upright, 1.0))[:2])

    def mirrored(self) -> View:
        """The picture turned over, left for right."""
        turned = np.array([[-1.0, 0, self.width], [0, 1, 0], [0, 0, 1]])
        return replace(
            self,
            image=np.ascontiguousarray(self.image[:, ::-1]),
            mask=None if self.mask is None else np.ascontiguousarray(self.mask[:, ::-1]),
            working_from_source=turned @ self.working_from_source,
            turned_over=not self.turned_over,
        )

    def gray(self) -> npt.NDArray[np.uint8]:
        """[H, W] uint8 luma, as feature detectors and optical flow want it."""
        return np.asarray(cv2.cvtColor(to_uint8(self.image), cv2.COLOR_RGB2GRAY))

    def valid(self) -> npt.NDArray[np.bool_]:
        """[H, W] bool: the mask, or all True."""
        return np.ones(self.image.shape[:2], bool) if self.mask is None else self.mask


def to_uint8(image: npt.NDArray[np.floating[Any]]) -> npt.NDArray[np.uint8]:
    """Round an image in 0..1 to 8 bits, clipping what lies outside."""
    return np.asarray(np.clip(np.rint(np.asarray(image) * 255.0), 0, 255), np.uint8)


@dataclass(frozen=True)
class Views(Artifact):
    """All photographs of a case, in viewing order where it is known.

    Attributes:
        views: the photographs; sizes may differ from one to the next.
        ordered: True if their order is the order in which they were taken (a video).
    """

    kind: ClassVar[str] = "views"
    views: tuple[View, ...]
    ordered: bool = False

    def __len__(self) -> int:
        return len(self.views)

    def by_name(self) -> dict[str, View]:
        return {view.name: view for view in self.views}

    def save(self, folder: Path) -> None:
        (folder / "images").mkdir()
        entries = []
        for view in self.views:
            write_png(folder / "images" / f"{view.name}.png", to_uint8(view.image))
            if view.mask is not None:
                (folder / "masks").mkdir(exist_ok=True)
                mask = np.where(view.mask, np.uint8(255), np.uint8(0))
                write_png(folder / "masks" / f"{view.name}.png", mask)
            turned = {"turned_over": True} if view.turned_over else {}
            entries.append(
                {
                    "name": view.name,
                    "width": view.width,
                    "height": view.height,
                    "has_mask": view.mask is not None,
                    "working_from_source": view.working_from_source.tolist(),
                    "source_name": view.source_name,
                    "source_sha256": view.source_sha256,
                    "source_size": list(view.source_size),
                    "focal_px": view.focal_px,
                    "timestamp": view.timestamp,
                    "taken_after": view.taken_after,
                    "lens_taken_out": view.lens_taken_out,
                    **turned,
                }
            )
        text = json.dumps({"ordered": self.ordered, "views": entries}, indent=1)
        (folder / "views.json").write_text(text + "\n")

    @classmethod
    def load(cls, folder: Path) -> Self:
        meta = json.loads((folder / "views.json").read_text())
        views = []
        for entry in meta["views"]:
            name = entry["name"]
            image = read_png(folder / "images" / f"{name}.png")
            mask = read_png(folder / "masks" / f"{name}.png") > 127 if entry["has_mask"] else None
            views.append(
                View(
                    name=name,
                    image=image.astype(np.float32) / np.float32(255),
                    mask=mask,
                    working_from_source=np.asarray(entry["working_from_source"], np.float64),
                    source_size=tuple(entry["source_size"]),
                    source_name=entry["source_name"],
                    source_sha256=entry["source_sha256"],
                    focal_px=entry["focal_px"],
                    timestamp=entry["timestamp"],
                    taken_after=entry.get("taken_after"),
                    lens_taken_out=entry.get("lens_taken_out", ""),
                    turned_over=entry.get("turned_over", False),
                )
            )
        return cls(views=tuple(views), ordered=meta["ordered"])


@dataclass(frozen=True)
class HeldOut(Views):
    """Photographs kept back to test with (`views.held_out`): prepared as the views, but no view.

    Their names begin with h: no view of the case has the name of one.
    """

    kind: ClassVar[str] = "held_out"


def write_png(path: Path, pixels: npt.NDArray[np.uint8]) -> None:
    """Write a grey [H, W] or RGB [H, W, 3] uint8 image without any metadata."""
    ok, data = cv2.imencode(".png", pixels if pixels.ndim == 2 else pixels[..., ::-1])
    if not ok:
        raise ValueError(f"cannot encode an image of shape {pixels.shape} as PNG")
    path.write_bytes(data.tobytes())


def jpeg_bytes(pixels: npt.NDArray[np.uint8], quality: int) -> bytes:
    """An RGB uint8 image [H, W, 3] as JPEG, without any metadata."""
    ok, data = cv2.imencode(".jpg", pixels[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])
    if not ok:
        raise ValueError(f"cannot encode an image of shape {pixels.shape} as JPEG")
    return bytes(data)


def read_png(path: Path) -> npt.NDArray[np.uint8]:
    """Read a PNG as written by `write_png`: [H, W] or RGB [H, W, 3] uint8."""
    return decoded_png(path.read_bytes(), path)


def decoded_png(encoded: bytes, path: Path) -> npt.NDArray[np.uint8]:
    """What `read_png` makes of the bytes of a file; its path is for the message."""
    data = cv2.imdecode(np.frombuffer(encoded, np.uint8), cv2.IMREAD_UNCHANGED)
    if data is None:
        raise ValueError(f"{path} is not a readable PNG")
    return np.ascontiguousarray(data if data.ndim == 2 else data[..., ::-1])
