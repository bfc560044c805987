"""What the tests let children do."""

from __future__ import annotations

import os
import signal
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from pipeline.untrusted.child import Arrays, Reply, Values
from pipeline.untrusted.files import UnusableFile


def work(values: Values, arrays: Arrays) -> Iterator[Reply]:
    match values["do"]:
        case "echo":
            print("a library that prints", flush=True)
            yield {"pid": os.getpid(), "modules": sorted(sys.modules)}, arrays
        case "crash":
            os.kill(os.getpid(), signal.SIGSEGV)
        case "memory":
            yield {}, [np.ones(1 << 30, np.uint8)]
        case "open":
            yield {"text": Path(__file__).read_text()}, []
        case "hang":
            yield {"pid": os.getpid()}, []
            time.sleep(600)
        case "garbage":
            os.write(3 if values.get("wrong") else 1, b"x" * 64)
            os._exit(0)
        case "refuse":
            raise UnusableFile("is not wanted")
