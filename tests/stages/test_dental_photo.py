"""Teeth in photographs: mask, crowns and landmarks, on a drawn mouth with known truth."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from stages.init.dental.occlusal import cheapest_path
from stages.init.dental.photo import read_dentitions, row_tilt, teeth_likely
from stages.init.dental.pictures.overlay import labelled_overlay, sheet
from stages.init.dental.teeth_mask import HISTOGRAM_BLUR, valleys

HEIGHT, WIDTH = 384, 512
MIDDLE = 190
#: Crowns of the drawn mouth, left to right: [centre x, width].
UPPER = [(96, 40), (140, 48), (192, 56), (250, 60), (308, 56), (360, 48), (404, 40)]
LOWER = [(104, 44), (147, 42), (188, 40), (228, 40), (268, 40), (309, 42), (352, 44)]
REAL_DATA = Path(__file__).resolve().parents[3] / "shared" / "data"


def drawn_mouth(seed=0):
    """Two rows of crowns between gums and pale gloves; the teeth; the zeniths."""
    rng = np.random.default_rng(seed)
    image = np.empty((HEIGHT, WIDTH, 3), np.float32)
    image[:] = (0.70, 0.36, 0.36)
    image[:50] = image[-50:] = (0.86, 0.80, 0.77)
    teeth = np.zeros((HEIGHT, WIDTH), np.uint8)
    x = np.arange(WIDTH) + 0.5
    rows = (np.arange(HEIGHT) + 0.5)[:, None]
    zeniths = {"upper": [], "lower": []}
    lines = []
    for jaw, crowns, sign, reach in (("upper", UPPER, -1, 62), ("lower", LOWER, 1, 50)):
        for centre, width in crowns:
            inside = np.abs(x - centre) < width / 2
            depth = reach - 20 * np.abs((x - centre) / (width / 2)) ** 2.5
            if sign < 0:
                crown = inside & (rows > MIDDLE - depth) & (rows <= MIDDLE)
            else:
                crown = inside & (rows < MIDDLE + depth) & (rows > MIDDLE)
            teeth[crown] = 1
            zeniths[jaw].append((centre, MIDDLE + sign * reach))
            lines.append((centre - width / 2, centre + width / 2, sign))
    image[teeth > 0] = (0.87, 0.83, 0.70)
    for left, right, sign in lines:
        for edge in (left, right):
            end = (round(edge), MIDDLE + sign * 40)
            cv2.line(image, (round(edge), MIDDLE), end, (0.55, 0.46, 0.36), 2)
    cv2.line(image, (76, MIDDLE), (424, MIDDLE), (0.35, 0.24, 0.2), 3)
    image = cv2.GaussianBlur(image, (0, 0), 1.0) + rng.normal(0, 0.008, image.shape)
    return np.clip(image, 0, 1).astype(np.float32), teeth > 0, zeniths


def whole(image):
    return np.ones(image.shape[:2], bool)


def read_one(image, valid=None):
    return read_dentitions([image], [whole(image) if valid is None else valid])[0]


def zenith_errors(dentition, zeniths, move=lambda point: point):
    """Distance of each true zenith to the crown's that has its number."""
    errors = []
    for jaw in ("upper", "lower"):
        crowns = dentition.crowns(jaw)
        assert len(crowns) == len(zeniths[jaw]), jaw
        truth = [move(np.array(point, float)) for point in zeniths[jaw]]
        errors += [np.linalg.norm(c.zenith - t) for c, t in zip(crowns, truth, strict=True)]
    return np.array(errors)


def overlap(mask, truth):
    return (mask & truth).sum() / (mask | truth).sum()


def test_crowns_of_a_drawn_mouth_are_found_where_they_are():
    image, teeth, zeniths = drawn_mouth()
    dentition = read_one(image)
    assert dentition.doubts == ()
    assert overlap(dentition.mask, teeth) > 0.93
    assert np.median(zenith_errors(dentition, zeniths)) < 2.5
    assert abs(dentition.roll) == 0
    assert dentition.band_height == pytest.approx(100, abs=15)
    rows = np.nonzero(np.diff(dentition.above[:, 100:400].astype(int), axis=0))[0]
    assert np.abs(rows - MIDDLE).max() < 6
    for crown, (centre, width) in list(zip(dentition.upper, UPPER, strict=True))[1:-1]:
        assert crown.width == pytest.approx(width, abs=8)
        assert crown.papilla_left[0] == pytest.approx(centre - width / 2, abs=5)
        assert crown.papilla_right[0] == pytest.approx(centre + width / 2, abs=5)
        assert crown.tip[1] == pytest.approx(MIDDLE, abs=4)
        assert not crown.doubtful
    assert dentition.upper[0].cut_left
    assert dentition.upper[-1].cut_right
    assert dentition.upper[0].papilla_left is None


@pytest.mark.parametrize(
    "change",
    [
        lambda image: image * np.float32([1.0, 0.93, 0.7]),
        lambda image: image * np.float32([0.85, 0.95, 1.1]),
        lambda image: image ** np.float32(1.35),
        lambda image: image * np.float32(0.6),
    ],
    ids=["warm", "cool", "gamma", "dark"],
)
def test_a_cast_of_the_light_moves_no_crown(change):
    image, teeth, zeniths = drawn_mouth()
    changed = np.clip(change(image), 0, 1).astype(np.float32)
    dentition = read_one(changed)
    assert overlap(dentition.mask, teeth) > 0.9
    assert np.median(zenith_errors(dentition, zeniths)) < 3


@pytest.mark.parametrize("degrees", [-25, 25])
def test_a_rolled_photograph_is_read_upright_and_answered_in_its_own_pixels(degrees):
    image, teeth, zeniths = drawn_mouth()
    centre = (WIDTH / 2, HEIGHT / 2)
    turn = cv2.getRotationMatrix2D((centre[0] - 0.5, centre[1] - 0.5), -degrees, 1.0)
    size = (WIDTH, HEIGHT)
    rolled = cv2.warpAffine(image, turn, size, borderMode=cv2.BORDER_REFLECT)
    mask = cv2.warpAffine(teeth.astype(np.uint8), turn, size) > 0
    dentition = read_one(rolled)
    assert np.degrees(dentition.roll) == pytest.approx(degrees, abs=3)
    assert overlap(dentition.mask, mask) > 0.9
    errors = zenith_errors(
        dentition, zeniths, lambda point: turn[:, :2] @ (point - 0.5) + turn[:, 2] + 0.5
    )
    assert np.median(errors) < 3


def test_coordinates_follow_the_size_of_the_photograph():
    image, _, zeniths = drawn_mouth()
    double = cv2.resize(image, None, fx=2, fy=2, interpolation=cv2.INTER_CUBIC)
    dentition = read_one(np.clip(double, 0, 1))
    assert dentition.mask.shape == double.shape[:2]
    assert np.median(zenith_errors(dentition, zeniths, lambda point: point * 2)) < 5


def test_a_cropped_row_is_doubtful_at_the_border():
    image, _, _ = drawn_mouth()
    cropped = np.ascontiguousarray(image[:, 240:])  # through the fourth upper crown
    dentition = read_one(cropped)
    assert len(dentition.upper) == 4
    assert dentition.upper[0].cut_left and dentition.upper[0].doubtful
    assert not dentition.upper[1].doubtful


def test_nothing_is_read_outside_the_valid_part():
    image, _, _ = drawn_mouth()
    valid = whole(image)
    valid[:, 360:] = False
    dentition = read_one(image, valid)
    assert not dentition.mask[:, 366:].any()
    assert max(crown.zenith[0] for crown in dentition.upper) < 364


def test_threads_change_nothing_and_photographs_without_teeth_are_none():
    image, _, _ = drawn_mouth()
    bare = np.full((HEIGHT, WIDTH, 3), 0.5, np.float32)
    images = [image, bare, np.ascontiguousarray(image[:, ::-1])]
    valid = [whole(one) for one in images]
    one, two = (read_dentitions(images, valid, threads=threads) for threads in (1, 2))
    assert one[1] is None and two[1] is None
    for a, b in ((one[0], two[0]), (one[2], two[2])):
        assert np.array_equal(a.mask, b.mask) and np.array_equal(a.above, b.above)
        zeniths = [np.array([c.zenith for c in (*d.upper, *d.lower)]) for d in (a, b)]
        assert np.array_equal(*zeniths)


def test_only_mouths_are_likely_teeth():
    image, _, _ = drawn_mouth()
    rng = np.random.default_rng(1)
    noise = cv2.GaussianBlur(rng.uniform(size=image.shape).astype(np.float32), (0, 0), 9)
    noise = (noise - noise.min()) / (noise.max() - noise.min())
    sky = np.linspace([0.4, 0.6, 0.9], [0.3, 0.4, 0.1], HEIGHT)[:, None].repeat(WIDTH, axis=1)
    assert teeth_likely([image] * 3, [whole(image)] * 3)
    assert not teeth_likely([noise] * 3, [whole(image)] * 3)
    assert not teeth_likely([sky.astype(np.float32)] * 3, [whole(image)] * 3)
    assert not teeth_likely([image, noise, noise], [whole(image)] * 3)
    assert not teeth_likely([], [])


def test_shapes_that_do_not_fit_are_refused():
    image, _, _ = drawn_mouth()
    with pytest.raises(ValueError, match="masks"):
        read_dentitions([image], [])
    with pytest.raises(ValueError, match="shape"):
        read_dentitions([image], [np.ones((3, 4), bool)])


def test_valleys_part_the_modes_of_a_histogram():
    edges = np.linspace(-2, 1.2, 641)
    centres = (edges[1:] + edges[:-1]) / 2
    modes = ((-0.4, 0.5), (-0.02, 0.3), (0.1, 0.2))
    sigma = 2 * HISTOGRAM_BLUR
    counts = sum(s * np.exp(-0.5 * ((centres - m) / sigma) ** 2) for m, s in modes)
    found = valleys(counts / counts.sum())
    assert len(found) == 4
    assert -0.4 < found[1] < -0.02 < found[2] < 0.1


def test_row_tilt_is_clockwise():
    rows, columns = np.mgrid[:200, :300]
    assert row_tilt(np.abs(rows - 50 - 0.2 * columns) < 10) == pytest.approx(
        np.arctan(0.2), abs=0.02
    )


def test_the_cheapest_path_may_run_along_a_column():
    cost = np.ones((9, 5), np.float32)
    cost[2, :3] = cost[2:8, 2] = cost[7, 2:] = 0.01
    highest, lowest = cheapest_path(cost)
    assert highest.tolist() in ([2, 2, 2, 7, 7], [2, 2, 3, 7, 7])  # it may cut the corner
    assert lowest.tolist() in ([2, 2, 7, 7, 7], [2, 2, 6, 7, 7])


def test_overlay_shows_each_label_in_its_quadrant_and_refuses_a_wrong_count():
    image, _, _ = drawn_mouth()
    dentition = read_one(image)
    upper, lower = [14, 13, 12, 11, 21, 22, 0], [44, 43, 42, 41, 31, 32, 33]
    picture = labelled_overlay(image, dentition, upper, lower)
    assert picture.shape == (768, 1024, 3) and picture.dtype == np.uint8
    plain = labelled_overlay(image, dentition, [0] * 7, [0] * 7)
    changed = (picture != plain).any(axis=-1)
    assert changed[:380].any() and changed[380:].any()
    with pytest.raises(ValueError, match="labels"):
        labelled_overlay(image, dentition, upper[:-1], lower)
    empty = labelled_overlay(image, None, [], [])
    assert sheet([picture, empty[:500]]).shape == (768, 2056, 3)
    with pytest.raises(ValueError, match="at least one"):
        sheet([])


def read_picture(path, width=512):
    image = cv2.imread(str(path))[..., ::-1]
    size = (width, round(image.shape[0] * width / image.shape[1]))
    image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    return image.astype(np.float32) / np.float32(255)


@pytest.mark.real_data
def test_teeth_in_real_photographs():
    folder = REAL_DATA / "dental_photos_a"
    if not folder.exists():
        pytest.skip("the real photographs are not here")
    names = ["0_right", "1_frontal", "2_left"]
    images = [read_picture(folder / "images" / f"{name}.jpg") for name in names]
    valid = [whole(image) for image in images]
    assert teeth_likely(images, valid)
    found = read_dentitions(images, valid)
    for name, dentition, least in zip(names, found, (0.7, 0.9, 0.86), strict=True):
        truth = cv2.imread(str(folder / "masks_teeth" / f"{name}.png"), cv2.IMREAD_GRAYSCALE)
        truth = cv2.resize(truth, (512, 384), interpolation=cv2.INTER_AREA) > 127
        assert overlap(dentition.mask, truth) > least
        assert len(dentition.upper) >= 6 and len(dentition.lower) >= 7


@pytest.mark.real_data
def test_teeth_in_frames_of_a_scan():
    folder = REAL_DATA / "scan_video_a"
    if not folder.exists():
        pytest.skip("the scan frames are not here")
    names = ["001", "012", "022"]
    images = [read_picture(folder / "frames" / f"{name}.png") for name in names]
    valid = [whole(image) for image in images]
    assert teeth_likely(images, valid)
    for name, dentition in zip(names, read_dentitions(images, valid), strict=True):
        truth = cv2.imread(str(folder / "masks" / f"{name}.png"), cv2.IMREAD_GRAYSCALE) == 255
        assert overlap(dentition.mask, truth) > 0.95
        assert 8 <= len(dentition.upper) <= 10 and 8 <= len(dentition.lower) <= 11
