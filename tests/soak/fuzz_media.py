"""Damage valid pictures and films in every way that comes to mind, and read them.

    python tests/soak/fuzz_media.py --count 1000 --seed 0

Not part of the test suite: it takes minutes. Each input is read as a run reads it, as photograph
and as mask, in a process with so much memory and so much time. Prints what became of the inputs
(read, refused: an error with exit status 2, BROKEN: anything else); exit status 1 if any is BROKEN.
"""

from __future__ import annotations

import argparse
import io
import os
import random
import select
import struct
import subprocess
import sys
import tempfile
import time
import zlib
from collections import Counter
from collections.abc import Callable
from fractions import Fraction
from functools import cache
from pathlib import Path
from typing import Any

MEMORY = 6 << 30
SECONDS = 100.0
EXTREMES = (0, 1, 2, 0x7F, 0xFF, 0x7FFF, 0xFFFF, 0x10000, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF)


@cache
def seeds() -> dict[str, bytes]:
    """Valid files of every format, small: name -> bytes."""
    return {**_pictures(), **_films()}


def _pictures() -> dict[str, bytes]:
    import cv2
    import numpy as np
    import pillow_heif
    from PIL import Image, ImageCms, PngImagePlugin

    pillow_heif.register_heif_opener()
    noise = np.random.default_rng(0).integers(0, 255, (12, 16, 4), np.uint8)
    rgba = Image.fromarray(cv2.resize(noise, (160, 120)))
    rgb = rgba.convert("RGB")
    profile = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    profile = profile[:24] + bytes(12) + profile[36:]  # without the time that it was made
    profile = profile.replace("sRGB".encode("utf-16-be"), "Wide".encode("utf-16-be"))
    exif = Image.Exif()
    exif[0x0112] = 6
    exif.get_ifd(0x8769)[0xA405] = 50
    text = PngImagePlugin.PngInfo()
    text.add_text("Comment", "nothing " * 40, zip=True)

    def saved(image: Image.Image, kind: str, **options: Any) -> bytes:
        data = io.BytesIO()
        image.save(data, kind, **options)
        return data.getvalue()

    deep = np.asarray(rgba).astype(np.uint16) * 257
    return {
        "plain.jpg": saved(rgb, "JPEG", exif=exif, icc_profile=profile),
        "progressive.jpg": saved(rgb, "JPEG", progressive=True),
        "press.jpg": saved(rgb.convert("CMYK"), "JPEG"),
        "two.jpg": saved(rgb, "MPO", save_all=True, append_images=[rgb]),
        "plain.png": saved(rgba, "PNG", pnginfo=text, icc_profile=profile, exif=exif),
        "indexed.png": saved(rgb.convert("P"), "PNG", transparency=3),
        "deep.png": cv2.imencode(".png", deep)[1].tobytes(),
        "deep_gray.png": cv2.imencode(".png", deep[..., 0])[1].tobytes(),
        "plain.tif": saved(rgba, "TIFF", exif=exif, icc_profile=profile),
        "lzw.tif": saved(rgb, "TIFF", compression="tiff_lzw"),
        "jpeg.tif": saved(rgb, "TIFF", compression="jpeg"),
        "fax.tif": saved(rgb.convert("1"), "TIFF", compression="group4"),
        "deep.tif": cv2.imencode(".tiff", deep[..., :3])[1].tobytes(),
        "lossy.webp": saved(rgba, "WEBP", exif=exif, icc_profile=profile),
        "lossless.webp": saved(rgba, "WEBP", lossless=True),
        "moving.webp": saved(rgb, "WEBP", save_all=True, append_images=[rgb.rotate(90)]),
        "plain.heic": saved(rgb, "HEIF", quality=50, exif=exif.tobytes()),
        "alpha.heic": saved(rgba, "HEIF", quality=50),
        "plain.bmp": saved(rgb, "BMP"),
        "indexed.bmp": saved(rgb.convert("P"), "BMP"),
    }


def _films() -> dict[str, bytes]:
    import av
    import numpy as np

    wanted = (
        ("h264.mp4", "libx264", "mp4"), ("h264.mkv", "libx264", "matroska"),
        ("vp8.webm", "libvpx", "webm"), ("mpeg4.avi", "mpeg4", "avi"),
        ("motion.mov", "mjpeg", "mov"), ("h264.mts", "libx264", "mpegts"),
        ("mpeg2.mpg", "mpeg2video", "vob"), ("wmv2.wmv", "wmv2", "asf"),
    )  # fmt: skip
    films = {}
    pixels = np.random.default_rng(0).integers(0, 255, (6, 8, 3), np.uint8)
    for name, codec, kind in wanted:
        file = io.BytesIO()
        file.name = name
        with av.open(file, "w", format=kind) as container:
            stream: Any = container.add_stream(codec, rate=Fraction(25))
            stream.width, stream.height = 160, 120
            stream.pix_fmt = "yuvj420p" if codec == "mjpeg" else "yuv420p"
            for number in range(6):
                shown = np.kron(np.roll(pixels, number, 1), np.ones((20, 20, 1), np.uint8))
                for packet in stream.encode(av.VideoFrame.from_ndarray(shown, format="rgb24")):
                    container.mux(packet)
            for packet in stream.encode():
                container.mux(packet)
        films[name] = file.getvalue()
    return films


def case(seed: int, number: int, names: list[str]) -> tuple[str, bytes]:
    """The input of a number."""
    dice = random.Random(f"{seed}/{number}")
    name = names[number % len(names)]
    data = bytearray(seeds()[name])
    for _ in range(dice.choice((1, 1, 1, 2, 3))):
        dice.choice(DAMAGES)(data, dice)
    if name.endswith(".png") and dice.random() < 0.6:
        _mend_sums(data)
    return f"{number:06d}_{name}", bytes(data)


def _flip(data: bytearray, dice: random.Random) -> None:
    for _ in range(dice.choice((1, 4, 32))):
        if data:
            data[dice.randrange(len(data))] ^= 1 << dice.randrange(8)


def _flip_header(data: bytearray, dice: random.Random) -> None:
    for _ in range(dice.choice((1, 2, 6))):
        if data:
            data[dice.randrange(min(len(data), dice.choice((32, 128, 700))))] = dice.randrange(256)


def _cut(data: bytearray, dice: random.Random) -> None:
    del data[dice.randrange(len(data) + 1) :]


def _cut_out(data: bytearray, dice: random.Random) -> None:
    start = dice.randrange(len(data) + 1)
    del data[start : start + dice.choice((1, 4, 64, 1024))]


def _number(data: bytearray, dice: random.Random) -> None:
    """An integer somewhere (more often in the first bytes) becomes extreme: a length, a count."""
    size = dice.choice((2, 4, 4, 8))
    places = min(len(data), dice.choice((64, 512, len(data) + 1))) - size
    if places > 0:
        value = dice.choice(EXTREMES) & ((1 << 8 * size) - 1)
        start = dice.randrange(places)
        data[start : start + size] = value.to_bytes(size, dice.choice(("big", "little")))


def _repeat(data: bytearray, dice: random.Random) -> None:
    start = dice.randrange(len(data) + 1)
    part = data[start : start + dice.choice((4, 64, 1024))]
    data[start:start] = part * dice.choice((1, 3, 200))


def _fill(data: bytearray, dice: random.Random) -> None:
    start = dice.randrange(len(data) + 1)
    end = min(len(data), start + dice.choice((4, 64, 1024)))
    data[start:end] = bytes([dice.choice((0, 0xFF))]) * (end - start)


def _splice(data: bytearray, dice: random.Random) -> None:
    """The start of this file and the end of another."""
    other = seeds()[dice.choice(sorted(seeds()))]
    data[dice.randrange(len(data) + 1) :] = other[dice.randrange(len(other)) :]


DAMAGES: tuple[Callable[[bytearray, random.Random], None], ...] = (
    _flip, _flip, _flip_header, _flip_header, _cut, _cut_out, _number, _number, _number, _repeat,
    _fill, _splice,
)  # fmt: skip


def _mend_sums(data: bytearray) -> None:
    """Make the check sums of a PNG right, so that what was damaged is looked at."""
    place = 8
    while place + 12 <= len(data):
        (length,) = struct.unpack_from(">I", data, place)
        if place + 12 + length > len(data):
            return
        body = place + 8 + length
        struct.pack_into(">I", data, body, zlib.crc32(data[place + 4 : body]))
        place = body + 4


def read(path: Path) -> str:
    """What a run makes of a file: ``read``, ``refused`` (and why), ``BROKEN`` (and how)."""
    from pipeline.errors import RequestError
    from stages.views.find import is_video
    from stages.views.load import load_photos, load_video
    from stages.views.reading.video import Wanted

    try:
        if is_video(path):
            load_video(path.name, path, None, Wanted(3), 128, 16)
        else:
            load_photos({path.name: path}, {path.name: path}, 128, 16)
    except RequestError as error:
        if path.name not in str(error) or len(str(error)) > 1000:
            return f"BROKEN a message without the name, or too long: {error}"
        return f"refused {error}"
    except BaseException as error:
        return f"BROKEN {type(error).__name__}: {error}"
    return "read"


def work(seed: int) -> None:
    """Read the inputs whose numbers come on standard input."""
    import resource

    os.environ["OPENBLAS_NUM_THREADS"] = "1"
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    names = sorted(seeds())
    with tempfile.TemporaryDirectory() as folder:
        for line in sys.stdin:
            name, data = case(seed, int(line), names)
            path = Path(folder) / name
            path.write_bytes(data)
            print(read(path).replace("\n", " "), flush=True)
            path.unlink()


class Worker:
    """A process that reads inputs, and may die of one."""

    def __init__(self, seed: int) -> None:
        home = Path(__file__).resolve().parents[2]
        self._process = subprocess.Popen(
            [sys.executable, __file__, "--seed", str(seed), "--work"],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, bufsize=0,
            env={**os.environ, "PYTHONPATH": str(home)},
        )  # fmt: skip

    def verdict(self, number: int) -> str:
        assert self._process.stdin is not None and self._process.stdout is not None
        self._process.stdin.write(b"%d\n" % number)
        ready, _, _ = select.select([self._process.stdout], [], [], SECONDS)
        if not ready:
            self.stop()
            return f"BROKEN it took more than {SECONDS:.0f} seconds"
        line = self._process.stdout.readline().decode(errors="replace").strip()
        if not line:
            return f"BROKEN it ended the process (status {self._process.wait()})"
        return line

    @property
    def alive(self) -> bool:
        return self._process.poll() is None

    def stop(self) -> None:
        self._process.kill()
        self._process.wait()


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--first", type=int, default=0, help="the number of the first input")
    parser.add_argument("--keep", type=Path, help="a folder for the inputs that break something")
    parser.add_argument("--verbose", action="store_true", help="say what became of each input")
    parser.add_argument("--work", action="store_true", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.work:
        work(arguments.seed)
        return 0
    counts: Counter[tuple[str, str]] = Counter()
    broken, slowest, start = [], (0.0, ""), time.monotonic()
    names, worker = sorted(seeds()), Worker(arguments.seed)
    for number in range(arguments.first, arguments.first + arguments.count):
        if not worker.alive:
            worker = Worker(arguments.seed)
        name, data = case(arguments.seed, number, names)
        begun = time.monotonic()
        said = worker.verdict(number)
        slowest = max(slowest, (time.monotonic() - begun, name))
        word = said.split(" ", 1)[0]
        counts[name.rpartition(".")[2], word] += 1
        if arguments.verbose or word == "BROKEN":
            print(f"{name}: {said}", flush=True)
        if word == "BROKEN":
            broken.append(name)
            if arguments.keep:
                arguments.keep.mkdir(parents=True, exist_ok=True)
                (arguments.keep / name).write_bytes(data)
    worker.stop()
    for kind in sorted({kind for kind, _ in counts}):
        row = ", ".join(f"{counts[kind, word]} {word}" for word in ("read", "refused", "BROKEN"))
        print(f"{kind:>5}: {row}")
    seconds = time.monotonic() - start
    print(f"{arguments.count} inputs in {seconds:.0f} s; slowest {slowest[1]}, {slowest[0]:.1f} s")
    print(f"{len(broken)} BROKEN" if broken else "nothing broke")
    return 1 if broken else 0


if __name__ == "__main__":
    sys.exit(main())
