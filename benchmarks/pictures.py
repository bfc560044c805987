"""What decoding photographs takes: peak memory a pixel for each format, and time of a child.

    python benchmarks/pictures.py --megapixels 80

The first is held against what `pipeline.untrusted.pictures.look` states, by which pictures are
refused. Linux only: it reads peaks from /proc.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[1]


def files(megapixels: float) -> Iterator[tuple[str, bytes]]:
    """Large pictures of each kind: (name, bytes)."""
    import cv2
    import pillow_heif
    from PIL import Image

    pillow_heif.register_heif_opener()
    Image.MAX_IMAGE_PIXELS = None
    noise = np.random.default_rng(0).integers(0, 255, (100, 100, 4), np.uint8)
    side = 500
    times = max(1, round((megapixels * 1e6) ** 0.5 / side))
    pixels = np.tile(cv2.resize(noise, (side, side)), (times, times, 1))
    rgba = Image.fromarray(pixels)
    rgb = rgba.convert("RGB")

    def saved(image: Any, kind: str, **options: Any) -> bytes:
        data = io.BytesIO()
        image.save(data, kind, **options)
        return data.getvalue()

    yield "JPEG", saved(rgb, "JPEG")
    yield "JPEG progressive", saved(rgb, "JPEG", progressive=True, subsampling=0)
    yield "JPEG CMYK progressive", saved(rgb.convert("CMYK"), "JPEG", progressive=True)
    yield "PNG", saved(rgb, "PNG", compress_level=1)
    yield "PNG RGBA", saved(rgba, "PNG", compress_level=1)
    for name, channels in (("gray", 1), ("RGB", 3), ("RGBA", 4)):
        deep = pixels[..., :channels].astype(np.uint16) * 257
        quick = [cv2.IMWRITE_PNG_COMPRESSION, 1]
        yield f"PNG 16 bits {name}", cv2.imencode(".png", deep, quick)[1].tobytes()
        yield f"TIFF 16 bits {name}", cv2.imencode(".tiff", deep)[1].tobytes()
    yield "TIFF", saved(rgb, "TIFF")
    yield "TIFF LZW RGBA", saved(rgba, "TIFF", compression="tiff_lzw")
    yield "BMP", saved(rgb, "BMP")
    yield "WebP", saved(rgb, "WEBP", quality=50, method=0)
    yield "WebP RGBA", saved(rgba, "WEBP", quality=50, method=0)
    yield "HEIC", saved(rgb, "HEIF", quality=30)


def show_peak() -> None:
    """Decode the picture on standard input, and print pixels and bytes at the peak."""
    import cv2  # noqa: F401
    import pillow_heif  # noqa: F401

    from pipeline.untrusted.pictures import large_pictures, look
    from stages.views.reading.decode import decode_mask, decode_photo

    def now(key: str) -> int:
        lines = Path("/proc/self/status").read_text().splitlines()
        return int(next(line for line in lines if line.startswith(key)).split()[1]) * 1024

    data = sys.stdin.buffer.read()
    peaks = []
    with large_pictures():
        for decode in (decode_photo, decode_mask):
            Path("/proc/self/clear_refs").write_text("5")
            before = now("VmRSS")
            made: Any = decode(data)
            peaks.append(now("VmHWM") - before)
            pixels = made.size if hasattr(made, "size") else made.rgb.size // 3
            del made
    print(pixels, *peaks, look(data).memory)


def child_seconds(work: str) -> float:
    """From the start of a child until it has answered."""
    from pipeline.untrusted.child import Child
    from pipeline.untrusted.files import UnusableFile

    best = 9.0
    for _ in range(5):
        begun = time.perf_counter()
        with Child(work, 1 << 30) as child, contextlib.suppress(UnusableFile, RuntimeError):
            list(child.ask({"what": "mask"}, [np.zeros(1, np.uint8)]))
        best = min(best, time.perf_counter() - begun)
    return best


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--megapixels", type=float, default=40)
    parser.add_argument("--show-peak", action="store_true", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.show_peak:
        show_peak()
        return
    print("bytes a pixel at the peak (without the file itself): photograph, mask, stated")
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OPENBLAS_NUM_THREADS": "1"}
    for name, data in files(arguments.megapixels):
        done = subprocess.run(
            [sys.executable, __file__, "--show-peak"], input=data, capture_output=True, check=True,
            env=environment,
        )  # fmt: skip
        pixels, photo, mask, stated = map(float, done.stdout.split())
        print(f"{name:24s} {photo / pixels:6.1f} {mask / pixels:6.1f} {stated:6.1f}", flush=True)
    for name, work in (("pictures", "decode_child"), ("films", "video_child")):
        seconds = child_seconds(f"stages.views.reading.{work}:work")
        print(f"child for {name}: {seconds:.2f} s")


if __name__ == "__main__":
    main()
