"""Films that are scripts, lie about themselves, or name other files."""

from __future__ import annotations

import struct
import subprocess
import sys
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest

from pipeline.errors import RequestError
from pipeline.stage import LocalContext
from pipeline.untrusted.files import UnusableFile
from pipeline.untrusted.films import reader_for
from stages.views.reading.video import VideoFrame
from stages.views.stage import ViewsConfig, ViewsStage
from tests.films import read_frames as read_some_frames

ROOT = Path(__file__).resolve().parents[2]
BRIGHT = 200


def film(
    path: Path, codec: str = "libx264", kind: str | None = None, brightness: int = BRIGHT,
    count: int = 8,
) -> Path:  # fmt: skip
    with av.open(str(path), "w", format=kind) as container:
        stream: Any = container.add_stream(codec, rate=Fraction(25))
        stream.width, stream.height, stream.pix_fmt = 160, 96, "yuv420p"
        for number in range(count):
            pixels = np.full((96, 160, 3), brightness - 6 * number, np.uint8)
            for packet in stream.encode(av.VideoFrame.from_ndarray(pixels, format="rgb24")):
                container.mux(packet)
        for packet in stream.encode():
            container.mux(packet)
    return path


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    return film(tmp_path_factory.mktemp("film") / "good.mp4").read_bytes()


def refused(path: Path) -> str:
    """What a run says of a film that it can't use."""
    config = ViewsConfig()
    with pytest.raises(RequestError) as caught:
        sources = ViewsStage().sources(config, {"images": [path]})
        context = LocalContext(config=config, folder=path.parent / "o", sources=sources)
        ViewsStage().run(context)
    assert path.name in str(caught.value)
    return str(caught.value)


def read_frames(path: Path, wanted: int) -> list[VideoFrame]:
    """With glances all over the film first."""
    return read_some_frames(path, wanted, by_difference=True)


@pytest.mark.parametrize(
    ("name", "codec", "kind"),
    [
        ("a.mp4", "libx264", None), ("a.mov", "mpeg4", None), ("a.mkv", "libx264", None),
        ("a.webm", "libvpx", None), ("a.avi", "mpeg4", None), ("a.mts", "libx264", "mpegts"),
        ("a.mpg", "mpeg2video", "vob"), ("a.wmv", "wmv2", "asf"), ("a.3gp", "libx264", None),
        ("wrong_name.avi", "libx264", "mp4"),
    ],
)  # fmt: skip
def test_films_are_known_by_their_content(
    tmp_path: Path, name: str, codec: str, kind: str | None
) -> None:
    assert len(read_frames(film(tmp_path / name, codec, kind), 3)) == 3


SCRIPTS = {
    "concat.mp4": "ffconcat version 1.0\nfile good.mp4\n",
    "hls.mp4": "#EXTM3U\n#EXT-X-TARGETDURATION:2\n#EXTINF:2,\ngood.mp4\n#EXT-X-ENDLIST\n",
    "sdp.mp4": "v=0\no=- 0 0 IN IP4 127.0.0.1\ns=x\nc=IN IP4 127.0.0.1\nm=video 5004 RTP/AVP 96\n",
    "dash.mp4": '<?xml version="1.0"?><MPD xmlns="urn:mpeg:dash:schema:mpd:2011"><Period>'
    "<AdaptationSet><Representation><BaseURL>good.mp4</BaseURL></Representation></AdaptationSet>"
    "</Period></MPD>",
}


@pytest.mark.parametrize("name", SCRIPTS)
def test_scripts_are_no_films(tmp_path: Path, good: bytes, name: str) -> None:
    (tmp_path / "good.mp4").write_bytes(good)
    (tmp_path / name).write_text(SCRIPTS[name])
    assert "can't be read as a video: it is a" in refused(tmp_path / name)


@pytest.mark.parametrize(
    "name", ["concat:good.mp4", "subfile,,start,0,end,0,,:good.mp4", "g%d.mp4"]
)
def test_names_are_names(tmp_path: Path, good: bytes, name: str) -> None:
    """What FFmpeg would take for an address or a pattern is the file that is called so."""
    (tmp_path / "good.mp4").write_bytes(good)
    (tmp_path / "g1.mp4").write_bytes(good)
    with pytest.raises(UnusableFile, match="No such file"):
        read_frames(tmp_path / name, 2)
    (tmp_path / name).write_bytes(good)
    assert len(read_frames(tmp_path / name, 2)) == 2


def boxes(data: bytes, start: int, end: int) -> dict[bytes, int]:
    """Name -> place of the boxes of an MP4 between two places."""
    found = {}
    while start + 8 <= end:
        size = int.from_bytes(data[start : start + 4])
        found[data[start + 4 : start + 8]] = start
        start += max(size, 8)
    return found


def pointing_elsewhere(data: bytes, entry: bytes) -> bytes:
    """An MP4 (whose header comes last) whose samples lie in another file."""
    changed = bytearray(data)
    start, end, parents = 0, len(data), []
    for name in (b"moov", b"trak", b"mdia", b"minf", b"dinf", b"dref"):
        start = boxes(bytes(changed), start, end)[name]
        end = start + int.from_bytes(changed[start : start + 4])
        parents.append(start)
        start += 8
    old = int.from_bytes(changed[start + 8 : start + 12])
    changed[start + 8 : start + 8 + old] = entry
    for place in parents:
        size = int.from_bytes(changed[place : place + 4]) + len(entry) - old
        changed[place : place + 4] = size.to_bytes(4, "big")
    media = boxes(data, 0, len(data))[b"mdat"]
    size = int.from_bytes(data[media : media + 4])
    changed[media + 8 : media + size] = bytes(size - 8)  # nothing in this file itself
    return bytes(changed)


def alias(path: Path) -> bytes:
    """A Macintosh alias record that leads to a file by its path."""
    name = path.name.encode()
    record = bytearray(150)
    record[4:6] = (150).to_bytes(2, "big")
    record[10] = 4
    record[11:15] = b"disk"
    record[50] = len(name)
    record[51 : 51 + len(name)] = name
    text = b"disk" + str(path).encode()
    record += struct.pack(">HH", 2, len(text)) + text + bytes(len(text) % 2)
    record += struct.pack(">hH", -1, 0)
    return struct.pack(">I", 12 + len(record)) + b"alis" + bytes(4) + bytes(record)


def brightness(path: Path, **options: str) -> float:
    with av.open(str(path), options=options) as container:
        return float(next(container.decode(video=0)).to_ndarray(format="rgb24").mean())


def test_samples_in_other_files_are_not_followed(tmp_path: Path, good: bytes) -> None:
    secret = tmp_path / "secret.mp4"
    secret.write_bytes(good)
    trap = tmp_path / "trap.mp4"
    trap.write_bytes(pointing_elsewhere(good, alias(secret)))
    # FFmpeg would, where it is allowed to: the trap is one.
    seen = brightness(trap, enable_drefs="1", use_absolute_path="1")
    assert seen == pytest.approx(BRIGHT, abs=6)
    try:
        frames = read_frames(trap, 2)
    except UnusableFile:
        return
    assert all(abs(float(frame.rgb.mean()) - BRIGHT) > 60 for frame in frames)


def test_an_unknown_codec(tmp_path: Path, good: bytes) -> None:
    path = tmp_path / "codec.mp4"
    path.write_bytes(good.replace(b"avc1", b"XXXX"))
    assert "coded in a way that is not known" in refused(path)
    done = subprocess.run(
        [sys.executable, "-m", "pipeline.cli", "run", str(path), "-w", str(tmp_path / "w")],
        capture_output=True, text=True, timeout=60, cwd=ROOT,
    )  # fmt: skip
    assert done.returncode == 2, done.stderr
    assert "codec.mp4" in done.stderr
    assert "save it again as MP4" in done.stderr


def test_huge_frames_are_refused_by_the_header(tmp_path: Path) -> None:
    path = film(tmp_path / "huge.avi", "mpeg4")
    data = bytearray(path.read_bytes())
    place = data.index(b"strf") + 8  # a BITMAPINFOHEADER
    data[place + 4 : place + 12] = struct.pack("<ii", 60_000, 60_000)
    data[place + 16 : place + 20] = struct.pack("<I", 0)  # uncompressed
    path.write_bytes(data)
    message = refused(path)
    assert "60000 x 60000" in message or "can't be read as a video" in message


@pytest.mark.parametrize("table", [b"stts", b"stsz", b"stco", b"stsc"])
def test_counts_that_lie(tmp_path: Path, good: bytes, table: bytes) -> None:
    data = bytearray(good)
    place = data.index(table) + (12 if table == b"stsz" else 8)
    data[place : place + 4] = struct.pack(">I", 0x7FFFFFFF)
    path = tmp_path / "lies.mp4"
    path.write_bytes(data)
    try:
        frames = read_frames(path, 3)
    except UnusableFile as error:
        assert "can't be" in str(error) or "memory" in str(error) or "no video" in str(error)
    else:
        assert len(frames) <= 3


@pytest.mark.parametrize(
    ("head", "says"),
    [
        (b"", "empty"),
        (b"GIF89a" + bytes(60), "not MP4"),
        (b"\x7fELF" + bytes(60), "not MP4"),
        (b"hello\n" * 20, "text file"),
        (b"\xef\xbb\xbf\n#EXTM3U\n", "playlist"),
    ],
)
def test_what_is_no_film(head: bytes, says: str) -> None:
    with pytest.raises(UnusableFile, match=says):
        reader_for(head)
