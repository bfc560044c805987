"""The stage `views` as a whole: files in, artifact out, nothing private in it."""

from __future__ import annotations

import hashlib
import io
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from PIL import Image, TiffImagePlugin
from pillow_heif import register_heif_opener

from pipeline.artifacts.views import Views
from pipeline.errors import RequestError
from pipeline.stage import LocalContext
from stages.views.stage import ViewsConfig, ViewsStage
from tests.stages.views_pictures import write

DATA = Path(__file__).resolve().parents[3] / "shared" / "data"
SAMPLES = Path(__file__).resolve().parents[2] / "data_samples"
Bytes = npt.NDArray[np.uint8]


def picture(seed: int, width: int = 120, height: int = 90) -> Bytes:
    random = np.random.default_rng(seed)
    small = random.integers(0, 255, (9, 12, 3), np.uint8)
    return np.asarray(Image.fromarray(small).resize((width, height), Image.Resampling.BICUBIC))


def run_stage(
    folder: Path, images: list[Any], **settings: Any
) -> tuple[Views, LocalContext, list[tuple[Any, ...]]]:
    config = ViewsConfig(**settings)
    stage = ViewsStage()
    steps: list[tuple[Any, ...]] = []
    context = LocalContext(
        config=config,
        folder=folder,
        sources=stage.sources(config, {"images": images}),
        threads=2,
        on_progress=lambda *step: steps.append(step),
    )
    stage.run(context)
    views: Views = context.result("views")
    return views, context, steps


def test_a_folder(tmp_path: Path) -> None:
    files = [write(tmp_path / "in" / f"p{n}.png", picture(n)) for n in (1, 2, 10)]
    views, context, steps = run_stage(
        tmp_path / "out", [tmp_path / "in"], long_side=64, min_side=40
    )
    assert [view.name for view in views.views] == ["000", "001", "002"]
    assert [view.source_name for view in views.views] == ["p1.png", "p2.png", "p10.png"]
    assert not views.ordered
    assert context.figures == {"views": 3, "width": 64, "height": 48}
    assert context.warnings == []
    assert steps == [("reading", n, 3) for n in (1, 2, 3)]
    view = views.views[0]
    assert view.image.shape == (48, 64, 3)
    assert view.mask is None
    assert view.source_size == (120, 90)
    assert view.source_sha256 == hashlib.sha256(files[0].read_bytes()).hexdigest()
    np.testing.assert_allclose(view.working_from_source, np.diag([64 / 120, 48 / 90, 1]))


def test_sources_are_what_is_used(tmp_path: Path) -> None:
    for n in range(7):
        write(tmp_path / "in" / f"{n}.png", picture(n))
        write(tmp_path / "m" / f"{n}.png", np.full((90, 120), 255, np.uint8))
    stage = ViewsStage()
    config = ViewsConfig(frames=3, masks=tmp_path / "m")
    labels = list(stage.sources(config, {"images": [tmp_path / "in"]}))
    assert labels == ["0.png", "3.png", "6.png", "masks/0.png", "masks/3.png", "masks/6.png"]


def test_the_place_of_the_masks_is_not_part_of_the_key() -> None:
    extra = ViewsConfig.model_fields["masks"].json_schema_extra
    assert extra == {"affects_result": False}


def test_numbered_frames_are_ordered_and_samples_work(tmp_path: Path) -> None:
    views, _, _ = run_stage(tmp_path, [SAMPLES / "twelve_frames"], frames=6, long_side=128)
    assert views.ordered
    assert [view.source_name for view in views.views][:2] == ["000.jpg", "002.jpg"]
    assert views.views[0].image.shape == (96, 128, 3)


def test_mixed_sizes_exif_and_masks(tmp_path: Path) -> None:
    exif = Image.Exif()
    exif[0x0112] = 6
    exif.get_ifd(0x8769)[0xA405] = 50
    write(tmp_path / "in" / "a.jpg", picture(1, 240, 180), exif=exif)
    write(tmp_path / "in" / "b.png", picture(2, 200, 200))
    mask = np.zeros((240, 180), np.uint8)
    mask[120:] = 255
    write(tmp_path / "masks" / "a.png", mask)
    views, _, _ = run_stage(
        tmp_path / "out", [tmp_path / "in"], masks=tmp_path / "masks", long_side=120
    )
    a, b = views.views
    assert (a.width, a.height) == (90, 120)
    assert (b.width, b.height) == (120, 120)
    # 50 mm of a diagonal of 43.27 mm; the diagonal at working size is 150 pixels.
    assert a.focal_px == pytest.approx(50 / 43.2666 * 150, rel=1e-3)
    assert b.focal_px is None
    assert a.mask is not None
    np.testing.assert_array_equal(a.mask, np.arange(120)[:, None].repeat(90, 1) >= 60)
    assert b.mask is None
    # The top left pixel of the stored grid is at the top right of the upright picture.
    np.testing.assert_allclose(a.working_from_source @ (0.5, 0.5, 1), (89.75, 0.25, 1))


def test_times_are_told_from_the_first_photograph_on(tmp_path: Path) -> None:
    """The date itself is private."""
    times = ("2019:07:04 08:16:30", "2019:07:04 08:15:00", "nonsense")
    for n, time in enumerate(times):
        exif = Image.Exif()
        exif.get_ifd(0x8769)[0x9003] = time
        write(tmp_path / "in" / f"{n}.jpg", picture(n), exif=exif)
    views, _, _ = run_stage(tmp_path / "out", [tmp_path / "in"])
    assert [view.taken_after for view in views.views] == [90, 0, None]
    assert b"2019" not in b"".join(artifact_bytes(tmp_path / "out" / "views").values())


def test_times_of_held_out_photographs_begin_with_those_of_the_views(tmp_path: Path) -> None:
    for n, time in enumerate(("08:15:00", "08:16:30", "08:15:40", "08:17:00")):
        exif = Image.Exif()
        exif.get_ifd(0x8769)[0x9003] = f"2019:07:04 {time}"
        write(tmp_path / "in" / f"{n}.jpg", picture(n), exif=exif if n != 1 else Image.Exif())
        write(tmp_path / "none" / f"{n}.jpg", picture(n), exif=exif if n < 1 else Image.Exif())
    views, context, _ = run_stage(tmp_path / "a", [tmp_path / "in"], held_out=["0", "3"])
    assert [view.taken_after for view in views.views] == [None, 0]
    assert [view.taken_after for view in context.result("held_out").views] == [-40, 80]
    views, context, _ = run_stage(tmp_path / "b", [tmp_path / "none"], held_out=["0"])
    assert {view.taken_after for view in views.views} == {None}
    assert [view.taken_after for view in context.result("held_out").views] == [0]


def test_duplicates_are_left_out_with_a_warning(tmp_path: Path) -> None:
    write(tmp_path / "in" / "a.png", picture(1))
    write(tmp_path / "in" / "b.bmp", picture(1))
    write(tmp_path / "in" / "c.png", picture(2))
    views, context, _ = run_stage(tmp_path / "out", [tmp_path / "in"])
    assert [(view.name, view.source_name) for view in views.views] == [
        ("000", "a.png"),
        ("001", "c.png"),
    ]
    assert len(context.warnings) == 1
    assert "b.bmp" in context.warnings[0]
    assert "a.png" in context.warnings[0]
    kept, context, _ = run_stage(tmp_path / "all", [tmp_path / "in"], deduplicate=False)
    assert len(kept) == 3
    assert context.warnings == []


def test_fewer_than_asked_for(tmp_path: Path) -> None:
    for n in range(3):
        write(tmp_path / "in" / f"{n}.png", picture(n))
    views, context, _ = run_stage(tmp_path / "out", [tmp_path / "in"], frames=8)
    assert len(views) == 3
    assert len(context.warnings) == 1
    assert "only 3" in context.warnings[0]


def test_a_blank_picture_is_mentioned(tmp_path: Path) -> None:
    write(tmp_path / "in" / "a.png", picture(1))
    write(tmp_path / "in" / "black.png", np.full((90, 120, 3), 4, np.uint8))
    _, context, _ = run_stage(tmp_path / "out", [tmp_path / "in"])
    assert len(context.warnings) == 1
    assert "black.png" in context.warnings[0]


def test_further_pages_of_a_file_are_mentioned(tmp_path: Path) -> None:
    first, second, third = (Image.fromarray(picture(n)) for n in range(3))
    (tmp_path / "in").mkdir()
    with TiffImagePlugin.AppendingTiffWriter(tmp_path / "in" / "a.tif", new=True) as file:
        for page, kind in ((first, 0), (second, 0), (second.reduce(4), 1), (third, 0)):
            page.save(file, format="TIFF", tiffinfo={254: kind})
            file.newFrame()
    write(tmp_path / "in" / "b.tif", picture(4))
    views, context, _ = run_stage(tmp_path / "out", [tmp_path / "in"])
    assert context.warnings == [
        "a.tif holds 3 pictures, of which the first is used. Save the others as files of their "
        "own, if they are wanted."
    ]
    np.testing.assert_allclose(views.views[0].image * 255, picture(0), atol=0.01)


@pytest.mark.parametrize("ending", ["png", "webp", "heic"])
def test_the_other_pictures_of_an_animation_are_mentioned(tmp_path: Path, ending: str) -> None:
    register_heif_opener()
    (tmp_path / "in").mkdir()
    first, *more = (Image.fromarray(picture(n)) for n in range(3))
    first.save(
        tmp_path / "in" / f"a.{ending}", save_all=True, append_images=more, duration=100,
        **({"lossless": True} if ending == "webp" else {}),
    )  # fmt: skip
    write(tmp_path / "in" / "b.png", picture(4))
    views, context, _ = run_stage(tmp_path / "out", [tmp_path / "in"])
    assert [message.split(". ")[0] for message in context.warnings] == [
        f"a.{ending} holds 3 pictures, of which the first is used"
    ]
    off = np.abs(views.views[0].image * 255 - picture(0)).mean()
    assert off < (8 if ending == "heic" else 0.01)


def test_two_identical_images(tmp_path: Path) -> None:
    for name in ("a.png", "b.png"):
        write(tmp_path / "in" / name, picture(1))
    with pytest.raises(RequestError, match=r"a\.png and b\.png: the same picture.*at least two"):
        run_stage(tmp_path / "out", [tmp_path / "in"])


def test_all_that_is_wrong_is_named_at_once(tmp_path: Path) -> None:
    folder = tmp_path / "in"
    write(folder / "good.png", picture(1))
    whole = io.BytesIO()
    Image.fromarray(picture(2)).save(whole, "JPEG")
    (folder / "cut.jpg").write_bytes(whole.getvalue()[:-400])
    (folder / "note.jpg").write_text("not a picture at all\n")
    (folder / "zero.jpg").write_bytes(b"")
    write(folder / "line.png", np.zeros((10, 20000), np.uint8))
    with pytest.raises(RequestError) as caught:
        run_stage(tmp_path / "out", [folder])
    message = str(caught.value)
    assert message.startswith("4 of 5 photographs can't be used")
    for part in (
        "cut.jpg is truncated",
        "note.jpg is a text file",
        "zero.jpg is empty",
        "line.png is 20000 x 10 pixels",
    ):
        assert part in message
    assert "good.png" not in message
    assert "\n" not in message
    assert not (tmp_path / "out" / "views").exists()


def test_what_is_too_small_is_said_once(tmp_path: Path) -> None:
    for n in range(3):
        write(tmp_path / "in" / f"{n}.png", picture(n, 40, 30))
    write(tmp_path / "in" / "row.png", picture(3, 2000, 100))
    with pytest.raises(RequestError) as caught:
        run_stage(tmp_path / "out", [tmp_path / "in"], long_side=512)
    message = str(caught.value)
    assert "0.png is 40 x 30 pixels; 1.png is 40 x 30 pixels; 2.png is 40 x 30 pixels; " in message
    assert "row.png is 2000 x 100 pixels, at the working size 512 x 26. The short" in message
    assert message.count("views.min_side") == 1


def test_one_bad_file_and_one_bad_mask(tmp_path: Path) -> None:
    write(tmp_path / "in" / "a.png", picture(1))
    (tmp_path / "in" / "b.jpg").write_text("text")
    with pytest.raises(RequestError, match=r"b\.jpg is a text file"):
        run_stage(tmp_path / "out", [tmp_path / "in"])
    write(tmp_path / "in" / "b.jpg", picture(2))
    (tmp_path / "masks").mkdir()
    (tmp_path / "masks" / "b.png").write_bytes(b"")
    with pytest.raises(RequestError, match=r"b\.jpg has a mask \(b\.png\) that is empty") as caught:
        run_stage(tmp_path / "out", [tmp_path / "in"], masks=tmp_path / "masks")
    assert "views.masks" in str(caught.value)  # the photograph is good
    assert "from the camera" not in str(caught.value)


def artifact_bytes(folder: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def test_threads_do_not_change_the_bytes(tmp_path: Path) -> None:
    for n in range(5):
        write(tmp_path / "in" / f"{n}.jpg", picture(n, 300, 200))
    stage, config = ViewsStage(), ViewsConfig(long_side=150)
    written = []
    for threads in (1, 4):
        folder = tmp_path / str(threads)
        sources = stage.sources(config, {"images": [tmp_path / "in"]})
        stage.run(LocalContext(config=config, folder=folder, sources=sources, threads=threads))
        written.append(artifact_bytes(folder / "views"))
    assert written[0] == written[1]
    assert len(written[0]) == 6


def check_private(folder: Path, secrets: list[bytes]) -> None:
    for name, data in artifact_bytes(folder).items():
        assert b"Exif" not in data
        assert b"eXIf" not in data
        assert not any(secret in data for secret in secrets), name
        if name.endswith(".png"):
            with Image.open(io.BytesIO(data)) as image:
                assert not image.getexif()
                assert not image.info


def test_nothing_private_is_carried_on(tmp_path: Path) -> None:
    exif = Image.Exif()
    exif[0x010F] = "SecretMaker"
    exif[0x013B] = "Patient Name"
    exif.get_ifd(0x8825)[2] = (52.0, 31.0, 8.1)
    for n in range(2):
        write(tmp_path / "hidden_folder" / f"{n}.jpg", picture(n), exif=exif, comment=b"Comment")
    run_stage(tmp_path / "out", [tmp_path / "hidden_folder"])
    secrets = [b"SecretMaker", b"Patient", b"Comment", b"hidden_folder", str(tmp_path).encode()]
    check_private(tmp_path / "out" / "views", secrets)


@pytest.mark.real_data
@pytest.mark.skipif(not (DATA / "berlin").exists(), reason="the real photographs are not here")
def test_gps_of_real_photographs_is_not_carried_on(tmp_path: Path) -> None:
    views, _, _ = run_stage(tmp_path, [DATA / "berlin" / "images"])
    assert len(views) == 3
    with Image.open(sorted((DATA / "berlin" / "images").glob("*.jpg"))[0]) as image:
        assert image.getexif().get_ifd(0x8825)  # it is there to begin with
    check_private(
        tmp_path / "views",
        [b"MAPLatitude", b"52.51", b"13.40", b"Apple", b"iPhone", b"yubin", str(DATA).encode()],
    )
    # A phone's 35 mm lens: between .75 and 1.05 of the long side.
    for view in views.views:
        assert view.focal_px is not None
        assert 0.75 < view.focal_px / max(view.width, view.height) < 1.05
    assert "berlin" not in json.dumps([view.source_name for view in views.views])


def test_naming_the_stage_loads_no_heavy_library() -> None:
    code = "import sys, stages.views.stage; print(sorted({'cv2', 'PIL', 'av'} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_held_out_photographs_leave_the_views_as_they_were(tmp_path: Path) -> None:
    """The views are, byte for byte, what they are where the held-out files are not there at all."""
    for n in range(6):
        write(tmp_path / "all" / f"p{n}.png", picture(n))
        if n not in (1, 4):
            write(tmp_path / "few" / f"p{n}.png", picture(n))
    held = ["p4", "p1.png"]
    views, context, _ = run_stage(tmp_path / "a", [tmp_path / "all"], held_out=held)
    run_stage(tmp_path / "b", [tmp_path / "few"])
    assert artifact_bytes(tmp_path / "a" / "views") == artifact_bytes(tmp_path / "b" / "views")
    assert not (tmp_path / "b" / "held_out").exists()
    out = context.result("held_out")
    assert [(v.name, v.source_name) for v in out.views] == [("h000", "p1.png"), ("h001", "p4.png")]
    everything, _, _ = run_stage(tmp_path / "c", [tmp_path / "all"])
    np.testing.assert_array_equal(out.views[1].image, everything.views[4].image)
    assert context.figures["held_out"] == 2
    assert len(views) == 4


def test_frames_are_chosen_among_those_that_are_not_held_out(tmp_path: Path) -> None:
    for n in range(9):
        write(tmp_path / "in" / f"{n}.png", picture(n))
    config = ViewsConfig(frames=3, held_out=("3", "5"))
    labels = list(ViewsStage().sources(config, {"images": [tmp_path / "in"]}))
    assert labels == ["0.png", "3.png", "4.png", "5.png", "8.png"]


def test_a_photograph_like_a_held_out_one_stays(tmp_path: Path) -> None:
    for n in (0, 1, 2):
        write(tmp_path / "in" / f"{n}.png", picture(n))
    write(tmp_path / "in" / "copy.png", picture(2))
    views, context, _ = run_stage(tmp_path / "out", [tmp_path / "in"], held_out=["0", "copy"])
    assert [view.source_name for view in views.views] == ["1.png", "2.png"]
    assert [view.source_name for view in context.result("held_out").views] == ["0.png"]
    assert "copy.png is the same picture as 2.png" in context.warnings[0]


def test_wrong_names_of_held_out_photographs(tmp_path: Path) -> None:
    for n in (0, 1, 2):
        write(tmp_path / "in" / f"p{n}.png", picture(n))
    with pytest.raises(RequestError, match=r"'p3' names none of them"):
        run_stage(tmp_path / "out", [tmp_path / "in"], held_out=["p3"])
    with pytest.raises(RequestError, match="too much is held out"):
        run_stage(tmp_path / "out", [tmp_path / "in"], held_out=["p0", "p1"])
