"""A result that is in the store."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

#: So much of a key names the folder of its result.
KEY_LENGTH = 12


class CorruptResultError(Exception):
    """Files of a committed result are not what its manifest says. It has been quarantined."""

    def __init__(self, stage: str, message: str) -> None:
        super().__init__(message)
        self.stage = stage


@dataclass(frozen=True)
class Result:
    """A committed result of a stage.

    Attributes:
        stage, key: which one (`key` is the whole sha256).
        folder: where its files are.
        manifest: what `manifest.json` says.
    """

    stage: str
    key: str
    folder: Path
    manifest: dict[str, Any]

    @property
    def contents(self) -> dict[str, str]:
        """Artifact kind -> content hash."""
        return {kind: entry["content"] for kind, entry in self.manifest["outputs"].items()}
