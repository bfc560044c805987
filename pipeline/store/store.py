"""The artifact store: content keys, atomic commit, manifest, checksums, locks.

Layout of a workspace::

    WORKSPACE/<stage>/<key12>/            one result, immutable: a folder per artifact kind
    WORKSPACE/<stage>/<key12>/manifest.json   written last; without it the result never existed
    WORKSPACE/<stage>/<key12>/checked.json    which files need not be read again (`checks`)
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

import sys
from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from pipeline.artifacts import artifact_class
from pipeline.errors import RequestError
from pipeline.files import (
    canonical_json,
    content_hash,
    folder_listing,
    fsync_folder,
    fsync_tree,
    make_writable,
    remove_leftovers,
)
from pipeline.process.privacy import share_for
from pipeline.store import checks
from pipeline.store.checks import mark_of
from pipeline.store.cleaning import PARTIAL, SCRATCH, clean, holds_checkpoint
from pipeline.store.failures import EVIDENCE, FAILURE, Failures
from pipeline.store.faults import reason_of
from pipeline.store.links import NO_LINKS, link_to
from pipeline.store.locks import locked
from pipeline.store.places import (
    check_place,
    is_there,
    make_folder,
    remove,
    set_aside,
    stage_folder,
)
from pipeline.store.pointers import Pointers
from pipeline.store.readers import tell, tighten_workspace
from pipeline.store.records import (
    MANIFEST,
    DamagedError,
    read_manifest,
    write_sealed,
)
from pipeline.store.results import KEY_LENGTH, CorruptResultError, Result

#: Of manifests: 2 has a checksum.
FORMAT = 2
DISPLACED = ".replaced"


class Store:
    """The results in one workspace folder.

    Attributes:
        failures: why stages failed.
        said: what was found damaged, and what was done about it.

    Args:
        root: the workspace.
        verify: read every byte of every result that is looked at, once, whatever is remembered.
    """

    def __init__(self, root: Path, *, verify: bool = False) -> None:
        self.root = root
        self.failures = Failures(root)
        self._verify = verify
        self._marks: dict[Path, checks.Known] = {}
        self.said: list[str] = []
        self._pointers = Pointers(root, self._say)

    def create(self, stages: Iterable[str] = (), more: Iterable[str] = ()) -> None:
        """Make the workspace folder, and clear half-written files of killed runs out of it.

        What others could read of it is closed to them.

        Args:
            stages: those that will be computed: their folders must not be in the way.
            more: names of folders besides those of stages that are the workspace's own.

        Raises:
            RequestError: it can't be made or written to, or belongs to another's results.
        """
        check_place(self.root)
        try:
            make_writable(self.root)
            remove_leftovers(self.root)
            tell(tighten_workspace(self.root, share_for(self.root), set(more)))
        except OSError as error:
            raise RequestError(
                f"The workspace {self.root} can't be written to ({reason_of(error)}). Choose "
                "another folder with -w (or -o), or mend its permissions."
            ) from error
        for stage in stages:
            if is_there(self.root / stage):
                stage_folder(self.root, stage)

    def folder(self, stage: str, key: str) -> Path:
        return self.root / stage / key[:KEY_LENGTH]

    # -- finding ---------------------------------------------------------------------------------

    def find(self, stage: str, key: str) -> Result | None:
        """Return the committed result of a key, or None.

        Its files are checked (`checks`); a result that fails is moved aside, so that it is made
        anew.
        """
        folder = self.folder(stage, key)
        if not is_there(folder):
            return None
        try:
            manifest = read_manifest(folder / MANIFEST)
            if manifest is None or manifest.get("key") != key or manifest.get("stage") != stage:
                raise DamagedError("its manifest is missing, or that of another result")
            wrong = self._wrong(folder, manifest)
            if wrong:
                raise DamagedError(f"{_some(wrong)} changed since it was written, or is missing")
        except DamagedError as error:
            self.quarantine(stage, folder, str(error))
            return None
        return Result(stage, key, folder, manifest)

    def _wrong(
        self, folder: Path, manifest: dict[str, Any], kinds: Iterable[str] | None = None
    ) -> list[str]:
        """Names of the files of a result that are not what its manifest says."""
        outputs = canonical_json(manifest["outputs"])
        known = self._marks.get(folder)
        if known is None or known.outputs != outputs:
            marks = {} if self._verify else checks.remembered(folder, manifest)
            known = self._marks[folder] = checks.Known(outputs, marks)
        before = dict(known.settled)
        wrong = checks.damaged(folder, manifest, known, kinds)
        if known.settled != before and not wrong:
            checks.remember(folder, manifest, known.settled)
        return wrong

    def current(self, stage: str) -> Result | None:
        """Return the result in use, or None."""
        pointer = self.pointer(stage)
        return self.find(stage, pointer["key"]) if pointer else None

    def in_use(self, stage: str) -> Result | None:
        """As `current`, for who takes the result as it is.

        Raises:
            RequestError: it can't be told which result that is.
        """
        result = self.current(stage)
        if result is None:
            self._pointers.require(stage)
        return result

    def pointer(self, stage: str) -> dict[str, Any] | None:
        """What `current.json` says: the key in use and why it came to be."""
        return self._pointers.read(stage)

    def use(self, result: Result, reasons: list[str] | None = None) -> None:
        """Make a result the one in use."""
        self._pointers.write(result.stage, result.key, reasons or [])
        remove(self.root / result.stage / FAILURE)
        remove(self.root / result.stage / EVIDENCE)

    def quarantine(self, stage: str, folder: Path, why: str = "") -> None:
        """Move a damaged result aside. It is kept for inspection until the next `clean`."""
        self._marks.pop(folder, None)
        said = f"The cached result {stage}/{folder.name} is damaged{f' ({why})' if why else ''}."
        try:
            target = set_aside(folder)
        except FileNotFoundError:  # another process has seen it too
            return
        except OSError as error:
            self._say(f"{said} It can't be moved aside ({reason_of(error)}).")
            return
        self._say(f"{said} It was moved to {target.name} and will be computed again.")

    def _say(self, text: str) -> None:
        if text not in self.said:
            self.said.append(text)
            print(text, file=sys.stderr)

    # -- loading ---------------------------------------------------------------------------------

    def load(self, result: Result, kind: str) -> Any:
        """Load an artifact, if its files are still those that were found.

        Raises:
            CorruptResultError: the bytes are not those that were written.
        """
        wrong = self._wrong(result.folder, result.manifest, [kind])
        if wrong:
            self.quarantine(result.stage, result.folder, f"{_some(wrong)} changed")
            raise CorruptResultError(result.stage, f"{_some(wrong)} has changed")
        return artifact_class(kind).load(result.folder / kind)

    # -- writing ---------------------------------------------------------------------------------

    def begin(self, stage: str, key: str) -> Path:
        """Return the folder to write a result into, with only its `scratch/` left from before."""
        stage_folder(self.root, stage)
        partial = make_folder(self._partial(stage, key))
        for entry in partial.iterdir():
            if entry.name != SCRATCH:
                remove(entry)
        make_folder(partial / SCRATCH)
        return partial

    def commit(self, stage: str, key: str, manifest: dict[str, Any], kinds: list[str]) -> Result:
        """Make what was written into `begin`'s folder the result of a key, all or nothing."""
        partial = self._partial(stage, key)
        marks = {name: mark_of(partial / name) for name in _names(partial, kinds)}
        outputs = {}
        for kind in kinds:
            listing = folder_listing(partial / kind)
            outputs[kind] = {"content": content_hash(listing), "files": listing}
        manifest = {"format": FORMAT, "stage": stage, "key": key, **manifest, "outputs": outputs}
        final = self.folder(stage, key)
        before = self.find(stage, key)
        if before is not None and before.manifest["outputs"] == outputs:
            write_sealed(final / MANIFEST, manifest)  # forced, and the same bytes again
            remove(partial)
            return Result(stage, key, final, manifest)
        for kind in kinds:
            fsync_tree(partial / kind)
        write_sealed(partial / MANIFEST, manifest)
        displaced = final.with_name(f"{final.name}{DISPLACED}")
        if is_there(final):  # two folders can't change places in one step: `_recover` mends a kill
            final.rename(displaced)
        partial.rename(final)
        fsync_folder(final.parent)
        # only now: a run that is killed before goes on from there
        remove(final / SCRATCH)
        remove(displaced)
        self._marks[final] = checks.Known(canonical_json(outputs), read_now=marks)
        return Result(stage, key, final, manifest)

    def discard_outputs(self, stage: str, key: str) -> None:
        """Free the space of a failed try, but keep what it could go on from."""
        if self.has_checkpoint(stage, key):
            self.begin(stage, key)
        else:
            remove(self._partial(stage, key))

    def has_checkpoint(self, stage: str, key: str) -> bool:
        """Did a killed run of this key leave something to go on from?"""
        return holds_checkpoint(self._partial(stage, key))

    def link_results(self, result: Result, kind: str) -> Path:
        """Point ``WORKSPACE/results`` at the exports in use; where they are, if the disk can't."""
        try:
            link, aside = link_to(self.root, "results", result.folder / kind, result.stage)
        except OSError as error:
            if error.errno not in NO_LINKS:
                raise
            self._say(f"The disk knows no links, so there is no {self.root / 'results'}.")
            return result.folder / kind
        if aside is not None:
            self._say(f"{link} was no link of ours; it was moved to {aside.name}.")
        return link

    def _partial(self, stage: str, key: str) -> Path:
        return self.root / stage / partial_name(key)

    # -- locks -----------------------------------------------------------------------------------

    @contextmanager
    def lock(self, stage: str, on_wait: Callable[[str], None]) -> Iterator[None]:
        """Hold the lock of a stage; if another process has it, say whose it is and wait.

        Raises:
            RequestError: something else has the name of the stage's folder.
        """
        folder = stage_folder(self.root, stage)
        with locked(folder, stage, on_wait):
            self._recover(folder)
            yield

    @staticmethod
    def _recover(folder: Path) -> None:
        """Undo what a kill between the steps of `commit` left."""
        for scratch in folder.glob(f"*/{SCRATCH}"):
            if scratch.parent.suffix != PARTIAL:
                remove(scratch)
        for displaced in folder.glob(f"*{DISPLACED}"):
            final = displaced.with_name(displaced.name.removesuffix(DISPLACED))
            if is_there(final):
                remove(displaced)
            else:
                displaced.rename(final)

    # -- cleaning --------------------------------------------------------------------------------

    def clean(self, keep: int, spare: Collection[str] = ()) -> tuple[list[str], int]:
        """Delete what is not in use: all but the `keep` newest other results of each stage.

        Leftovers of killed runs and quarantined results go too. A stage that another process is
        working on is left alone.

        Args:
            spare: names (``stage/folder``) of what stays besides, as `checkpoints` has them.

        Returns:
            Names of what was deleted (``stage/key``), and the bytes freed.

        Raises:
            RequestError: the workspace can't be written to.
        """

        def in_use(stage: str) -> str | None:
            pointer = self.pointer(stage)
            if pointer is not None:
                return pointer["key"][:KEY_LENGTH]
            return "" if self._pointers.is_known(stage) else None

        try:
            remove_leftovers(self.root)
            return clean(self.root, keep, in_use, spare, MANIFEST)
        except OSError as error:
            raise RequestError(
                f"The workspace {self.root} can't be cleaned ({error.filename or self.root}: "
                f"{reason_of(error)}). Mend its permissions, or make its disk writable, and run "
                "the same command again; what is in use was left alone."
            ) from error


def _names(folder: Path, kinds: Iterable[str]) -> Iterator[str]:
    for kind in kinds:
        for path in (folder / kind).rglob("*"):
            yield path.relative_to(folder).as_posix()


def partial_name(key: str) -> str:
    """Name of the folder that the result of a key is written into."""
    return f"{key[:KEY_LENGTH]}{PARTIAL}"


def _some(names: list[str]) -> str:
    more = f" and {len(names) - 1} more" if names[1:] else ""
    return f"{names[0]}{more}"
