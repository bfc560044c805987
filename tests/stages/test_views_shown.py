"""Films are read as players show them: their colours, and one moment a frame."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import numpy.typing as npt
import pytest

from stages.views.reading.hdr import srgb_from_hdr
from tests.films import read_frames

Floats = npt.NDArray[np.float64]
COLOURS = np.array(
    [(200, 40, 40), (40, 200, 40), (40, 40, 200), (225, 195, 170), (180, 90, 100), (128, 128, 128)]
)
#: FFmpeg's numbers of a matrix, and the shares of red and blue in its luma
UNTOLD, BT709, BT601, BT2020 = 2, 1, 6, 9
SHARES = {BT709: (0.2126, 0.0722), BT601: (0.299, 0.114), BT2020: (0.2627, 0.0593)}
PQ, HLG = 16, 18


def coloured_film(
    path: Path, codec: str, size: tuple[int, int], made: int, told: int,
    curve: int = 0, colours: Floats = COLOURS / 255,
) -> Path:  # fmt: skip
    """Write a film of plain bars, by the matrix `made`, that says that it is `told`."""
    bits, bar = (10, np.uint16) if curve else (8, np.uint8), size[0] // len(colours)
    red, blue = SHARES[made]
    luma = colours @ (red, 1 - red - blue, blue)
    planes = (
        16 + 219 * luma,
        128 + 112 * (colours[:, 2] - luma) / (1 - blue),
        128 + 112 * (colours[:, 0] - luma) / (1 - red),
    )
    with av.open(str(path), "w") as container:
        stream: Any = container.add_stream(codec, rate=Fraction(25))
        stream.width, stream.height = size
        stream.pix_fmt = "yuv420p10le" if curve else "yuv420p"
        stream.codec_context.colorspace = told
        if codec == "libvpx":
            stream.bit_rate = 20_000_000
        else:
            stream.options = {"x265-params": "log-level=none:crf=4", "preset": "ultrafast"}
        if curve:
            stream.codec_context.color_trc, stream.codec_context.color_primaries = curve, 9
        frame = av.VideoFrame(*size, stream.pix_fmt)
        for plane, values in zip(frame.planes, planes, strict=True):
            wide = bar * plane.width // size[0]
            row: Any = np.zeros(plane.line_size // np.dtype(bits[1]).itemsize, bits[1])
            levels = np.round(values * 2 ** (bits[0] - 8)).astype(bits[1])
            row[: wide * len(colours)] = levels.repeat(wide)
            plane.update(np.tile(row, (plane.height, 1)).tobytes())
        for time in range(3):
            frame.pts = time
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return path


def colours_of(path: Path) -> Floats:
    """[N, 3] of the bars in the first frame."""
    rgb = read_frames(path, 2)[0].rgb
    bar = rgb.shape[1] // len(COLOURS)
    return rgb[40:60, bar // 2 :: bar][:, : len(COLOURS)].mean(0)


@pytest.mark.parametrize(
    ("codec", "name", "size", "made", "told"),
    [
        ("libx264", "x.mp4", (1280, 96), BT709, UNTOLD),
        ("libx264", "x.mp4", (96, 1280), BT709, UNTOLD),
        ("libx264", "x.mp4", (1280, 96), BT601, BT601),
        ("libx264", "x.mp4", (480, 96), BT601, UNTOLD),
        ("libvpx", "x.webm", (1280, 96), BT601, UNTOLD),  # VP8 has no other
    ],
)
def test_colours_that_a_film_does_not_tell(
    tmp_path: Path, codec: str, name: str, size: tuple[int, int], made: int, told: int
) -> None:
    path = coloured_film(tmp_path / name, codec, size, made, told)
    np.testing.assert_allclose(colours_of(path), COLOURS, atol=4)


@pytest.mark.parametrize("curve", [PQ, HLG])
def test_hdr_films_are_neither_pale_nor_dark(tmp_path: Path, curve: int) -> None:
    shown = ((COLOURS / 255 + 0.055) / 1.055) ** 2.4 @ np.array(
        [[0.6274, 0.0691, 0.0164], [0.3293, 0.9195, 0.0880], [0.0433, 0.0114, 0.8956]]
    )  # light of BT.2020's primaries, 1 at white
    if curve == PQ:
        light = (203 / 10_000 * shown) ** 0.1593017578125
        signal = ((0.8359375 + 18.8515625 * light) / (1 + 18.6875 * light)) ** 78.84375
    else:
        of_peak = 0.203 * shown
        luminance = of_peak @ np.array([0.2627, 0.6780, 0.0593])
        scene = of_peak * luminance[:, None] ** (1 / 1.2 - 1)
        bright = 0.17883277 * np.log(np.maximum(12 * scene - 0.28466892, 1e-9)) + 0.55991073
        signal = np.where(scene <= 1 / 12, np.sqrt(3 * scene), bright)
    path = coloured_film(tmp_path / "x.mp4", "libx265", (480, 96), BT2020, BT2020, curve, signal)
    np.testing.assert_allclose(colours_of(path), COLOURS, atol=4)


@pytest.mark.parametrize("curve", [PQ, HLG])
def test_highlights_of_hdr_films_are_not_cut_off(curve: int) -> None:
    ramp: Any = np.linspace(0, 65535, 400).astype(np.uint16)[None, :, None].repeat(3, 2)
    shown = srgb_from_hdr(ramp, curve)[0].astype(int)
    assert (shown.max(1) - shown.min(1)).max() <= 1
    assert (np.diff(shown[:, 0]) >= 0).all()
    assert (shown[:, 0] == 255).mean() < 0.35
    assert shown[0, 0] == 0


@pytest.mark.parametrize("moving", [True, False])
def test_interlaced_frames_show_one_moment(tmp_path: Path, moving: bool) -> None:
    blobs = np.random.default_rng(0).integers(0, 255, (24, 60), np.uint8)
    picture = cv2.resize(blobs, (480, 192))[..., None].repeat(3, 2)

    def at(time: int) -> npt.NDArray[Any]:
        return picture[:, 5 * time : 5 * time + 320]

    path = tmp_path / "x.mp4"
    with av.open(str(path), "w") as container:
        stream: Any = container.add_stream("libx264", rate=Fraction(25))
        stream.width, stream.height, stream.pix_fmt = 320, 192, "yuv420p"
        stream.options = {"crf": "1", "flags": "+ildct+ilme"}
        for number in range(6):
            pixels = at(2 * number).copy()
            pixels[1::2] = at(2 * number + moving)[1::2]
            container.mux(stream.encode(av.VideoFrame.from_ndarray(pixels, format="rgb24")))
        container.mux(stream.encode())
    for frame in read_frames(path, 6):
        wrong = np.abs(frame.rgb.mean(-1) - at(2 * frame.index).mean(-1)).mean(1)
        assert wrong[::2].mean() < 2
        assert wrong[1::2].mean() < 4
