"""Which result of each stage is in use: `current.json` in the stage's folder."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from pipeline.errors import RequestError
from pipeline.store.places import is_folder, set_aside
from pipeline.store.records import (
    MANIFEST,
    DamagedError,
    Pointer,
    read_manifest,
    read_record,
    write_sealed,
)
from pipeline.store.results import KEY_LENGTH
from pipeline.untrusted.own import POINTER


class Pointers:
    """The pointers of a workspace.

    Args:
        root: the workspace.
        say: told of a damaged one.
    """

    def __init__(self, root: Path, say: Callable[[str], None]) -> None:
        self._root = root
        self._say = say

    def read(self, stage: str) -> dict[str, Any] | None:
        """The key in use and why it came to be; None: there is none.

        Where it is not what was written, the only result there is is the one in use.
        """
        path = self._root / stage / POINTER
        try:
            pointer = read_record(path, Pointer)
        except DamagedError as error:
            self._say(f"{path} is damaged ({error}); it will be written anew.")
            return self._only_one(stage)
        return pointer.model_dump() if pointer else None

    def _only_one(self, stage: str) -> dict[str, Any] | None:
        folder = self._root / stage
        keys = []
        for path in folder.glob(f"*/{MANIFEST}"):
            with suppress(DamagedError):
                keys.append((read_manifest(path) or {}).get("key", ""))
        keys = [k for k in keys if isinstance(k, str) and (folder / k[:KEY_LENGTH]).is_dir()]
        return {"key": keys[0], "reasons": []} if len(keys) == 1 else None

    def is_known(self, stage: str) -> bool:
        """Can it be told which result is in use, or that none is?"""
        try:
            self.require(stage)
        except RequestError:
            return False
        return True

    def require(self, stage: str) -> None:
        """Nothing, if it can be told which result is in use, or that none is.

        Raises:
            RequestError: it can't.
        """
        path = self._root / stage / POINTER
        try:
            read_record(path, Pointer)
        except DamagedError as error:
            raise RequestError(
                f"Which result of '{stage}' is in use is not known any more: {path} is damaged "
                f"({error}). Run the command without --stages and --from and with the photographs "
                "named: every result that is there is used again."
            ) from error

    def write(self, stage: str, key: str, reasons: list[str]) -> None:
        """Say that a result is the one in use."""
        path = self._root / stage / POINTER
        pointer = {"key": key, "reasons": reasons}
        try:
            found = read_record(path, Pointer)
        except DamagedError:
            found = None
        if found is None or found.model_dump() != pointer:
            if is_folder(path):
                set_aside(path)
            write_sealed(path, pointer)
