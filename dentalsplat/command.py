"""The console scripts ``pipeline`` and ``dentalsplat``, which are the same command."""

from __future__ import annotations

import sys
from typing import NoReturn

from dentalsplat.names import NameTakenError, check_names


def main() -> NoReturn:
    """Run the command line; where another package has the name of ours, say so (status 2)."""
    try:
        check_names()
        from pipeline.process import signals
    except NameTakenError as error:
        print(f"\n{error}", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        sys.exit(130)
    signals.run(_program)


def _program() -> int:
    from pipeline.cli import program

    return program()
