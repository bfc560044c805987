"""Pictures that are none, claim too much, or do harm to their decoders."""

from __future__ import annotations

import os
import socket
import struct
import subprocess
import sys
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pillow_heif
import pytest
from PIL import Image, PngImagePlugin

from pipeline.errors import RequestError
from pipeline.stage import LocalContext
from pipeline.untrusted.files import UnusableFile
from pipeline.untrusted.pictures import gray, look
from stages.views.find import find_images, find_masks
from stages.views.reading import decode
from stages.views.reading.decode import decode_mask, decode_photo
from stages.views.stage import ViewsConfig, ViewsStage
from tests.stages.views_pictures import encode

ROOT = Path(__file__).resolve().parents[2]
SAMPLES = ROOT / "data_samples" / "three_photos"
PHOTOS = sorted(SAMPLES.glob("*.jpg"))

pillow_heif.register_heif_opener()


def noise(width: int = 160, height: int = 120, channels: int = 3) -> Image.Image:
    pixels = np.random.default_rng(0).integers(0, 255, (height, width, channels), np.uint8)
    return Image.fromarray(pixels)


def chunk(name: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body))


def png(width: int, height: int, bits: int, colour: int, *more: bytes) -> bytes:
    header = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, bits, colour, 0, 0, 0))
    rest = [*more, chunk(b"IDAT", zlib.compress(bytes(1000))), chunk(b"IEND", b"")]
    return b"\x89PNG\r\n\x1a\n" + header + b"".join(rest)


def tiff(width: int, height: int, *tags: tuple[int, int, int, int]) -> bytes:
    """A TIFF of one strip; `tags` (tag, type, count, value) come in addition."""
    given = [
        (256, 4, 1, width), (257, 4, 1, height), (258, 3, 1, 8), (259, 3, 1, 1), (262, 3, 1, 1),
        (273, 4, 1, 8), (277, 3, 1, 1), (278, 4, 1, height), (279, 4, 1, 100), *tags,
    ]  # fmt: skip
    entries = b"".join(struct.pack("<HHII", *tag) for tag in sorted(given, key=lambda t: t[0]))
    return b"II*\0" + struct.pack("<IH", 8, len(given)) + entries + bytes(4) + bytes(200)


def webp(width: int, height: int) -> bytes:
    canvas = (width - 1).to_bytes(3, "little") + (height - 1).to_bytes(3, "little")
    body = b"WEBPVP8X" + struct.pack("<I", 10) + bytes(4) + canvas
    return b"RIFF" + struct.pack("<I", len(body)) + body


def jpeg(width: int, height: int) -> bytes:
    data = bytearray(encode(noise(), "JPEG"))
    place = data.index(b"\xff\xc0") + 5
    data[place : place + 4] = struct.pack(">HH", height, width)
    return bytes(data)


def bmp(width: int, height: int) -> bytes:
    data = bytearray(encode(noise(), "BMP"))
    data[18:26] = struct.pack("<ii", width, height)
    return bytes(data)


BOMBS = {
    "square.png": png(30_000, 30_000, 8, 2),
    "deep.png": png(17_000, 17_000, 16, 6),
    "line.png": png(2_147_483_647, 1, 8, 0),
    "upright.png": png(1, 2_147_483_647, 1, 0),
    "nothing.png": png(0, 100, 8, 0),
    "square.jpg": jpeg(60_000, 60_000),
    "square.bmp": bmp(50_000, 50_000),
    "line.bmp": bmp(1, -2_000_000_000),
    "square.tif": tiff(60_000, 60_000),
    "square.webp": webp(16_383, 16_383),
    "line.webp": webp(1 << 24, 64),
}


@pytest.mark.parametrize("name", BOMBS)
def test_size_is_refused_by_the_header(name: str) -> None:
    data = BOMBS[name]
    for read in (look, decode_photo, decode_mask, gray):
        with pytest.raises(UnusableFile, match=r"\d+ x \d+ pixels"):
            read(data)


def test_nothing_is_allocated_for_them(tmp_path: Path) -> None:
    """All of them in a process that may take 200 MB beyond what it has."""
    for name, data in BOMBS.items():
        (tmp_path / name).write_bytes(data)
    script = """
import resource, sys
from pathlib import Path
import cv2, pillow_heif
from PIL import Image, ImageCms, WebPImagePlugin, TiffImagePlugin
from pipeline.untrusted.files import UnusableFile
from stages.views.reading.decode import decode_photo
pages = int(Path("/proc/self/statm").read_text().split()[0])
limit = pages * resource.getpagesize() + 200_000_000
resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
for path in sorted(Path(sys.argv[1]).iterdir()):
    try:
        decode_photo(path.read_bytes())
    except UnusableFile as error:
        print(path.name, error)
"""
    done = subprocess.run(
        [sys.executable, "-c", script, str(tmp_path)], capture_output=True, text=True, cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT)}, timeout=60,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert len(done.stdout.splitlines()) == len(BOMBS)


def peak_share(data: bytes, pixels: int) -> float:
    """Bytes a pixel that decoding takes at its peak, in a process of its own."""
    script = """
import sys
from pathlib import Path
import cv2, pillow_heif
from stages.views.reading.decode import decode_photo
from pipeline.untrusted.pictures import large_pictures
def now(key):
    lines = Path("/proc/self/status").read_text().splitlines()
    return int(next(line for line in lines if line.startswith(key)).split()[1]) * 1024
data = sys.stdin.buffer.read()
Path("/proc/self/clear_refs").write_text("5")
before = now("VmRSS")
with large_pictures():
    decode_photo(data)
print(now("VmHWM") - before)
"""
    done = subprocess.run(
        [sys.executable, "-c", script], input=data, capture_output=True, cwd=ROOT, timeout=120,
        env={**os.environ, "PYTHONPATH": str(ROOT), "OPENBLAS_NUM_THREADS": "1"},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return float(done.stdout) / pixels


@pytest.mark.skipif(not Path("/proc/self/clear_refs").exists(), reason="peaks are Linux's")
@pytest.mark.parametrize(
    ("kind", "channels", "options"),
    [
        ("JPEG", 3, {}),
        ("JPEG", 3, {"progressive": True}),
        ("PNG", 4, {"compress_level": 0}),
        ("TIFF", 3, {}),
    ],
)
def test_memory_is_what_the_header_s_kind_says(
    kind: str, channels: int, options: dict[str, Any]
) -> None:
    image = noise(1000, 1000, channels).resize((5000, 4000), Image.Resampling.NEAREST)
    data = encode(image, kind, **options)
    strips = 40e6  # of constant size, beside the picture
    assert peak_share(data, 20_000_000) < min(look(data).memory, 14) + strips / 20e6


def test_only_named_formats_are_decoded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    marker = tmp_path / "started"
    program = tmp_path / "gs"
    program.write_text(f"#!/bin/sh\ntouch {marker}\nexit 1\n")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=os.pathsep)
    post = b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 200 200\n%%EndComments\nshowpage\n%%EOF\n"
    for read in (decode_photo, decode_mask, gray):
        with pytest.raises(UnusableFile, match="PostScript"):
            read(post)
    assert not marker.exists()
    others = {
        "GIF": (encode(noise().convert("P"), "GIF"), "a GIF"),
        "PPM": (encode(noise(), "PPM"), "not a readable"),
        "ICO": (encode(noise(64, 64), "ICO"), "not a readable"),
        "TGA": (encode(noise(), "TGA"), "not a readable"),
        "PDF": (b"%PDF-1.4\n", "a PDF"),
        "J2K": (encode(noise(), "JPEG2000"), "JPEG 2000"),
        "SVG": (b"<svg xmlns='http://www.w3.org/2000/svg'/>", "text file"),
        "DICOM": (bytes(128) + b"DICM", "a DICOM"),
        "film": (bytes(4) + b"ftypisom", "a film"),
    }
    for data, says in others.values():
        for read in (decode_photo, decode_mask, gray):
            with pytest.raises(UnusableFile, match=says):
                read(data)


def test_pictures_of_phones_with_a_second_picture_inside() -> None:
    both = encode(noise(), "MPO", save_all=True, append_images=[noise(80, 60)])
    assert decode_photo(both).rgb.shape == (120, 160, 3)


def test_texts_and_profiles_that_swell() -> None:
    """A megabyte of zeros is a kilobyte: what would swell is refused or left alone."""
    swollen = zlib.compress(bytes(200_000_000), 9)
    text = chunk(b"zTXt", b"Comment\0\0" + swollen)
    with pytest.raises(UnusableFile, match="damaged"):
        decode_photo(png(100, 100, 8, 0, text))
    profile = chunk(b"iCCP", b"x\0\0" + swollen)
    with pytest.raises(UnusableFile, match="damaged"):
        decode_photo(png(100, 100, 8, 0, profile))
    info = PngImagePlugin.PngInfo()
    info.add_text("Comment", "ordinary", zip=True)
    assert decode_photo(encode(noise(), "PNG", pnginfo=info)).rgb.shape == (120, 160, 3)


@pytest.mark.parametrize(
    ("tag", "says"),
    [
        ((256, 4, 1, 60_000), "twice"),
        ((277, 3, 1, 1), "twice"),
        ((330, 4, 1 << 30, 8), "1,073,741,824 numbers"),
        ((270, 5, 1 << 24, 8), "16,777,216 numbers"),
    ],
)
def test_tags_that_lie(tag: tuple[int, int, int, int], says: str) -> None:
    with pytest.raises(UnusableFile, match=says):
        decode_photo(tiff(100, 100, tag))


def two_and(folder: Path, name: str, data: bytes) -> Path:
    folder.mkdir(exist_ok=True)
    for photo in PHOTOS[:2]:
        (folder / photo.name).write_bytes(photo.read_bytes())
    (folder / name).write_bytes(data)
    return folder


def refused(folder: Path, **settings: Any) -> str:
    with pytest.raises(RequestError) as caught:
        config = ViewsConfig(**settings)
        sources = ViewsStage().sources(config, {"images": [folder]})
        ViewsStage().run(LocalContext(config=config, folder=folder / "o", sources=sources))
    return str(caught.value)


@pytest.mark.parametrize("name", ["post.jpg", "deep.png", "square.tif", "broken.heic"])
def test_the_message_names_the_file(tmp_path: Path, name: str) -> None:
    heic = encode(noise(), "HEIF", quality=50)
    data = {
        **BOMBS, "post.jpg": b"%!PS-Adobe-3.0 EPSF-3.0\n", "broken.heic": heic[: len(heic) // 2],
    }[name]  # fmt: skip
    message = refused(two_and(tmp_path / "p", name, data))
    assert f"{name} " in message
    assert "remove it" in message


def test_a_mask_is_a_picture_too(tmp_path: Path) -> None:
    folder = two_and(tmp_path / "p", "third.jpg", PHOTOS[2].read_bytes())
    masks = tmp_path / "masks"
    masks.mkdir()
    (masks / "third.png").write_bytes(b"%!PS-Adobe-3.0 EPSF-3.0\n")
    message = refused(folder, masks=masks)
    assert "third.jpg has a mask (third.png)" in message
    assert "PostScript" in message


def test_heic_and_tiff_are_decoded_elsewhere(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In a case with both, the run itself opens neither."""
    folder = two_and(tmp_path / "p", "a.heic", encode(noise(), "HEIF", quality=90))
    (folder / "b.tif").write_bytes(encode(noise(170, 120), "TIFF", compression="tiff_lzw"))
    kinds = []
    opened = decode.opened

    def note(data: bytes, header: Any) -> Any:
        kinds.append(header.kind)
        return opened(data, header)

    monkeypatch.setattr(decode, "opened", note)
    config = ViewsConfig()
    sources = ViewsStage().sources(config, {"images": [folder]})
    context = LocalContext(config=config, folder=tmp_path / "o", sources=sources)
    ViewsStage().run(context)
    assert len(context.result("views")) == 4
    assert kinds == ["JPEG", "JPEG"]


def pipe(path: Path) -> None:
    os.mkfifo(path)


def device(path: Path) -> None:
    path.symlink_to("/dev/zero")


def connection(path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as listening:
        here = Path.cwd()
        os.chdir(path.parent)  # the name of a socket has at most 107 bytes
        try:
            listening.bind(path.name)
        finally:
            os.chdir(here)


def link_to_a_pipe(path: Path) -> None:
    hidden = path.with_name(f"{path.name}.hidden")
    os.mkfifo(hidden)
    path.symlink_to(hidden)


@pytest.mark.parametrize(
    ("make", "sort"),
    [
        (pipe, "a named pipe"), (device, "a device"), (connection, "a socket"),
        (link_to_a_pipe, "a named pipe"),
    ],
)  # fmt: skip
def test_only_files_are_read(tmp_path: Path, make: Callable[[Path], None], sort: str) -> None:
    folder = two_and(tmp_path / "p", "c.jpg", PHOTOS[2].read_bytes())
    masks = tmp_path / "masks"
    masks.mkdir()
    make(masks / "c.png")
    with pytest.raises(RequestError, match=f"c.png is {sort}"):
        find_masks(masks, ["a.jpg", "c.jpg"])
    make(folder / "trap.jpg")
    for asked in (folder, f"{folder}/*.jpg", folder / "trap.jpg"):
        with pytest.raises(RequestError, match=f"trap.jpg is {sort}"):
            find_images([PHOTOS[0], asked])
    make(folder / "trap.mp4")
    with pytest.raises(RequestError, match=f"trap.mp4 is {sort}"):
        find_images([folder / "trap.mp4"])


def test_a_pipe_ends_the_command(tmp_path: Path) -> None:
    folder = two_and(tmp_path / "p", "c.jpg", PHOTOS[2].read_bytes())
    pipe(folder / "trap.jpg")
    done = subprocess.run(
        [sys.executable, "-m", "pipeline.cli", "run", str(folder), "-w", str(tmp_path / "w")],
        capture_output=True, text=True, timeout=60, cwd=ROOT,
    )  # fmt: skip
    assert done.returncode == 2
    assert "trap.jpg is a named pipe" in done.stderr
