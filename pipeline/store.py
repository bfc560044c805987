"""The artifact store: content keys, atomic commit, manifest, checksums, locks.

Layout of a workspace::

    WORKSPACE/<stage>/<key12>/            one result, immutable: a folder per artifact kind
    WORKSPACE/<stage>/<key12>/manifest.json   written last; without it the result never existed
    WORKSPACE/<stage>/<key12>.partial/    being written; `scratch/` inside survives a kill
    WORKSPACE/<stage>/current.json        which result is in use
    WORKSPACE/<stage>/failure.json        why the last try failed, until one succeeds
    WORKSPACE/<stage>/failure/            pictures that show it, and a folder per artifact kind of
                                          what was made but isn't safe, where there are any
    WORKSPACE/request.json                what was asked for last
    WORKSPACE/results                     link to the exports in use
    WORKSPACE/report.html                 what the last run did, for people
    WORKSPACE/check.html                  the teeth found, to put right; WORKSPACE/teeth.yaml: so
"""

from __future__ import annotations

import errno
import json
import os
import shutil
import socket
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from pipeline.artifacts import artifact_class
from pipeline.errors import RequestError
from pipeline.files import (
    content_hash,
    folder_listing,
    fsync_folder,
    fsync_tree,
    read_json,
    remove_leftovers,
    sha256_file,
    temporary_beside,
    write_atomic,
    write_json,
)

MANIFEST = "manifest.json"
KEY_LENGTH = 12
DISPLACED = ".replaced"


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


class Store:
    """The results in one workspace folder."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self._verified: set[tuple[str, str, str]] = set()

    def create(self) -> None:
        """Make the workspace folder, and clear half-written files of killed runs out of it.

        Raises:
            RequestError: it can't be made or written to.
        """
        try:
            self.root.mkdir(parents=True, exist_ok=True)
            probe = temporary_beside(self.root / "write-test")
            probe.write_text("")
            probe.unlink()
            remove_leftovers(self.root)
        except OSError as error:
            raise RequestError(
                f"The workspace {self.root} can't be written to ({_reason(error)}). Choose another "
                "folder with -w, or mend its permissions."
            ) from error

    def folder(self, stage: str, key: str) -> Path:
        return self.root / stage / key[:KEY_LENGTH]

    # -- finding ---------------------------------------------------------------------------------

    def find(self, stage: str, key: str) -> Result | None:
        """Return the committed result of a key, or None.

        Sizes of all files are checked; a result that fails is moved aside, so that it is made anew.
        """
        folder = self.folder(stage, key)
        if not folder.exists():
            return None
        manifest = read_json(folder / MANIFEST)
        if not isinstance(manifest, dict) or manifest.get("key") != key:
            self.quarantine(stage, folder)
            return None
        for name, entry in _files(manifest):
            path = folder / name
            if not path.is_file() or path.stat().st_size != entry["size"]:
                self.quarantine(stage, folder)
                return None
        return Result(stage, key, folder, manifest)

    def current(self, stage: str) -> Result | None:
        """Return the result in use, or None."""
        pointer = self.pointer(stage)
        return self.find(stage, pointer["key"]) if pointer else None

    def pointer(self, stage: str) -> dict[str, Any] | None:
        """What `current.json` says: the key in use and why it came to be."""
        pointer = read_json(self.root / stage / "current.json")
        return pointer if isinstance(pointer, dict) and "key" in pointer else None

    def use(self, result: Result, reasons: list[str] | None = None) -> None:
        """Make a result the one in use."""
        pointer = {"key": result.key, "reasons": reasons or []}
        if self.pointer(result.stage) != pointer:
            write_json(self.root / result.stage / "current.json", pointer)
        (self.root / result.stage / "failure.json").unlink(missing_ok=True)
        shutil.rmtree(self.root / result.stage / "failure", ignore_errors=True)

    def quarantine(self, stage: str, folder: Path) -> Path:
        """Move a damaged result aside. It is kept for inspection until the next `clean`."""
        number = 0
        while (target := folder.with_name(f"{folder.name}.quarantined{number or ''}")).exists():
            number += 1
        folder.rename(target)
        print(
            f"The cached result {stage}/{folder.name} is damaged (a file is missing or has changed "
            f"since it was written). It was moved to {target.name} and will be computed again.",
            file=sys.stderr,
        )
        return target

    # -- loading ---------------------------------------------------------------------------------

    def load(self, result: Result, kind: str) -> Any:
        """Load an artifact, checking its checksums the first time.

        Raises:
            CorruptResultError: the bytes are not those that were written.
        """
        mark = (result.stage, result.key, kind)
        if mark not in self._verified:
            files = result.manifest["outputs"][kind]["files"]
            for name, entry in files.items():
                path = result.folder / kind / name
                if not path.is_file() or sha256_file(path) != entry["sha256"]:
                    self.quarantine(result.stage, result.folder)
                    raise CorruptResultError(result.stage, f"{kind}/{name} has changed")
            self._verified.add(mark)
        return artifact_class(kind).load(result.folder / kind)

    # -- writing ---------------------------------------------------------------------------------

    def begin(self, stage: str, key: str) -> Path:
        """Return the folder to write a result into, with only its `scratch/` left from before."""
        partial = self._partial(stage, key)
        partial.mkdir(parents=True, exist_ok=True)
        for entry in partial.iterdir():
            if entry.name != "scratch":
                shutil.rmtree(entry) if entry.is_dir() else entry.unlink()
        (partial / "scratch").mkdir(exist_ok=True)
        return partial

    def commit(self, stage: str, key: str, manifest: dict[str, Any], kinds: list[str]) -> Result:
        """Make what was written into `begin`'s folder the result of a key, all or nothing."""
        partial = self._partial(stage, key)
        shutil.rmtree(partial / "scratch", ignore_errors=True)
        outputs = {}
        for kind in kinds:
            listing = folder_listing(partial / kind)
            outputs[kind] = {"content": content_hash(listing), "files": listing}
        manifest = {"format": 1, "stage": stage, "key": key, **manifest, "outputs": outputs}
        final = self.folder(stage, key)
        before = read_json(final / MANIFEST)
        if before is not None and before["outputs"] == outputs:  # forced, and the same bytes again
            write_json(final / MANIFEST, manifest)
            shutil.rmtree(partial)
            return Result(stage, key, final, manifest)
        fsync_tree(partial)
        write_json(partial / MANIFEST, manifest)
        displaced = final.with_name(f"{final.name}{DISPLACED}")
        if final.exists():  # two folders can't change places in one step: `_recover` mends a kill
            final.rename(displaced)
        partial.rename(final)
        fsync_folder(final.parent)
        shutil.rmtree(displaced, ignore_errors=True)
        self._verified = {mark for mark in self._verified if mark[:2] != (stage, key)}
        return Result(stage, key, final, manifest)

    def discard_outputs(self, stage: str, key: str) -> None:
        """Free the space of a failed try, but keep its scratch folder."""
        if self._partial(stage, key).exists():
            self.begin(stage, key)

    def has_checkpoint(self, stage: str, key: str) -> bool:
        """Did a killed run of this key leave something to go on from?"""
        scratch = self._partial(stage, key) / "scratch"
        return scratch.is_dir() and any(scratch.iterdir())

    def record_failure(self, stage: str, key: str, message: str) -> None:
        """Remember why a stage failed, for `status`. A full disk must not hide the first error."""
        try:
            (self.root / stage).mkdir(parents=True, exist_ok=True)
            write_json(self.root / stage / "failure.json", {"key": key, "message": message})
        except OSError as error:
            if error.errno not in (errno.ENOSPC, errno.EDQUOT):
                raise

    def keep_evidence(
        self, stage: str, images: Mapping[str, Any], artifacts: Mapping[str, Any]
    ) -> Path:
        """Keep what a failed stage drew and made, instead of what an earlier failure left.

        Args:
            images: name -> picture of the trouble.
            artifacts: kind -> artifact that was made, but isn't safe.
        """
        from pipeline.artifacts.pictures import Pictures

        folder = self.root / stage / "failure"
        shutil.rmtree(folder, ignore_errors=True)
        if images or artifacts:
            folder.mkdir(parents=True)
        if images:
            Pictures(images).save(folder)
        for kind, artifact in artifacts.items():
            (folder / kind).mkdir()
            artifact.save(folder / kind)
        return folder

    def evidence(self, stage: str, kind: str) -> Any:
        """The artifact that `keep_evidence` last kept of a failed stage, or None."""
        folder = self.root / stage / "failure" / kind
        return artifact_class(kind).load(folder) if folder.is_dir() else None

    def failure(self, stage: str) -> dict[str, Any] | None:
        """What `record_failure` last wrote, if no run has succeeded since."""
        failure = read_json(self.root / stage / "failure.json")
        return failure if isinstance(failure, dict) else None

    def link_results(self, result: Result, kind: str) -> Path:
        """Point ``WORKSPACE/results`` at the exports in use."""
        link = self.root / "results"
        target = os.path.relpath(result.folder / kind, self.root)
        if not (link.is_symlink() and os.readlink(link) == target):  # noqa: PTH115
            temporary = temporary_beside(link)
            temporary.unlink(missing_ok=True)
            temporary.symlink_to(target)
            temporary.replace(link)
        return link

    def _partial(self, stage: str, key: str) -> Path:
        folder = self.folder(stage, key)
        return folder.with_name(f"{folder.name}.partial")

    # -- locks -----------------------------------------------------------------------------------

    @contextmanager
    def lock(self, stage: str, on_wait: Callable[[str], None]) -> Iterator[None]:
        """Hold the lock of a stage; if another process has it, say whose it is and wait."""
        folder = self.root / stage
        folder.mkdir(parents=True, exist_ok=True)
        lock, owner_file = FileLock(folder / ".lock"), folder / ".owner.json"
        try:
            lock.acquire(timeout=0)
        except Timeout:
            owner = read_json(owner_file) or {}
            on_wait(
                f"waiting for process {owner.get('pid', '?')} on {owner.get('host', '?')}, which "
                f"has been working on '{stage}' since {owner.get('since', '?')}"
            )
            lock.acquire(poll_interval=0.2)
        try:
            since = time.strftime("%Y-%m-%d %H:%M:%S")
            owner = {"pid": os.getpid(), "host": socket.gethostname(), "since": since}
            write_atomic(owner_file, json.dumps(owner) + "\n")
            self._recover(folder)
            yield
        finally:
            owner_file.unlink(missing_ok=True)
            lock.release()

    @staticmethod
    def _recover(folder: Path) -> None:
        """Undo what a kill between the two renames of a replacement left (see `commit`)."""
        for displaced in folder.glob(f"*{DISPLACED}"):
            final = displaced.with_name(displaced.name.removesuffix(DISPLACED))
            if final.exists():
                shutil.rmtree(displaced)
            else:
                displaced.rename(final)

    # -- cleaning --------------------------------------------------------------------------------

    def clean(self, keep: int) -> tuple[list[str], int]:
        """Delete what is not in use: all but the `keep` newest other results of each stage.

        Leftovers of killed runs and quarantined results go too. A stage that another process is
        working on is left alone.

        Returns:
            Names of what was deleted (``stage/key``), and the bytes freed.
        """
        removed: list[str] = []
        freed = 0
        for folder in sorted(path for path in self.root.iterdir() if path.is_dir()):
            if folder.is_symlink() or not (folder / ".lock").exists():
                continue
            try:
                with FileLock(folder / ".lock").acquire(timeout=0):
                    for victim in self._unused(folder, keep):
                        freed += sum(f.stat().st_size for f in victim.rglob("*") if f.is_file())
                        removed.append(f"{folder.name}/{victim.name}")
                        shutil.rmtree(victim)
            except Timeout:
                continue
        return removed, freed

    def _unused(self, folder: Path, keep: int) -> list[Path]:
        pointer = self.pointer(folder.name) or {"key": ""}
        entries = [path for path in folder.iterdir() if path.is_dir()]
        whole = [path for path in entries if (path / MANIFEST).is_file() and "." not in path.name]
        others = sorted(
            (path for path in whole if path.name != pointer["key"][:KEY_LENGTH]),
            key=lambda path: ((path / MANIFEST).stat().st_mtime_ns, path.name),
            reverse=True,
        )
        return [path for path in entries if path not in whole] + others[keep:]


def _files(manifest: dict[str, Any]) -> Iterator[tuple[str, dict[str, Any]]]:
    for kind, output in manifest["outputs"].items():
        for name, entry in output["files"].items():
            yield f"{kind}/{name}", entry


def _reason(error: OSError) -> str:
    return error.strerror or type(error).__name__


def is_disk_full(error: BaseException, folder: Path) -> bool:
    """Did this error come from a full disk, whichever library reports it and however?"""
    if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
        return True
    try:
        return shutil.disk_usage(folder).free < 2**20
    except OSError:
        return False
