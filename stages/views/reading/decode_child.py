"""What runs in the processes of `apart`: all that decoding needs is imported before it begins."""

from __future__ import annotations

from collections.abc import Iterator

import cv2  # noqa: F401
import pillow_heif
from PIL import Image, TiffImagePlugin  # noqa: F401

from pipeline.untrusted.child import Arrays, Reply, Values
from pipeline.untrusted.pictures import large_pictures
from stages.views.reading.decode import decode_mask, decode_photo

Image.preinit()
pillow_heif.register_heif_opener()


def work(values: Values, arrays: Arrays) -> Iterator[Reply]:
    """Decode the photograph or the mask whose bytes come."""
    data = arrays[0].tobytes()
    arrays.clear()
    with large_pictures():
        if values["what"] == "mask":
            yield {}, [decode_mask(data)]
            return
        photo = decode_photo(data)
    valid = [] if photo.valid is None else [photo.valid]
    yield photo.facts(), [photo.rgb, *valid]
