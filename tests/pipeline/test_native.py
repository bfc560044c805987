"""What native libraries do to the process."""

from __future__ import annotations

import ctypes
import sys

import numpy as np
import psutil
import pytest

from pipeline.process.native import return_free_memory

trims = sys.platform == "linux" and hasattr(ctypes.CDLL(None), "malloc_trim")


@pytest.mark.skipif(not trims, reason="this C library keeps what it likes")
def test_freed_memory_goes_back_to_the_system() -> None:
    """Blocks between others that live on: nothing of it lies at the heap's end."""
    blocks = [np.ones(10_000) for _ in range(1_000)]
    kept = blocks[::50]
    del blocks
    before = psutil.Process().memory_info().rss
    return_free_memory()
    assert before - psutil.Process().memory_info().rss > 50e6
    assert all(block.sum() == 10_000 for block in kept)
