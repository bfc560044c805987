"""Photographs in DICOM: what is decoded, what is refused and how, and that nothing else is read."""

from __future__ import annotations

import zlib
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from PIL import Image, ImageCms

import pipeline
from pipeline.artifacts.views import Views
from pipeline.errors import RequestError
from pipeline.untrusted.child import Child
from pipeline.untrusted.files import UnusableFile
from stages.views.find import find_images
from stages.views.load import load_photos
from stages.views.reading.apart import Decoder
from tests.personal_data import DATE, PERSONAL

pydicom = pytest.importorskip("pydicom")
reading: Any = pytest.importorskip("stages.views.reading.dicom")
files: Any = pytest.importorskip("tests.dicom_files")
decode_dicom = reading.decode_dicom
as_bytes, compressed = files.as_bytes, files.compressed
dicom_photograph, write_all = files.dicom_photograph, files.write_all

H, W = 70, 97


def picture(seed: int = 0) -> npt.NDArray[np.uint8]:
    """[H, W, 3] smooth colours, each channel of its own."""
    v, u = np.mgrid[:H, :W]
    waves = [np.sin((u * (1 + c) + seed * 9) / 17) * np.cos(v / (9 + c)) for c in range(3)]
    return (127.5 + 120 * np.stack(waves, -1)).astype(np.uint8)


RGB = picture()
GRAY = RGB[..., 1].copy()


def decoded(dataset: Any) -> npt.NDArray[np.uint8]:
    return decode_dicom(as_bytes(dataset)).rgb


def test_uncompressed_colours() -> None:
    np.testing.assert_array_equal(decoded(dicom_photograph(RGB)), RGB)
    planes = np.ascontiguousarray(np.moveaxis(RGB, -1, 0))
    data = planes.tobytes() + b"\0" * (planes.size % 2)
    apart = dicom_photograph(RGB, PlanarConfiguration=1, PixelData=data)
    np.testing.assert_array_equal(decoded(apart), RGB)


def test_luminance_and_colour_differences() -> None:
    ycc = np.asarray(Image.fromarray(RGB).convert("YCbCr"))
    full = dicom_photograph(np.ascontiguousarray(ycc), PhotometricInterpretation="YBR_FULL")
    assert np.abs(decoded(full).astype(int) - RGB).max() <= 3
    even = ycc[:, :96]
    halved = np.stack(
        [even[:, ::2, 0], even[:, 1::2, 0], even[:, ::2, 1], even[:, ::2, 2]], -1
    )  # fmt: skip
    half = dicom_photograph(
        np.ascontiguousarray(even), PhotometricInterpretation="YBR_FULL_422",
        PixelData=halved.tobytes(),
    )  # fmt: skip
    assert np.abs(decoded(half).astype(int) - RGB[:, :96]).mean() < 4


def test_grey() -> None:
    np.testing.assert_array_equal(decoded(dicom_photograph(GRAY))[..., 2], GRAY)
    turned = dicom_photograph(GRAY, PhotometricInterpretation="MONOCHROME1")
    np.testing.assert_array_equal(decoded(turned)[..., 0], 255 - GRAY)
    twelve = dicom_photograph(GRAY.astype(np.uint16) << 4, BitsStored=12, HighBit=11)
    assert np.abs(decoded(twelve)[..., 0].astype(int) - GRAY).max() <= 1


def test_a_palette() -> None:
    descriptor, table = [256, 0, 16], np.arange(256, dtype="<u2") * 257
    parts: dict[str, Any] = {}
    for place, name in enumerate(("Red", "Green", "Blue")):
        parts[f"{name}PaletteColorLookupTableDescriptor"] = descriptor
        turned = table if place != 1 else table[::-1]
        parts[f"{name}PaletteColorLookupTableData"] = turned.tobytes()
    found = decoded(dicom_photograph(GRAY, PhotometricInterpretation="PALETTE COLOR", **parts))
    np.testing.assert_array_equal(found[..., 0], GRAY)
    np.testing.assert_array_equal(found[..., 1], 255 - GRAY)


@pytest.mark.parametrize("bits", [8, 16])
def test_a_palette_of_8_bits_in_words(bits: int) -> None:
    """Whatever its descriptor says: some write 16 and mean 8."""
    parts: dict[str, Any] = {}
    for place, name in enumerate(("Red", "Green", "Blue")):
        parts[f"{name}PaletteColorLookupTableDescriptor"] = [256, 0, bits]
        table = np.arange(256, dtype="<u2") // (place + 1)
        parts[f"{name}PaletteColorLookupTableData"] = table.tobytes()
    found = decoded(dicom_photograph(GRAY, PhotometricInterpretation="PALETTE COLOR", **parts))
    np.testing.assert_array_equal(found, np.stack([GRAY, GRAY // 2, GRAY // 3], -1))


@pytest.mark.parametrize(
    ("said", "shape"),
    [
        ({"PixelAspectRatio": [2, 1]}, (140, 97)),
        ({"PixelAspectRatio": [5, 6], "PixelSpacing": [1, 1]}, (70, 116)),
        ({"PixelSpacing": [".1", ".1001"]}, (70, 97)),
        ({"NominalScannedPixelSpacing": [".2", ".1"]}, (140, 97)),
        ({"PixelAspectRatio": [0, 0], "ImagerPixelSpacing": [".3", ".1"]}, (210, 97)),
        ({"PixelAspectRatio": [5, 1]}, (70, 97)),
        ({"PixelSpacing": ["-1", "1"]}, (70, 97)),
        ({"PixelSpacing": "1"}, (70, 97)),
        ({"PixelSpacing": None}, (70, 97)),
    ],
)
def test_pixels_that_are_not_square(said: dict[str, Any], shape: tuple[int, int]) -> None:
    """The picture comes out as it was taken; elements that are damaged cost nothing."""
    found = decode_dicom(as_bytes(dicom_photograph(RGB, FocalLengthIn35mmFilm=100, **said)))
    assert found.rgb.shape == (*shape, 3)
    assert found.focal_px == pytest.approx(100 / np.hypot(36, 24) * np.hypot(*shape))
    back = Image.fromarray(found.rgb).resize((W, H), Image.Resampling.BOX)
    assert np.abs(np.asarray(back).astype(int) - RGB).mean() < 2


@pytest.mark.parametrize(("kind", "error"), [("JPEG", 4.0), ("JPEG2000", 0.0)])
def test_compressed(kind: str, error: float) -> None:
    assert np.abs(decoded(compressed(RGB, kind)).astype(int) - RGB).mean() <= error


def test_run_lengths() -> None:
    found = dicom_photograph(RGB)
    found.compress(pydicom.uid.RLELossless)
    np.testing.assert_array_equal(decoded(found), RGB)


def test_lossless_jpeg() -> None:
    """pydicom's own sample: nine bars of known colours, compressed by two programs' codecs."""
    folder = Path(pydicom.__file__).parent / "data" / "test_files"
    lossless, plain = (folder / name for name in ("SC_rgb_jpeg_gdcm.dcm", "SC_rgb_rle.dcm"))
    if not lossless.is_file() or not plain.is_file():
        pytest.skip("pydicom came without its samples")
    found = decode_dicom(lossless.read_bytes()).rgb
    np.testing.assert_array_equal(found, decode_dicom(plain.read_bytes()).rgb)
    assert found[5, 5].tolist() == [255, 0, 0]


def test_a_profile_of_colours_is_applied() -> None:
    lab = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    same = dicom_photograph(RGB, ICCProfile=lab)
    np.testing.assert_array_equal(decoded(same), RGB)
    np.testing.assert_array_equal(decoded(dicom_photograph(RGB, ICCProfile=b"nonsense")), RGB)


def test_the_focal_length_where_it_is_said() -> None:
    said = decode_dicom(as_bytes(dicom_photograph(RGB, FocalLengthIn35mmFilm=100)))
    assert said.focal_px == pytest.approx(100 / np.hypot(36, 24) * np.hypot(H, W))
    assert decode_dicom(as_bytes(dicom_photograph(RGB))).focal_px is None


def test_when_it_was_taken_where_that_is_said() -> None:
    first, second, nonsense = (
        decode_dicom(as_bytes(dicom_photograph(RGB, AcquisitionDateTime=text))).taken_at
        for text in ("20261127140559.123+0100", "20261127140701", "2026")
    )
    assert first is not None and second is not None
    assert second - first == 62 and nonsense is None


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"SOPClassUID": "1.2.840.10008.5.1.4.1.1.2"}, "another kind (CT Image Storage)"),
        ({"SOPClassUID": "1.2.3.4.5"}, "another kind (unknown)"),
        ({"NumberOfFrames": 12}, "12 pictures, and only files of one"),
        ({"PhotometricInterpretation": "HSV"}, "not those of a photograph (HSV"),
        ({"PixelRepresentation": 1}, "not those of a photograph"),
        ({"Rows": 0}, "0 pixels"),
        ({"Rows": 60_000, "Columns": 60_000}, "megapixels"),
        ({"Rows": 7000, "Columns": 7000}, "is a DICOM file that is damaged"),
        ({"PixelData": b"\0\1"}, "is a DICOM file that is damaged"),
    ],
)
def test_what_is_no_photograph_is_refused(changes: dict[str, Any], said: str) -> None:
    with pytest.raises(UnusableFile) as refused:
        decoded(dicom_photograph(RGB, **changes))
    assert said in str(refused.value)
    assert "Prognath" not in str(refused.value)


def test_other_compressions_are_named() -> None:
    found = compressed(RGB, "JPEG")
    found.file_meta.TransferSyntaxUID = pydicom.uid.HTJ2KLossless
    with pytest.raises(UnusableFile, match=r"not decoded here .High-Throughput JPEG 2000"):
        decoded(found)


def test_files_without_pixels() -> None:
    found = dicom_photograph(RGB)
    del found.PixelData
    with pytest.raises(UnusableFile, match="without pixels"):
        decoded(found)


def test_cut_and_changed_files_are_refused_or_read() -> None:
    """Whatever stands in a file, it is a picture or one paragraph, without a word of the file."""
    whole = as_bytes(dicom_photograph(RGB))
    random = np.random.default_rng(5)
    refused = 0
    for place in [*range(132, 900, 37), len(whole) // 2]:
        damaged = bytearray(whole[:place] if place % 2 else whole)
        at = int(random.integers(132, min(len(damaged), 900)))
        damaged[at] ^= int(random.integers(1, 256))
        try:
            assert decode_dicom(bytes(damaged)).rgb.ndim == 3
        except UnusableFile as error:
            refused += 1
            assert "Prognath" not in str(error)
    assert refused > 10


def test_what_unpacks_without_end_is_stopped() -> None:
    """A deflated file that is a thousand times larger than it looks: memory is limited."""
    found = dicom_photograph(RGB)
    head = as_bytes(found)
    bomb = zlib.compressobj(1, zlib.DEFLATED, -15)
    packed = b"".join(bomb.compress(bytes(1 << 24)) for _ in range(40)) + bomb.flush()
    meta = head[: head.index(b"1.2.840.10008.1.2.1\0")]
    body = meta + b"1.2.840.10008.1.2.1.99"
    # the length of the transfer syntax's value, and of the group, grow by two
    at = body.rindex(b"UI", 0, len(body) - 22) + 2
    body = body[:at] + (22).to_bytes(2, "little") + body[at + 2 :]
    group = int.from_bytes(body[140:144], "little") + 2
    rest = head[len(meta) + 20 : 144 + group - 2]
    body = body[:140] + group.to_bytes(4, "little") + body[144:] + rest
    work = "stages.views.reading.dicom_child:work"
    with Child(work, 1 << 28) as child, pytest.raises(UnusableFile, match="memory"):
        list(child.ask({}, [np.frombuffer(body + packed, np.uint8)]))


def test_a_folder_of_an_archive(tmp_path: Path) -> None:
    """Files without suffix, a DICOMDIR and a text beside them; the mark says what they are."""
    names = ("IM_0001", "IM_0002", "1.2.840.113619.2.5", "left.dcm")
    folder = write_all(tmp_path / "study", {n: picture(k) for k, n in enumerate(names)})
    (folder / "DICOMDIR").write_bytes(bytes(128) + b"DICM")
    (folder / "LICENCE").write_text("no photograph")
    found = find_images([folder])
    assert sorted(found) == sorted(names)
    loaded = load_photos(found, {}, 96, 16, threads=2)
    assert len(loaded) == 4 and all(item.picture.rgb.shape == (69, 96, 3) for item in loaded)
    by_name = {item.source_name: item.picture.rgb.astype(int) for item in loaded}
    middle = by_name["IM_0001"][20:50, 20:70] - np.asarray(
        Image.fromarray(RGB).resize((96, 69), Image.Resampling.LANCZOS)
    )[20:50, 20:70].astype(int)
    assert np.abs(middle).mean() < 6


def test_views_of_dicom_say_nothing_of_the_patient(tmp_path: Path) -> None:
    folder = write_all(tmp_path / "in", {f"{k}.dcm": picture(k) for k in range(3)})
    summary = pipeline.run(
        folder, workspace=tmp_path / "w", stages=["views"],
        overrides={"views.min_side": 16, "views.long_side": 96},
    )  # fmt: skip
    views = Views.load(summary.stages[0].folder / "views")
    assert [view.source_name for view in views.views] == ["0.dcm", "1.dcm", "2.dcm"]
    written = [path for path in (tmp_path / "w").rglob("*") if path.is_file()]
    secrets = [word.encode() for word in (*PERSONAL, DATE.replace(":", ""))]
    assert len(written) > 4
    assert not [p for p in written if any(word in p.read_bytes() for word in secrets)]


def test_without_the_extra_it_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("stages.views.reading.apart.is_installed", lambda *names: False)
    with Decoder() as decoder, pytest.raises(UnusableFile, match=r"dentalsplat\[dicom\]"):
        decoder.photo(as_bytes(dicom_photograph(RGB)), lambda width, height: None)


def test_a_mask_is_no_dicom_file(tmp_path: Path) -> None:
    folder = write_all(tmp_path / "in", {"a.dcm": RGB, "b.dcm": picture(1)})
    masks = write_all(tmp_path / "masks", {"a.dcm": RGB})
    found = find_images([folder])
    with pytest.raises(RequestError, match="only a photograph may be"):
        load_photos(found, {"a.dcm": masks / "a.dcm"}, 96, 16)
