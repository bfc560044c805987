"""Decode the photographs of a case: HEIC, TIFF, DICOM in processes that may die of a bad file."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from typing import Self

import numpy as np
import numpy.typing as npt

from pipeline.installed import is_installed
from pipeline.untrusted.child import Children, Reply, seconds_for
from pipeline.untrusted.files import UnusableFile
from pipeline.untrusted.pictures import APART, MOST_MEMORY, large_pictures, look
from stages.views.reading.decode import Photo, decode_mask, decode_photo


class Decoder:
    """Decodes while it is entered; threads may share it."""

    def __init__(self) -> None:
        memory = MOST_MEMORY + (1 << 30)
        self._children = Children("stages.views.reading.decode_child:work", memory)
        self._of_dicom = Children("stages.views.reading.dicom_child:work", memory)
        self._open = ExitStack()

    def __enter__(self) -> Self:
        self._open.enter_context(large_pictures())
        self._open.callback(self._children.close)
        self._open.callback(self._of_dicom.close)
        return self

    def __exit__(self, *exception: object) -> None:
        self._open.close()

    def stop(self) -> None:
        """Let go of what is being decoded; its threads are told."""
        self._children.stop()
        self._of_dicom.stop()

    def photo(self, data: bytes, check_size: Callable[[int, int], None]) -> Photo:
        """As `decode_photo`."""
        kind = look(data).kind
        if kind not in APART:
            return decode_photo(data, check_size)
        if kind == "DICOM" and not is_installed("pydicom"):
            raise UnusableFile(
                "is a DICOM file, and what reads these is not installed: pip install "
                "'dentalsplat[dicom]', or save it as JPEG"
            )
        [(reply, arrays)] = self._ask("photo", data, dicom=kind == "DICOM")
        valid = arrays[1] if len(arrays) > 1 else None
        check_size(arrays[0].shape[1], arrays[0].shape[0])
        return Photo(arrays[0], valid, **reply)

    def mask(self, data: bytes) -> npt.NDArray[np.bool_]:
        """As `decode_mask`."""
        if look(data).kind not in APART:
            return decode_mask(data)
        [(_, arrays)] = self._ask("mask", data)
        return arrays[0]

    def _ask(self, what: str, data: bytes, *, dicom: bool = False) -> list[Reply]:
        packed = np.frombuffer(data, np.uint8)
        children = self._of_dicom if dicom else self._children
        return list(children.ask({"what": what}, [packed], seconds_for(len(data))))
