"""pycolmap, without its chatter on the user's screen."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any


def quiet_pycolmap() -> Any:  # pycolmap has no types
    """Import pycolmap and let it log nothing: failures show in what it returns."""
    import pycolmap

    pycolmap.logging.minloglevel = pycolmap.logging.FATAL.value
    return pycolmap


#: Parameters of COLMAP's camera models, by number.
_LENS_PARAMETERS = {0: 3, 1: 4, 2: 4, 3: 5, 4: 8, 5: 8, 6: 12, 7: 5, 8: 4, 9: 5, 10: 12}


def check_whole(folder: Path) -> None:
    """Refuse a binary model that was cut off, on which pycolmap hangs, aborts or reads nonsense.

    Args:
        folder: of a model; what is not there, or text, is not looked at.

    Raises:
        ValueError: a file ends before its last record, or goes on after it.
    """
    for name, skip in (
        ("cameras", _skip_camera),
        ("images", _skip_image),
        ("points3D", _skip_point),
    ):
        path = folder / f"{name}.bin"
        if not path.is_file():
            continue
        data = path.read_bytes()
        try:
            (count,) = struct.unpack_from("<Q", data)
            position: int | None = 8
            for _ in range(count):
                position = None if position is None else skip(data, position)
                if position is None:
                    break
                if position > len(data):
                    raise ValueError
        except (struct.error, ValueError):
            raise ValueError(f"{path.name} is cut off") from None
        if position is not None and position != len(data):
            raise ValueError(f"{path.name} is longer than its {count} entries")


def _skip_camera(data: bytes, position: int) -> int | None:
    _, model = struct.unpack_from("<ii", data, position)
    return None if model not in _LENS_PARAMETERS else position + 24 + 8 * _LENS_PARAMETERS[model]


def _skip_image(data: bytes, position: int) -> int:
    position = data.index(b"\0", position + 64) + 1
    return position + 8 + 24 * int(struct.unpack_from("<Q", data, position)[0])


def _skip_point(data: bytes, position: int) -> int:
    return position + 51 + 8 * int(struct.unpack_from("<Q", data, position + 43)[0])
