"""What runs in the processes of `apart` for DICOM: all that decoding needs is imported before."""

from __future__ import annotations

from collections.abc import Iterator

from PIL import Image, Jpeg2KImagePlugin, JpegImagePlugin  # noqa: F401

from pipeline.untrusted.child import Arrays, Reply, Values
from pipeline.untrusted.pictures import large_pictures
from stages.views.reading.dicom import decode_dicom

Image.preinit()


def work(values: Values, arrays: Arrays) -> Iterator[Reply]:
    """Decode the photograph whose bytes come."""
    data = arrays[0].tobytes()
    arrays.clear()
    with large_pictures():
        photo = decode_dicom(data)
    yield photo.facts(), [photo.rgb]
