"""Every format and orientation is read as what it shows."""

from __future__ import annotations

import io
import struct
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pillow_heif
import pytest
from PIL import Image, ImageCms, ImageOps

from pipeline.untrusted.files import UnusableFile
from stages.views.orientation import make_stored, make_upright, upright_from_stored
from stages.views.reading.decode import Photo, decode_photo
from stages.views.working import prepare
from tests.stages.views_pictures import ORIENTATION, Bytes, encode, scene

pillow_heif.register_heif_opener()


def mean_difference(photo: Photo, truth: Bytes) -> float:
    assert photo.rgb.shape == truth.shape
    return float(np.abs(photo.rgb.astype(float) - truth).mean())


@pytest.mark.parametrize(
    ("kind", "options", "tolerance"),
    [
        ("PNG", {}, 0.0),
        ("TIFF", {}, 0.0),
        ("TIFF", {"compression": "tiff_lzw"}, 0.0),
        ("BMP", {}, 0.0),
        ("WEBP", {"lossless": True}, 0.0),
        ("WEBP", {"quality": 95}, 3.0),
        ("JPEG", {"quality": 95}, 2.0),
        ("JPEG", {"quality": 95, "progressive": True}, 2.0),
        ("HEIF", {"quality": 95}, 3.0),
    ],
)
def test_formats(kind: str, options: dict[str, Any], tolerance: float) -> None:
    photo = decode_photo(encode(Image.fromarray(scene()), kind, **options))
    assert mean_difference(photo, scene()) <= tolerance
    assert photo.valid is None
    assert photo.orientation == 1
    assert photo.focal_px is None


def test_gray_one_bit_and_palette() -> None:
    gray = scene()[..., 0]
    photo = decode_photo(encode(Image.fromarray(gray), "PNG"))
    np.testing.assert_array_equal(photo.rgb, np.repeat(gray[..., None], 3, -1))
    bits = gray > 128
    photo = decode_photo(encode(Image.fromarray(bits), "PNG"))
    np.testing.assert_array_equal(photo.rgb[..., 1], bits * 255)
    blocks = np.kron(np.array([[0, 1], [2, 3]]), np.ones((40, 60), int))
    colours = np.array([[250, 0, 0], [0, 240, 0], [0, 0, 230], [220, 210, 0]], np.uint8)
    indexed = Image.fromarray(colours[blocks]).convert(
        "P", palette=Image.Palette.ADAPTIVE, colors=4
    )
    assert indexed.mode == "P"
    photo = decode_photo(encode(indexed, "PNG"))
    assert photo.valid is None
    assert mean_difference(photo, colours[blocks]) < 2


@pytest.mark.parametrize("suffix", [".png", ".tiff"])
@pytest.mark.parametrize("channels", [1, 3, 4])
def test_sixteen_bits_are_scaled_linearly(suffix: str, channels: int) -> None:
    ramp = np.linspace(0, 65535, 100 * 80).reshape(80, 100)
    deep = np.stack([ramp, ramp[::-1], ramp[:, ::-1]], -1).astype(np.uint16)
    pixels = deep[..., 0] if channels == 1 else deep
    if channels == 4:
        opaque = np.zeros((80, 100, 1), np.uint16)
        opaque[:, 30:] = 65535
        pixels = np.concatenate([deep, opaque], -1)
    order = [2, 1, 0, 3][: max(channels, 3)] if channels > 1 else slice(None)
    ok, data = cv2.imencode(suffix, pixels[..., order] if channels > 1 else pixels)
    assert ok
    photo = decode_photo(data.tobytes())
    expected = np.rint(deep / 257.0)
    if channels == 1:
        expected = np.repeat(expected[..., :1], 3, -1)
    assert np.abs(photo.rgb - expected).max() <= 1
    if channels == 4:
        assert photo.valid is not None
        np.testing.assert_array_equal(photo.valid, np.arange(100)[None].repeat(80, 0) >= 30)
    else:
        assert photo.valid is None


@pytest.mark.parametrize(("tag", "value", "says"), [(284, 2, "one channel"), (262, 0, "negative")])
def test_sixteen_bits_that_no_decoder_reads_right_are_refused(
    tag: int, value: int, says: str
) -> None:
    ok, written = cv2.imencode(".tiff", np.zeros((80, 100, 3), np.uint16))
    assert ok
    data = bytearray(written.tobytes())
    assert decode_photo(bytes(data)).rgb.shape == (80, 100, 3)
    (start,) = struct.unpack_from("<I", data, 4)
    (count,) = struct.unpack_from("<H", data, start)
    places = [start + 2 + 12 * number for number in range(count)]
    tags = {struct.unpack_from("<H", data, place)[0]: place for place in places}
    struct.pack_into("<H", data, tags[tag] + 8, value)
    with pytest.raises(UnusableFile, match=says):
        decode_photo(bytes(data))


def test_cmyk_without_and_with_an_unfitting_profile() -> None:
    cmyk = Image.fromarray(scene()).convert("CMYK")
    plain = decode_photo(encode(cmyk, "JPEG", quality=95))
    assert mean_difference(plain, scene()) < 3
    rgb_profile = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    odd = decode_photo(encode(cmyk, "JPEG", quality=95, icc_profile=rgb_profile))
    assert mean_difference(odd, scene()) < 3
    tiff = decode_photo(encode(cmyk, "TIFF"))
    assert mean_difference(tiff, scene()) < 1


def gray_press_profile() -> bytes:
    """A CMYK profile of a press whose every ink prints gray: one ink halves the lightness."""

    def tagged(kind: bytes, body: bytes) -> bytes:
        return kind + bytes(4) + body + bytes(-len(body) % 4)

    def fixed(*values: float) -> bytes:
        return b"".join(round(v * 65536).to_bytes(4, "big", signed=True) for v in values)

    ramp = bytes(range(256))
    inks = [[(n >> bit) & 1 for bit in (3, 2, 1, 0)] for n in range(16)]
    table = b"".join(bytes([round(255 * 0.5 ** sum(ink)), 128, 128]) for ink in inks)
    lut = bytes([4, 3, 2, 0]) + fixed(1, 0, 0, 0, 1, 0, 0, 0, 1) + ramp * 4 + table + ramp * 3
    name = b"Gray press\0"
    tags = {
        b"desc": tagged(b"desc", len(name).to_bytes(4, "big") + name + bytes(78)),
        b"cprt": tagged(b"text", b"None\0"),
        b"wtpt": tagged(b"XYZ ", fixed(0.9642, 1.0, 0.8249)),
        b"A2B0": tagged(b"mft1", lut),
    }
    start = 128 + 4 + 12 * len(tags)
    index, bodies = len(tags).to_bytes(4, "big"), b""
    for tag, body in tags.items():
        index += tag + (start + len(bodies)).to_bytes(4, "big") + len(body).to_bytes(4, "big")
        bodies += body
    header = bytearray(128)
    header[0:4] = (start + len(bodies)).to_bytes(4, "big")
    header[8:12] = bytes([2, 0x10, 0, 0])
    header[12:24] = b"prtrCMYKLab "
    header[36:40] = b"acsp"
    header[68:80] = fixed(0.9642, 1.0, 0.8249)
    return bytes(header) + index + bodies


@pytest.mark.parametrize("kind", ["JPEG", "TIFF"])
def test_cmyk_by_its_profile(kind: str) -> None:
    pixels = np.zeros((70, 80, 4), np.uint8)
    pixels[:, 40:, 1] = 255  # magenta, which this press prints as mid gray
    data = encode(Image.fromarray(pixels, "CMYK"), kind, icc_profile=gray_press_profile())
    rgb = decode_photo(data).rgb
    np.testing.assert_allclose(rgb[35, 20], 255, atol=3)
    np.testing.assert_allclose(rgb[35, 60], 119, atol=4)  # L* 50


def wide_gamut_profile() -> bytes:
    """An RGB profile like Display P3: sRGB's with the red primary's column changed."""
    data = bytearray(ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes())
    count = int.from_bytes(data[128:132], "big")
    tags = {bytes(data[132 + 12 * n : 136 + 12 * n]): 136 + 12 * n for n in range(count)}
    # CIE XYZ (D50) of P3's primaries, as 15.16 fixed point.
    for tag, xyz in {
        b"rXYZ": (0.5151, 0.2412, -0.0011),
        b"gXYZ": (0.2920, 0.6922, 0.0419),
        b"bXYZ": (0.1571, 0.0666, 0.7841),
    }.items():
        start = int.from_bytes(data[tags[tag] : tags[tag] + 4], "big") + 8
        for axis, value in enumerate(xyz):
            place = start + 4 * axis
            data[place : place + 4] = round(value * 65536).to_bytes(4, "big", signed=True)
    description = int.from_bytes(data[tags[b"desc"] : tags[b"desc"] + 4], "big")
    size = int.from_bytes(data[tags[b"desc"] + 4 : tags[b"desc"] + 8], "big")
    text = bytes(data[description : description + size]).replace(
        "sRGB".encode("utf-16-be"), "Wide".encode("utf-16-be")
    )
    data[description : description + size] = text
    return bytes(data)


def test_wide_gamut_becomes_srgb() -> None:
    pixels = np.full((70, 70, 3), (200, 100, 100), np.uint8)
    photo = decode_photo(encode(Image.fromarray(pixels), "PNG", icc_profile=wide_gamut_profile()))
    # (200, 100, 100) of Display P3 is about (213, 95, 98) of sRGB.
    np.testing.assert_allclose(photo.rgb[35, 35], (213, 95, 98), atol=4)


def test_an_srgb_or_damaged_profile_changes_nothing() -> None:
    srgb = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    for profile in (srgb, srgb[:60], b"nonsense"):
        data = encode(Image.fromarray(scene()), "PNG", icc_profile=profile)
        np.testing.assert_array_equal(decode_photo(data).rgb, scene())


@pytest.mark.parametrize("kind", ["PNG", "WEBP", "TIFF"])
def test_alpha_becomes_a_mask(kind: str) -> None:
    alpha = np.full((80, 120), 255, np.uint8)
    alpha[:, :40] = 127
    image = Image.fromarray(np.dstack([scene(), alpha]))
    photo = decode_photo(encode(image, kind, **({"lossless": True} if kind == "WEBP" else {})))
    assert photo.valid is not None
    np.testing.assert_array_equal(photo.valid, alpha >= 128)
    assert np.abs(photo.rgb[:, 41:].astype(float) - scene()[:, 41:]).max() == 0


def test_gray_with_alpha_and_transparent_palette_colour() -> None:
    alpha = np.zeros((80, 120), np.uint8)
    alpha[10:] = 255
    photo = decode_photo(encode(Image.fromarray(np.dstack([scene()[..., 0], alpha])), "PNG"))
    assert photo.valid is not None
    np.testing.assert_array_equal(photo.valid, alpha > 0)
    image = Image.fromarray(np.kron(np.array([[0, 1]], np.uint8), np.ones((70, 70), np.uint8)), "L")
    indexed = image.convert("P")
    photo = decode_photo(encode(indexed, "PNG", transparency=0))
    assert photo.valid is not None
    assert 0 < photo.valid.mean() < 1


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("kind", ["PNG", "JPEG", "TIFF", "WEBP"])
def test_orientation(orientation: int, kind: str) -> None:
    truth = scene()
    exif = Image.Exif()
    exif[ORIENTATION] = orientation
    stored = make_stored(truth, orientation)
    data = encode(Image.fromarray(stored), kind, exif=exif, quality=98)
    photo = decode_photo(data)
    assert photo.orientation == orientation
    assert photo.rgb.shape == stored.shape
    prepared = prepare(photo.rgb, None, photo.orientation, None, 60)
    assert prepared.rgb.shape == (40, 60, 3)
    assert prepared.source_size == stored.shape[1::-1]
    expected = cv2.resize(truth, (60, 40), interpolation=cv2.INTER_AREA)
    assert np.abs(prepared.rgb.astype(float) - expected).mean() < 3
    # The map leads from each stored pixel to where its colour is now.
    v, u = np.mgrid[6 : stored.shape[0] - 6 : 7, 6 : stored.shape[1] - 6 : 7]
    x, y, _ = prepared.working_from_source @ np.stack(
        [u.ravel() + 0.5, v.ravel() + 0.5, np.ones(u.size)]
    )
    there = cv2.remap(
        prepared.rgb,
        (x - 0.5).astype(np.float32),
        (y - 0.5).astype(np.float32),
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    ).reshape(-1, 3)
    assert np.abs(there.astype(float) - stored[v.ravel(), u.ravel()]).mean() < 4


@pytest.mark.parametrize("orientation", range(1, 9))
def test_orientation_against_pillow_and_its_map(orientation: int) -> None:
    stored = np.random.default_rng(0).integers(0, 255, (5, 7, 3), np.uint8)
    exif = Image.Exif()
    exif[ORIENTATION] = orientation
    image = Image.open(io.BytesIO(encode(Image.fromarray(stored), "PNG", exif=exif)))
    upright = make_upright(stored, orientation)
    np.testing.assert_array_equal(upright, np.asarray(ImageOps.exif_transpose(image)))
    np.testing.assert_array_equal(make_stored(upright, orientation), stored)
    matrix = upright_from_stored(orientation, 7, 5)
    for v in range(5):
        for u in range(7):
            x, y, _ = matrix @ (u + 0.5, v + 0.5, 1)
            np.testing.assert_array_equal(upright[int(y), int(x)], stored[v, u])


@pytest.mark.parametrize("orientation", range(1, 9))
def test_sixteen_bit_tiff_with_orientation_stays_on_its_stored_grid(orientation: int) -> None:
    exif = Image.Exif()
    exif[ORIENTATION] = orientation
    data = encode(Image.fromarray(scene()[..., 0].astype(np.uint16) * 257), "TIFF", exif=exif)
    photo = decode_photo(data)
    assert photo.orientation == orientation
    np.testing.assert_array_equal(photo.rgb[..., 0], scene()[..., 0])


def test_heic_is_upright_once() -> None:
    exif = Image.Exif()
    exif[ORIENTATION] = 6
    stored = make_stored(scene(), 6)
    photo = decode_photo(encode(Image.fromarray(stored), "HEIF", quality=95, exif=exif.tobytes()))
    upright = make_upright(photo.rgb, photo.orientation)
    assert upright.shape == scene().shape
    assert np.abs(upright.astype(float) - scene()).mean() < 3


def damaged(kind: str, keep: float, **options: Any) -> bytes:
    noise = np.random.default_rng(0).integers(0, 255, (80, 120, 3), np.uint8)
    data = encode(Image.fromarray(noise), kind, **options)
    return data[: int(len(data) * keep)]


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (b"", "empty"),
        (b"Dear doctor,\nplease find enclosed\n", "text file"),
        (bytes(range(256)) * 20, "not a readable"),
        (damaged("JPEG", 0.6), "truncated"),
        (damaged("PNG", 0.6), "truncated|damaged"),
        (damaged("TIFF", 0.6), "truncated|damaged"),
        (damaged("WEBP", 0.6), "truncated|damaged|not a readable"),
        (damaged("HEIF", 0.6), "truncated|damaged|not a readable"),
        (damaged("BMP", 0.6), "truncated|damaged"),
    ],
)
def test_damaged_files_say_what_is_wrong(data: bytes, reason: str) -> None:
    with pytest.raises(UnusableFile, match=reason):
        decode_photo(data)


def test_damaged_sixteen_bit_png_is_not_half_decoded() -> None:
    noise = np.random.default_rng(0).integers(0, 65535, (80, 120, 3), np.uint16)
    data = cv2.imencode(".png", noise)[1].tobytes()
    with pytest.raises(UnusableFile, match=r"truncated|damaged"):
        decode_photo(data[: len(data) // 2])


def test_floating_point_images_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "float.tiff"
    Image.fromarray(np.zeros((80, 80), np.float32)).save(path)
    with pytest.raises(UnusableFile, match="floating point"):
        decode_photo(path.read_bytes())
