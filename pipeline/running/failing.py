"""What is said of a stage that failed."""

from __future__ import annotations

import errno
import shutil
import traceback
from collections.abc import Iterable
from pathlib import Path

from pipeline.errors import PipelineError, RequestError, StageError
from pipeline.store import file_in_the_way, is_disk_full


def explained(
    error: BaseException, stage: str, workspace: Path, thrift: Iterable[str] = ()
) -> PipelineError:
    """Any failure of a stage as one that is told in one paragraph.

    Args:
        error: what the stage, or the store of its result, raised.
        stage: its name.
        workspace: where its result was to go.
        thrift: what to do where memory ran out.
    """
    if is_disk_full(error, workspace):
        free = shutil.disk_usage(workspace).free / 2**20
        # a quota, or a limit on the size of a file, ends a run on a disk with room
        full = f"is full ({free:.1f} MB left)"
        if isinstance(error, OSError) and error.errno in (errno.EDQUOT, errno.EFBIG):
            full = f"takes no more from you ({error.strerror})"
        return RequestError(
            f"The disk that holds the workspace {workspace} {full}; the stage '{stage}' "
            "could not write its result. Nothing computed before is lost: make room ('pipeline "
            "clean' deletes results that are not in use) and run the same command again."
        )
    if isinstance(error, PipelineError):
        return error
    if told := file_in_the_way(error, workspace):
        return told
    if isinstance(error, MemoryError):
        return StageError(
            " ".join([f"The stage '{stage}' needs more memory than there is.", *thrift])
        )
    where = traceback.extract_tb(error.__traceback__)[-1]
    said = " ".join(str(error).split())
    return StageError(
        f"The stage '{stage}' failed with a fault of ours: {type(error).__name__}: {said} "
        f"({Path(where.filename).name}, line {where.lineno}). What earlier stages computed is "
        "kept. Run again with --debug for the whole trace, and please report it."
    )
