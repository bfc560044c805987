"""`exports`: the files that leave the workspace: viewer page, splats, mesh, video, cameras."""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Self

from pipeline.artifacts.base import Artifact


@dataclass(frozen=True)
class Exports(Artifact):
    """A folder of finished files. A stage usually writes them straight into its output folder."""

    kind: ClassVar[str] = "exports"
    folder: Path

    def files(self) -> list[Path]:
        return sorted(path for path in self.folder.rglob("*") if path.is_file())

    def save(self, folder: Path) -> None:
        shutil.copytree(self.folder, folder, dirs_exist_ok=True)

    @classmethod
    def load(cls, folder: Path) -> Self:
        return cls(folder)
