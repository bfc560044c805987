"""`pictures`: what a stage draws for people to check at a glance, such as labelled photographs."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar, Self

import numpy as np
import numpy.typing as npt

from pipeline.artifacts.base import Artifact
from pipeline.artifacts.views import decoded_png, write_png

Picture = npt.NDArray[np.uint8]


class PicturesIn(Mapping[str, Picture]):
    """The PNG files of a folder: name without suffix -> picture, decoded when it is asked for.

    The files may be gone by then.
    """

    def __init__(self, folder: Path) -> None:
        self._files = {
            path.stem: (path.read_bytes(), path) for path in sorted(folder.glob("*.png"))
        }

    def __getitem__(self, name: str) -> Picture:
        return decoded_png(*self._files[name])

    def __iter__(self) -> Iterator[str]:
        return iter(self._files)

    def __len__(self) -> int:
        return len(self._files)


@dataclass(frozen=True)
class Pictures(Artifact):
    """Pictures of one stage's work.

    Attributes:
        images: name (a file name without suffix) -> [H, W, 3] uint8 sRGB.
    """

    kind: ClassVar[str] = "pictures"
    images: Mapping[str, Picture] = field(default_factory=dict)

    def save(self, folder: Path) -> None:
        for name, image in sorted(self.images.items()):
            write_png(folder / f"{name}.png", image)

    @classmethod
    def load(cls, folder: Path) -> Self:
        return cls(PicturesIn(folder))
