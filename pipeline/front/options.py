"""Options that several commands have, and what their texts mean."""

from __future__ import annotations

import contextlib
import ctypes
import json
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any, TypeVar

import typer

from pipeline.errors import RequestError, nearest
from pipeline.front import completion
from pipeline.process.privacy import SHARES, Share
from pipeline.untrusted.paths import given_path

#: Of the process.
STDOUT, STDERR = 1, 2

Word = TypeVar("Word", bound=str)


def path(text: str) -> Path:
    """A path, `~` replaced, which is not empty: pathlib takes that for the current folder.

    Raises:
        RequestError: it is, as where a variable of the shell is not set.
    """
    return given_path(text, "A path that was given")


def named(parameter: typer.CallbackParam, text: str | None) -> str | None:
    """The value of an option that names something.

    Raises:
        RequestError: it names nothing.
    """
    if text is not None and not text.strip(" ,"):
        raise RequestError(f"{parameter.opts[-1]} names nothing. Leave it out, or name something.")
    return text


Images = Annotated[
    list[str] | None,
    typer.Argument(
        metavar="IMAGES",
        help="A folder, files, a quoted glob pattern, or one video.",
        show_default=False,
    ),
]


def _workspace(meaning: str, default: str) -> Any:
    return typer.Option(
        "-w", "--workspace", metavar="FOLDER", parser=path, help=f"{meaning}  [default: {default}]"
    )


#: Of commands that run.
Workspace = Annotated[Path | None, _workspace("Where results are kept.", "./runs/NAME_OF_IMAGES")]
#: Of commands that look at what was run.
OldWorkspace = Annotated[
    Path | None,
    _workspace("Where a run keeps its results.", "this folder, or the only one in ./runs"),
]
Preset = Annotated[
    str | None,
    typer.Option(
        "-c",
        "--config",
        metavar="PRESET|FILE",
        autocompletion=completion.preset,
        callback=named,
        help="A preset's name, or a YAML file.",
    ),
]
Overrides = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="STAGE.KEY=VALUE",
        autocompletion=completion.setting,
        help="A setting, as in fit.iterations=500. May be repeated.",
    ),
]
Stages = Annotated[
    str | None,
    typer.Option(
        "--stages",
        metavar="STAGE,...",
        autocompletion=completion.stages,
        callback=named,
        help="Only these, in this order: init,sap,fit.",
    ),
]
Verify = Annotated[
    bool,
    typer.Option("--verify", help="Read every byte of the cached results again."),
]
Sharing = Annotated[
    str | None,
    typer.Option(
        "--share", metavar="[nobody|group]", show_default=False,
        help="Who else may read what is written.  [default: as the workspace is, first nobody]",
    ),
]  # fmt: skip


def out_option(default: str) -> Any:
    """The option that names the folder of results.

    Args:
        default: what it is where none is named, for the help.
    """
    return typer.Option(
        "-o", "--out", metavar="FOLDER", parser=path,
        help=f"Folder of the results.  [default: {default}]",
    )  # fmt: skip


Quiet = Annotated[bool, typer.Option("-q", "--quiet", help="Say nothing but errors.")]
Verbose = Annotated[
    bool, typer.Option("-v", "--verbose", help="Say more: each step, keys, memory.")
]
AsJson = Annotated[bool, typer.Option("--json", help="Print the result as JSON.")]


@contextlib.contextmanager
def only_the_answer(as_json: bool) -> Iterator[None]:
    """Where an answer is to be JSON, what stages and their libraries print meanwhile goes to the
    standard error, so that nothing else stands on the standard output."""
    if not as_json:
        yield
        return
    sys.stdout.flush()
    kept = os.dup(STDOUT)
    os.dup2(STDERR, STDOUT)
    try:
        with contextlib.redirect_stdout(sys.stderr):
            yield
    finally:
        ctypes.CDLL(None).fflush(None)  # what C has not written yet
        os.dup2(kept, STDOUT)
        os.close(kept)


def answer(
    result: Callable[[], Any], show: Callable[[], None], *, as_json: bool, quiet: bool
) -> None:
    """Print what came of a command: as JSON where that is asked for, else in words, unless quiet.

    Args:
        result: gives it as JSON values.
        show: prints it in words.
    """
    if as_json:
        print(json.dumps(result(), indent=1))
    elif not quiet:
        show()


def sharing(text: str | None) -> Share | None:
    """For whom the results are, as the user says it."""
    return None if text is None else one_of("--share", text, SHARES)


def one_of(option: str, text: str, allowed: Sequence[Word]) -> Word:
    """A value that may be one of some words.

    Raises:
        RequestError: it is another.
    """
    for word in allowed:
        if text == word:
            return word
    raise RequestError(
        f"{option} {text}: it may be {' or '.join(allowed)}.{nearest(text, allowed)}"
    )


def only_workspace() -> Path:
    """The workspace to speak of where none is named: this folder, or the only one under runs/."""
    if Path("request.json").exists():
        return Path()
    found = sorted(path.parent for path in Path("runs").glob("*/request.json"))
    if len(found) == 1:
        return found[0]
    some = f" ({', '.join(map(str, found[:5]))})" if found else ""
    raise RequestError(f"Say which workspace: -w FOLDER{some}.")
