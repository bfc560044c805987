"""Films: which frames, when, which way up, and what is said of broken ones."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import numpy.typing as npt
import pytest
from PIL import Image

from pipeline.errors import RequestError
from pipeline.stage import LocalContext
from pipeline.untrusted.files import FILM, opened
from stages.views.load import load_video
from stages.views.reading.video import Wanted, map_frames
from stages.views.sampling import even_in_time
from stages.views.stage import ViewsConfig, ViewsStage
from tests.films import read_frames

QUARTER_TURN_CLOCKWISE = (0, 1, -1, 0)  # a, b, c, d: x' = a x + c y, y' = b x + d y


def level(index: int) -> int:
    """Brightness that tells which frame it is."""
    return 40 + 6 * index


def film(
    path: Path, count: int = 30, codec: str = "libx264", size: tuple[int, int] = (160, 96),
    coded: str = "", bars: int = 0, pixel: Fraction | None = None,
    ticks: Sequence[int] | None = None, **container_options: str,
) -> Path:  # fmt: skip
    """Write a film whose frame n is of brightness `level(n)`, red at the top left.

    `coded` are options of x264, `bars` the widths of black ones on the left and right, `pixel` is
    the width of a pixel over its height, `ticks` say when frames are shown, in 25ths of a second.
    """
    with av.open(str(path), "w", options=container_options) as container:
        stream: Any = container.add_stream(codec, rate=Fraction(25))
        stream.width, stream.height, stream.pix_fmt = *size, "yuv420p"
        if pixel is not None:
            stream.codec_context.sample_aspect_ratio = pixel
        if codec == "libx264":
            stream.options = {"crf": "10", "threads": "1", "x264-params": coded}
        else:
            stream.bit_rate = 8_000_000
        for index in range(count):
            pixels = np.full((size[1], size[0], 3), level(index), np.uint8)
            pixels[:32, :48] = (250, 10, 10)
            if bars:
                blobs = np.random.default_rng(0).integers(0, 160, (12, 20, 3), np.uint8)
                pixels += cv2.resize(blobs, size) // 2  # or all would be plain
                pixels[:, :bars] = pixels[:, size[0] - bars :] = 0
            frame = av.VideoFrame.from_ndarray(pixels, format="rgb24")
            if ticks is not None:
                frame.pts, frame.time_base = ticks[index], Fraction(1, 25)
            for packet in stream.encode(frame):
                container.mux(packet)
        for packet in stream.encode():
            container.mux(packet)
    return path


def turn_film(path: Path, matrix: tuple[int, int, int, int]) -> None:
    """Set the display matrix in the track header of an MP4."""
    data = bytearray(path.read_bytes())
    start = data.index(b"tkhd") + 4 + 40  # version 0: 40 bytes before the matrix
    a, b, c, d = (int(value * 65536).to_bytes(4, "big", signed=True) for value in matrix)
    zero = bytes(4)
    data[start : start + 36] = a + b + zero + c + d + zero + zero + zero + (1 << 30).to_bytes(4)
    path.write_bytes(data)


def indices_by_brightness(frames: Any) -> list[int]:
    return [round((float(frame.rgb[60:, 80:].mean()) - 40) / 6) for frame in frames]


@pytest.mark.parametrize(("codec", "name"), [("libx264", "x.mp4"), ("mpeg4", "x.avi")])
def test_uniform_sampling(tmp_path: Path, codec: str, name: str) -> None:
    frames = read_frames(film(tmp_path / name, codec=codec), 4)
    assert [frame.index for frame in frames] == [0, 10, 19, 29]
    assert indices_by_brightness(frames) == [0, 10, 19, 29]
    np.testing.assert_allclose([f.seconds for f in frames], [0, 0.4, 0.76, 1.16], atol=1e-6)
    assert {frame.orientation for frame in frames} == {1}


@pytest.mark.parametrize("coded", ["keyint=5:min-keyint=5", "keyint=5:intra-refresh=1"])
@pytest.mark.parametrize("name", ["x.mp4", "x.mkv"])
def test_frames_are_even_in_time_where_their_pace_changes(
    tmp_path: Path, name: str, coded: str
) -> None:
    """As of phones, which take fewer frames where it is dark."""
    slow = [2 * k for k in range(20)] + [40 + 8 * k for k in range(10)]
    frames = read_frames(film(tmp_path / name, coded=coded, ticks=slow), 5)
    times = [frame.seconds for frame in frames]
    assert np.allclose(times, np.linspace(0, slow[-1] / 25, 5), atol=4 / 25 + 1e-3)
    assert indices_by_brightness(frames) == [frame.index for frame in frames]


def test_no_frame_is_taken_twice() -> None:
    assert even_in_time([0, 1, 2, 3, 4, 100], 4) == [0, 3, 4, 5]
    assert even_in_time([0, 96, 97, 98, 99, 100], 4) == [0, 1, 2, 5]
    assert even_in_time([0, 1, 2], 3) == even_in_time([0, 1, 2], 5) == [0, 1, 2]


def test_all_frames_of_a_short_film_and_any_thread_count(tmp_path: Path) -> None:
    path = film(tmp_path / "x.mp4", count=5)
    one, two = read_frames(path, 24, threads=1), read_frames(path, 24, threads=2)
    assert [frame.index for frame in one] == [0, 1, 2, 3, 4]
    for a, b in zip(one, two, strict=True):
        np.testing.assert_array_equal(a.rgb, b.rgb)


@pytest.mark.parametrize(
    ("name", "coded", "all_decoded"),
    [
        ("keys.mp4", "keyint=5:min-keyint=5", False),
        ("keys.mkv", "keyint=5:min-keyint=5", False),
        ("open.mp4", "keyint=5:min-keyint=5:open-gop=1:bframes=2", False),
        ("few_keys.mp4", "keyint=infinite:scenecut=0", True),
        ("no_whole_keys.mp4", "keyint=5:intra-refresh=1", True),
        ("no_index.ts", "keyint=5:min-keyint=5", True),
    ],
)
def test_frames_are_the_same_where_not_all_are_decoded(
    tmp_path: Path, name: str, coded: str, all_decoded: bool
) -> None:
    path = film(tmp_path / name, count=35, coded=coded)
    every = read_frames(path, 35)
    decoded: set[int] = set()
    with opened(path, FILM) as file:
        chosen = map_frames(
            file, lambda frame: frame, Wanted(3), 1, lambda done, _: decoded.add(done)
        )
    assert [frame.index for frame in chosen] == [0, 17, 34]
    assert indices_by_brightness(chosen) == [0, 17, 34]
    for frame in chosen:
        np.testing.assert_array_equal(frame.rgb, every[frame.index].rgb)
        assert frame.seconds == every[frame.index].seconds
    assert (21 in decoded) == all_decoded  # it is said of every tenth; frames 18 to 29 aren't used


@pytest.mark.parametrize(
    ("matrix", "orientation", "red"),
    [
        (QUARTER_TURN_CLOCKWISE, 6, (0, -1)),
        ((0, -1, 1, 0), 8, (-1, 0)),
        ((-1, 0, 0, -1), 3, (-1, -1)),
        ((-1, 0, 0, 1), 2, (0, -1)),  # mirrored
        ((1, 0, 0, -1), 4, (-1, 0)),
        ((0, 1, 1, 0), 5, (0, 0)),
        ((0, -1, -1, 0), 7, (-1, -1)),
    ],
)
def test_display_matrix(
    tmp_path: Path, matrix: tuple[int, int, int, int], orientation: int, red: tuple[int, int]
) -> None:
    path = film(tmp_path / "x.mp4", count=4)
    turn_film(path, matrix)
    assert {frame.orientation for frame in read_frames(path, 4)} == {orientation}
    views, _ = run_stage(tmp_path / "out", path)
    view = views.views[0]
    assert (view.width, view.height) == ((160, 96) if orientation < 5 else (96, 160))
    corner = view.image[red]
    assert corner[0] > 0.8
    assert corner[1] < 0.3
    x, y, _ = view.working_from_source @ (0.5, 0.5, 1)
    np.testing.assert_array_equal(view.image[int(y), int(x)], corner)


@pytest.mark.parametrize(
    ("codec", "name", "pixel", "size"),
    [
        ("libx264", "x.mp4", Fraction(4, 3), (213, 96)),  # from the key frames
        ("mpeg4", "x.avi", Fraction(4, 3), (213, 96)),  # in one go
        ("libx264", "x.mp4", Fraction(2, 3), (160, 144)),
        ("libx264", "x.mp4", Fraction(200, 1), (160, 96)),  # no film is so
    ],
)
def test_pixels_that_are_not_square_are_made_so(
    tmp_path: Path, codec: str, name: str, pixel: Fraction, size: tuple[int, int]
) -> None:
    path = film(tmp_path / name, count=4, codec=codec, pixel=pixel)
    views, _ = run_stage(tmp_path / "out", path)
    assert {(view.width, view.height) for view in views.views} == {size}
    assert {view.source_size for view in views.views} == {size}
    red = views.views[0].image[..., 0] > 0.8
    assert red.any(0).sum() == pytest.approx(48 * size[0] / 160, abs=2)
    assert red.any(1).sum() == pytest.approx(32 * size[1] / 96, abs=2)


def run_stage(folder: Path, path: Path, **settings: Any) -> tuple[Any, LocalContext]:
    config = ViewsConfig(**settings)
    sources = ViewsStage().sources(config, {"images": [path]})
    context = LocalContext(config=config, folder=folder, sources=sources, threads=1)
    ViewsStage().run(context)
    return context.result("views"), context


def test_stage_on_a_film(tmp_path: Path) -> None:
    path = film(tmp_path / "my film.mp4")
    views, _ = run_stage(tmp_path / "a", path)
    assert len(views) == 24
    assert views.ordered
    views, context = run_stage(
        tmp_path / "b", path, frames=3, sampling="time", long_side=80, min_side=30
    )
    assert [view.source_name for view in views.views] == [
        "my film.mp4#0", "my film.mp4#14", "my film.mp4#29",
    ]  # fmt: skip
    assert [view.timestamp for view in views.views] == [0.0, 0.56, 1.16]
    assert views.views[0].image.shape == (48, 80, 3)
    assert views.views[0].source_size == (160, 96)
    assert context.figures["views"] == 3


@pytest.mark.parametrize(("count", "times"), [(30, 1), (4, 2)])
def test_a_film_is_read_at_the_size_that_its_frames_may_have(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, count: int, times: int
) -> None:
    sizes: list[int] = []

    def noted(*positional: Any, long_side: int, **named: Any) -> Any:
        sizes.append(long_side)
        return load_video(*positional, long_side=long_side, **named)

    monkeypatch.setattr("stages.views.load.load_video", noted)
    run_stage(tmp_path / "a", film(tmp_path / "x.mp4", count=count))
    assert sizes == [512, 1024][:times]  # fewer frames than were asked for may be larger


def test_one_mask_for_the_film(tmp_path: Path) -> None:
    path = film(tmp_path / "x.mp4", count=3)
    (tmp_path / "masks").mkdir()
    mask: npt.NDArray[np.uint8] = np.zeros((96, 160), np.uint8)
    mask[:, 80:] = 255
    Image.fromarray(mask).save(tmp_path / "masks" / "x.png")
    views, _ = run_stage(tmp_path / "out", path, masks=tmp_path / "masks")
    for view in views.views:
        np.testing.assert_array_equal(view.mask, mask > 0)
    Image.fromarray(mask[:, :96]).save(tmp_path / "masks" / "x.png")
    with pytest.raises(RequestError, match="proportions") as caught:
        run_stage(tmp_path / "again", path, masks=tmp_path / "masks")
    assert "Mend the mask" in str(caught.value)
    assert "MP4" not in str(caught.value)  # the film is good


@pytest.mark.parametrize("turned", [False, True])
def test_bars_beside_a_film_are_cut_off(tmp_path: Path, turned: bool) -> None:
    path = film(tmp_path / "x.mp4", count=9, bars=24)
    if turned:
        turn_film(path, (0, 1, -1, 0))
    mask: npt.NDArray[np.uint8] = np.zeros((96, 160), np.uint8)
    mask[:, 80:] = 255
    (tmp_path / "masks").mkdir()
    Image.fromarray(mask).save(tmp_path / "masks" / "x.png")
    settings = {"frames": 9, "min_side": 30}
    views, _ = run_stage(tmp_path / "out", path, masks=tmp_path / "masks", **settings)
    shape = (112, 96) if turned else (96, 112)
    corner = (0, 24) if turned else (24, 0)
    for view in views.views:
        assert view.image.shape[:2] == shape
        assert view.source_size == (160, 96)
        np.testing.assert_allclose(view.working_place(corner), 0, atol=1e-9)
        assert view.mask is not None and 0.4 < view.mask.mean() < 0.6
    whole, _ = run_stage(tmp_path / "whole", path, cut_sheets=False, **settings)
    assert {view.image.shape[:2] for view in whole.views} == {(160, 96) if turned else (96, 160)}


def refused(folder: Path, path: Path, **settings: Any) -> str:
    with pytest.raises(RequestError) as caught:
        run_stage(folder, path, **settings)
    return str(caught.value)


def test_a_frame_to_hold_out_that_is_not_there(tmp_path: Path) -> None:
    path = film(tmp_path / "x.mp4", count=8)
    for name in ("x.mp4#99", "x", "y#3"):
        message = refused(tmp_path / "out", path, held_out=(name,))
        assert "as in x.mp4#7." in message
        assert "Did you mean" not in message  # the film itself is no frame of it


def test_broken_films(tmp_path: Path) -> None:
    text = tmp_path / "text.mp4"
    text.write_text("not a film\n" * 50)
    assert "text.mp4 can't be read as a video" in refused(tmp_path / "a", text)
    whole = film(tmp_path / "whole.mp4").read_bytes()
    cut = tmp_path / "cut.mp4"  # the index lies at the end of the file, so nothing can be read
    cut.write_bytes(whole[: len(whole) // 2])
    assert "cut.mp4 can't be read as a video" in refused(tmp_path / "b", cut)
    short = film(tmp_path / "short.mp4", count=1)
    assert "short.mp4: one frame only" in refused(tmp_path / "c", short)
    narrow = film(tmp_path / "narrow.mp4", count=3, size=(640, 48))
    said = refused(tmp_path / "d", narrow)
    assert "640 x 48" in said and "views.min_side" in said
    assert "Check that it plays" not in said  # it does
    sound = tmp_path / "sound.mp4"
    with av.open(str(sound), "w") as container:
        stream: Any = container.add_stream("aac", rate=44100)
        frame = av.AudioFrame.from_ndarray(
            np.zeros((1, 1024), np.float32), format="fltp", layout="mono"
        )
        frame.sample_rate = 44100
        container.mux(stream.encode(frame))
        container.mux(stream.encode())
    assert "no video in it" in refused(tmp_path / "e", sound)


def test_a_film_that_breaks_off_gives_what_it_has(tmp_path: Path) -> None:
    whole = film(tmp_path / "x.avi", codec="mpeg4").read_bytes()
    cut = tmp_path / "cut.avi"
    cut.write_bytes(whole[: len(whole) * 2 // 3])
    frames = read_frames(cut, 3)
    found = indices_by_brightness(frames)
    assert len(found) == 3
    assert found[0] == 0
    assert 10 < found[-1] < 29


def test_a_film_whose_index_comes_first_may_break_off(tmp_path: Path) -> None:
    path = film(tmp_path / "x.mp4", coded="keyint=5", bars=8, movflags="faststart")
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) * 2 // 3])
    views, context = run_stage(tmp_path / "out", path)
    assert 15 < len(views) < 28
    assert [view.source_name for view in views.views][:2] == ["x.mp4#0", "x.mp4#1"]
    assert [message.split(":")[0] for message in context.warnings] == [
        "x.mp4 breaks off", "x.mp4 is damaged",
    ]  # fmt: skip


@pytest.mark.parametrize("ending", ["avi", "mkv", "webm", "wmv"])
def test_a_film_without_a_count_of_its_frames_that_breaks_off_is_said_to(
    tmp_path: Path, ending: str
) -> None:
    path = film(tmp_path / f"x.{ending}", codec="libvpx" if ending == "webm" else "mpeg4", bars=8)
    _, context = run_stage(tmp_path / "whole", path)
    assert context.warnings == []
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) * 2 // 3])
    _, context = run_stage(tmp_path / "cut", path)
    said = f"x.{ending} breaks off: its end is missing, 67 % of its bytes are there."
    assert context.warnings.count(said) == 1
