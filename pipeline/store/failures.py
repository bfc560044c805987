"""Why stages failed, and what they drew and made before they did."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pipeline.artifacts import artifact_class
from pipeline.store.faults import is_full
from pipeline.store.places import is_folder, remove, set_aside, stage_folder
from pipeline.store.records import DamagedError, Failure, read_record, write_sealed

FAILURE = "failure.json"
EVIDENCE = "failure"


class Failures:
    """The failures in one workspace folder, each until its stage succeeds or fails again."""

    def __init__(self, root: Path) -> None:
        self._root = root

    def record(self, stage: str, key: str, message: str) -> None:
        """Remember why a stage failed, for `status`. A full disk must not hide the first error, and
        a workspace that has gone is not begun anew for this."""
        if not self._root.is_dir():
            return
        path = stage_folder(self._root, stage) / FAILURE
        try:
            if is_folder(path):
                set_aside(path)
            write_sealed(path, {"key": key, "message": message})
        except OSError as error:
            if not is_full(error):
                raise

    def of(self, stage: str) -> dict[str, Any] | None:
        """What was recorded last: key and message; None if no run has failed since it succeeded."""
        try:
            failure = read_record(self._root / stage / FAILURE, Failure)
        except DamagedError:  # the stage will be tried again
            return None
        return failure.model_dump() if failure else None

    def keep(self, stage: str, images: Mapping[str, Any], artifacts: Mapping[str, Any]) -> Path:
        """Keep what a failed stage drew and made, instead of what an earlier failure left.

        Args:
            images: name -> picture of the trouble.
            artifacts: kind -> artifact that was made, but isn't safe.
        """
        from pipeline.artifacts.pictures import Pictures

        folder = self._root / stage / EVIDENCE
        remove(folder)
        if images or artifacts:
            folder.mkdir(parents=True)
        if images:
            Pictures(images).save(folder)
        for kind, artifact in artifacts.items():
            (folder / kind).mkdir()
            artifact.save(folder / kind)
        return folder

    def evidence(self, stage: str, kind: str) -> Any:
        """The artifact that was last kept of a failed stage, or None."""
        folder = self._root / stage / EVIDENCE / kind
        return artifact_class(kind).load(folder) if folder.is_dir() else None
