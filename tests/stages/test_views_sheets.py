"""Several photographs in one picture, and borders around one."""

from __future__ import annotations

import io
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import pytest
from PIL import Image, ImageDraw

from pipeline.artifacts.views import HeldOut, Views
from pipeline.errors import RequestError
from pipeline.stage import LocalContext
from stages.views.sheets import photographs_in
from stages.views.stage import ViewsConfig, ViewsStage
from tests.stages.views_pictures import write

Bytes = npt.NDArray[np.uint8]
WHITE, BLACK, BLUE = (255, 255, 255), (0, 0, 0), (20, 60, 128)


def photograph(seed: int, width: int = 200, height: int = 150) -> Bytes:
    """Pale blobs of several sizes, brighter or darker by their seed."""
    random = np.random.default_rng(seed)
    total = np.zeros((height, width, 3))
    for size in (4, 9, 20):
        small = random.integers(0, 255, (size, size, 3), np.uint8)
        blobs = Image.fromarray(small).resize((width, height), Image.Resampling.BICUBIC)
        total += np.asarray(blobs, float)
    pale = 0.8 * total.mean(-1, keepdims=True) + 0.2 * total
    level = 90 + 40 * (seed % 3)
    return np.asarray(np.clip(level + 2 * (pale / 3 - 127), 30, 225), np.uint8)


def sheet(places: list[tuple[int, int]], size: tuple[int, int], colour: tuple[int, ...]) -> Bytes:
    """Photographs at (left, top) on a sheet of a size (width, height)."""
    pixels = np.full((size[1], size[0], 3), colour, np.uint8)
    for seed, (left, top) in enumerate(places):
        pixels[top : top + 150, left : left + 200] = photograph(seed)
    return pixels


def as_jpeg(pixels: Bytes, quality: int) -> Bytes:
    packed = io.BytesIO()
    Image.fromarray(pixels).save(packed, "JPEG", quality=quality)
    return np.asarray(Image.open(packed).convert("RGB"))


@pytest.mark.parametrize("colour", [WHITE, BLACK, BLUE])
@pytest.mark.parametrize("gap", [5, 20])
@pytest.mark.parametrize("quality", [95, 75])
def test_rows_columns_and_pyramids_are_cut(
    colour: tuple[int, int, int], gap: int, quality: int
) -> None:
    across, down = 200 + gap, 150 + gap
    row = [(gap, gap), (gap + across, gap), (gap + 2 * across, gap)]
    column = [(left, top) for top, left in ((0, 0), (down, 0), (2 * down, 0))]
    pyramid = [(across // 2, 0), (0, down), (across, down)]
    for places, size in (
        (row, (3 * across + gap, down + gap)), (column, (200, 3 * down - gap)),
        (pyramid, (2 * across - gap, 2 * down - gap)),
    ):  # fmt: skip
        found = photographs_in(as_jpeg(sheet(places, size, colour), quality))
        assert len(found) == 3
        for box, (left, top) in zip(found, places, strict=True):
            np.testing.assert_allclose(box, (top, left, top + 150, left + 200), atol=3)


def test_a_slide_with_words_and_a_logo() -> None:
    pixels = sheet([(50, 150), (270, 150), (490, 150)], (740, 420), WHITE)
    slide = Image.fromarray(pixels)
    ImageDraw.Draw(slide).text((60, 40), "Upper arch, second visit", fill=BLACK, font_size=40)
    pixels = np.array(slide)
    pixels[350:390, 680:720] = photograph(9)[:40, :40]
    boxes = [(150, 50, 300, 250), (150, 270, 300, 470), (150, 490, 300, 690)]
    assert photographs_in(pixels) == boxes


def test_photographs_with_shadows() -> None:
    places = [(20, 20), (260, 20), (500, 20)]
    shadows = np.zeros((200, 740), np.float32)
    for left, top in places:
        shadows[top + 6 : top + 156, left + 6 : left + 206] = 0.4
    shaded = 255 * (1 - cv2.GaussianBlur(shadows, (0, 0), 4))
    pixels = np.repeat(shaded.astype(np.uint8)[..., None], 3, 2)
    for seed, (left, top) in enumerate(places):
        pixels[top : top + 150, left : left + 200] = photograph(seed)
    found = photographs_in(as_jpeg(pixels, 85))
    assert len(found) == 3
    for box, (left, top) in zip(found, places, strict=True):
        np.testing.assert_allclose(box, (top, left, top + 150, left + 200), atol=16)


def test_photographs_that_touch_are_cut() -> None:
    pixels = as_jpeg(sheet([(0, 0), (200, 0), (400, 0)], (600, 150), WHITE), 80)
    assert photographs_in(pixels) == [
        (0, 0, 150, 200), (0, 200, 150, 400), (0, 400, 150, 600),
    ]  # fmt: skip
    assert photographs_in(photograph(1)) == [(0, 0, 150, 200)]


def test_a_border_is_cut_off() -> None:
    assert photographs_in(sheet([(30, 12)], (260, 170), BLACK)) == [(12, 30, 162, 230)]
    assert photographs_in(sheet([(0, 40)], (200, 230), WHITE)) == [(40, 0, 190, 200)]


def test_a_sky_above_a_straight_roof_is_no_border() -> None:
    pixels = np.vstack([np.zeros((100, 200, 3), np.uint8), photograph(2)])
    sky = np.linspace(120, 240, 100).astype(np.uint8)
    pixels[:100] = sky[:, None, None]
    assert photographs_in(pixels) == [(0, 0, 250, 200)]
    pixels[:100] = 120
    assert photographs_in(pixels) == [(100, 0, 250, 200)]


def test_things_before_a_plain_wall_are_one_photograph() -> None:
    pixels = np.full((300, 500, 3), WHITE, np.uint8)
    v, u = np.mgrid[:300, :500]
    for centre in (130, 370):
        ball = np.hypot(v - 150, u - centre) < 100
        pixels[ball] = np.resize(photograph(centre, 500, 300), (300, 500, 3))[ball]
    assert photographs_in(pixels) == [(0, 0, 300, 500)]
    assert photographs_in(np.full((90, 120, 3), 7, np.uint8)) == [(0, 0, 90, 120)]


def run_stage(folder: Path, images: Path, **settings: object) -> LocalContext:
    config = ViewsConfig(long_side=100, **settings)
    stage = ViewsStage()
    context = LocalContext(
        config=config, folder=folder, sources=stage.sources(config, {"images": [images]})
    )
    stage.run(context)
    return context


ROW = [(10, 10), (220, 10), (430, 10)]


def test_a_sheet_alone_is_a_case(tmp_path: Path) -> None:
    pixels = sheet(ROW, (640, 170), WHITE)
    write(tmp_path / "in" / "sheet.png", pixels)
    context = run_stage(tmp_path / "out", tmp_path / "in")
    views: Views = context.result("views")
    assert [view.source_name for view in views.views] == [f"sheet.png#{k}" for k in (1, 2, 3)]
    assert not views.ordered
    [warning] = context.warnings
    assert "sheet.png holds 3 photographs" in warning and "views.cut_sheets=false" in warning
    for view, (left, top) in zip(views.views, ROW, strict=True):
        assert view.image.shape == (75, 100, 3)
        assert (view.source_size, view.upright_size) == ((640, 170), (640, 170))
        np.testing.assert_allclose(view.working_place((left, top)), 0, atol=1e-9)
        np.testing.assert_allclose(view.working_place((left + 200, top + 150)), (100, 75))
    with pytest.raises(RequestError, match=r"sheet\.png: one photograph only.*at least two"):
        run_stage(tmp_path / "off", tmp_path / "in", cut_sheets=False, min_side=20)


@pytest.mark.parametrize("orientation", range(1, 9))
def test_a_sheet_lying_on_its_side(tmp_path: Path, orientation: int) -> None:
    """The place of a pixel is that in the upright sheet, and a mask goes with it."""
    from stages.views.orientation import make_stored

    pixels = sheet(ROW, (640, 170), WHITE)
    mask = np.full((170, 640), 255, np.uint8)
    mask[:, 330:] = 0  # the middle of the second photograph
    exif = Image.Exif()
    exif[0x0112] = orientation
    write(tmp_path / "in" / "sheet.png", make_stored(pixels, orientation), exif=exif)
    write(tmp_path / "masks" / "sheet.png", mask)
    mask_only: Views
    with pytest.raises(RequestError, match="masked completely"):
        run_stage(tmp_path / "out", tmp_path / "in", masks=tmp_path / "masks")
    mask[:, 430:] = 255
    write(tmp_path / "masks" / "sheet.png", mask)
    context = run_stage(tmp_path / "again", tmp_path / "in", masks=tmp_path / "masks")
    mask_only = context.result("views")
    by_left = sorted(mask_only.views, key=lambda view: -view.working_place((0, 0))[0])
    for view, (left, top) in zip(reversed(by_left), reversed(ROW), strict=True):
        assert view.upright_size == (640, 170)
        np.testing.assert_allclose(view.working_place((left, top)), 0, atol=1e-9)
    middle = by_left[1]
    assert by_left[0].mask is None and by_left[2].mask is None
    assert middle.mask is not None
    assert middle.mask[:, :54].all() and not middle.mask[:, 56:].any()


def test_a_photograph_of_a_sheet_may_be_held_out(tmp_path: Path) -> None:
    write(tmp_path / "in" / "sheet.png", sheet(ROW, (640, 170), WHITE))
    write(tmp_path / "in" / "single.png", photograph(7))
    context = run_stage(tmp_path / "out", tmp_path / "in", held_out=("sheet.png#2",))
    views: Views = context.result("views")
    held: HeldOut = context.result("held_out")
    names = [view.source_name for view in views.views]
    assert names == ["sheet.png#1", "sheet.png#3", "single.png"]
    assert [view.source_name for view in held.views] == ["sheet.png#2"]
    with pytest.raises(RequestError, match=r"'sheet\.png#7' names none"):
        run_stage(tmp_path / "none", tmp_path / "in", held_out=("sheet.png#7",))


def test_a_banner_is_left_out(tmp_path: Path) -> None:
    pixels = sheet([(10, 100), (220, 100), (430, 100)], (640, 270), WHITE)
    pixels[10:80, 10:630] = cv2.resize(photograph(5), (620, 70))
    write(tmp_path / "in" / "sheet.png", pixels)
    views: Views = run_stage(tmp_path / "out", tmp_path / "in", min_side=40).result("views")
    assert [view.image.shape[:2] for view in views.views] == [(75, 100)] * 3


def test_six_photographs_of_a_sheet_are_no_film(tmp_path: Path) -> None:
    places = [(left, top) for top in (0, 160) for left in (0, 210, 420)]
    write(tmp_path / "in" / "sheet.png", sheet(places, (620, 310), BLACK))
    views: Views = run_stage(tmp_path / "out", tmp_path / "in").result("views")
    assert len(views) == 6
    assert not views.ordered
