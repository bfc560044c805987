"""Decode the photographs of a case: HEIC and TIFF in processes that may die of a damaged file."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from typing import Self

import numpy as np
import numpy.typing as npt

from pipeline.untrusted.child import Children, Reply, seconds_for
from pipeline.untrusted.pictures import APART, MOST_MEMORY, large_pictures, look
from stages.views.reading.decode import Photo, decode_mask, decode_photo


class Decoder:
    """Decodes while it is entered; threads may share it."""

    def __init__(self) -> None:
        self._children = Children("stages.views.reading.decode_child:work", MOST_MEMORY + (1 << 30))
        self._open = ExitStack()

    def __enter__(self) -> Self:
        self._open.enter_context(large_pictures())
        self._open.callback(self._children.close)
        return self

    def __exit__(self, *exception: object) -> None:
        self._open.close()

    def stop(self) -> None:
        """Let go of what is being decoded; its threads are told."""
        self._children.stop()

    def photo(self, data: bytes, check_size: Callable[[int, int], None]) -> Photo:
        """As `decode_photo`."""
        if look(data).kind not in APART:
            return decode_photo(data, check_size)
        [(reply, arrays)] = self._ask("photo", data)
        valid = arrays[1] if len(arrays) > 1 else None
        check_size(arrays[0].shape[1], arrays[0].shape[0])
        return Photo(arrays[0], valid, reply["orientation"], reply["focal_px"])

    def mask(self, data: bytes) -> npt.NDArray[np.bool_]:
        """As `decode_mask`."""
        if look(data).kind not in APART:
            return decode_mask(data)
        [(_, arrays)] = self._ask("mask", data)
        return arrays[0]

    def _ask(self, what: str, data: bytes) -> list[Reply]:
        packed = np.frombuffer(data, np.uint8)
        return list(self._children.ask({"what": what}, [packed], seconds_for(len(data))))
