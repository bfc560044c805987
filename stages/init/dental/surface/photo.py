"""What the surface needs of one placed photograph: camera, texture, and where tooth and gum are."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.artifacts.dental.fdi import Jaw
from pipeline.artifacts.teeth import Dentition
from stages.init.dental.solution import PlacedView
from stages.stereo.appearance import highlights

Array32 = npt.NDArray[np.float32]
Array64 = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

#: Texture that correlates on enamel and gum alike: light, and not red (.6 L - .8 a of CIE Lab).
_LIGHT, _RED = 0.6, -0.8
#: The texture is normalised over this length (mm): about the correlation window, narrower than
#: a crown, so that a highlight or the shade of the cheek does not decide.
_NORMALISE = 1.2
#: Contrast below this (8-bit Lab units) is noise.
_NOISE = 4.0
#: Gum is learnt in a ring beside the crowns (mm) on the gums' side.
_RING = (0.4, 2.2)
#: Least standard deviations of the gum's colour (8-bit L, a, b).
_GUM_SPREAD = (14.0, 4.0, 4.5)
#: Lighter and less red than the gum by more than so many standard deviations: not gum.
_PALE = 1.8
#: Holes in tooth and gum up to this size (square mm) that are not dark are wet highlights, or
#: crowns of another colour.
_BRIGHT_HOLE = 30.0
#: Highlights that tissue encloses may be so large (square mm; the largest of 48 photographs: 73).
#: Most of one is lighter than the gum by more than shade makes it darker, and of what is not white
#: at least so much is red: retractors are grey, lips and cheeks that look like a hole are darker.
_HIGHLIGHT, _RED_SHARE = 80.0, 0.85
#: Not dark: lighter than so much of the gum.
_LIT = 0.6
#: Share of that size up to which a hole is a speck, bright or not.
_SPECK = 0.02
#: Darker than so much of the median of the teeth, over at least so many mm: nothing is there that a
#: light beside the lens could reach.
_VOID, _VOID_SIZE = 0.2, 1.0
#: Gum in shade: that much darker (8-bit L) is no reason to call it something else.
_GUM_SHADE = 25.0


@dataclass(frozen=True)
class Photo:
    """One placed photograph, prepared.

    Attributes:
        index: its place among the photographs given.
        camera: [15] float64: cam_from_world rotation row by row, translation, focal,
            principal point.
        size: height, width.
        density: pixels per mm at the teeth.
        image: [H, W, 3] float32 sRGB 0..1.
        texture: [H, W] float32, locally normalised.
        upper, lower: [H, W] float32 0 or 1: tooth of this jaw.
        upper_gum, lower_gum: [H, W] float32 0 or 1: gum of this jaw.
        dull: [H, W] float32: 1, and 0 in highlights.
        void: [H, W] float32 0 or 1: so dark that nothing can be there, near or far.
        covered: [H, W] float32 0 or 1: something stands before the teeth and the gum.
        valid: [H, W] bool.
    """

    index: int
    camera: Array64
    size: tuple[int, int]
    density: float
    image: Array32
    texture: Array32
    upper: Array32
    lower: Array32
    upper_gum: Array32
    lower_gum: Array32
    dull: Array32
    void: Array32
    covered: Array32
    valid: Mask

    def tooth_of(self, jaw: Jaw) -> Array32:
        """[H, W] float32 0 or 1: teeth of this jaw."""
        return self.upper if jaw == "upper" else self.lower

    def gum_of(self, jaw: Jaw) -> Array32:
        """[H, W] float32 0 or 1: gum of this jaw."""
        return self.upper_gum if jaw == "upper" else self.lower_gum

    @property
    def centre(self) -> Array64:
        """[3] position of the camera, mm."""
        return -self.camera[:9].reshape(3, 3).T @ self.camera[9:12]

    def project(self, points: Array32) -> tuple[Array32, Array32]:
        """Pixel coordinates [..., 2] (centres at .5) and z-depths [...] of points [..., 3]."""
        rotation = self.camera[:9].reshape(3, 3).astype(np.float32)
        local = points @ rotation.T + self.camera[9:12].astype(np.float32)
        depth = local[..., 2]
        scale = np.float32(self.camera[12]) / np.maximum(depth, np.float32(1e-3))
        pixels = local[..., :2] * scale[..., None] + self.camera[13:15].astype(np.float32)
        return pixels, depth

    def sample(self, values: Array32, pixels: Array32) -> Array32:
        """Values [H, W(, C)] float32 at pixel coordinates [..., 2]; 0 outside the photograph."""
        flat = pixels.reshape(-1, 2) if pixels.ndim != 3 else pixels
        if flat.ndim == 2:
            flat = flat[None]
        sampled = cv2.remap(
            values, flat[..., 0] - np.float32(0.5), flat[..., 1] - np.float32(0.5), cv2.INTER_LINEAR
        )
        return np.asarray(sampled, np.float32).reshape(pixels.shape[:-1] + values.shape[2:])


@dataclass(frozen=True)
class FullSize:
    """A photograph at the size that depths and colours are wanted in.

    Attributes:
        image: [H, W, 3] float32 sRGB in 0..1.
        valid: [H, W] bool: where it may be used.
        tooth, above: [H, W] bool, of `Dentition`.
    """

    image: Array32
    valid: Mask
    tooth: Mask
    above: Mask


def at_full_size(photo: Photo, full: FullSize) -> Photo:
    """A prepared photograph enlarged: what was found in it stays, the picture is that given."""
    height, width = full.valid.shape
    if photo.size == (height, width):
        return photo

    def enlarged(values: Array32) -> Array32:
        larger = cv2.resize(values, (width, height), interpolation=cv2.INTER_LINEAR)
        return np.asarray(larger, np.float32)

    factor = max(width, height) / max(photo.size)
    camera = photo.camera.copy()
    camera[12:] = camera[12] * factor, width / 2, height / 2
    tooth = full.tooth & full.valid
    # With the teeth, so that no gap opens between them and the gum.
    tissue = np.max([photo.upper, photo.lower, photo.upper_gum, photo.lower_gum], axis=0)
    gum = (enlarged(tissue) > 0.5) & full.valid & ~tooth
    return replace(
        photo,
        camera=camera,
        size=(height, width),
        density=photo.density * factor,
        image=np.ascontiguousarray(full.image, np.float32),
        texture=enlarged(photo.texture),
        upper=(tooth & full.above).astype(np.float32),
        lower=(tooth & ~full.above).astype(np.float32),
        upper_gum=(gum & full.above).astype(np.float32),
        lower_gum=(gum & ~full.above).astype(np.float32),
        dull=enlarged(photo.dull),
        void=((enlarged(photo.void) > 0.5) & full.valid).astype(np.float32),
        covered=((enlarged(photo.covered) > 0.5) & ~tooth).astype(np.float32),
        valid=full.valid,
    )


def prepare_photo(
    index: int,
    image: Array32,
    valid: Mask,
    dentition: Dentition,
    placed: PlacedView,
    middle: Array64,
    gum_deviations: float,
) -> Photo:
    """Prepare one photograph.

    Args:
        index: its place among the photographs.
        image: [H, W, 3] float32 sRGB 0..1.
        valid: [H, W] bool.
        dentition: its teeth.
        placed: its camera.
        middle: [3] a point amid the teeth, mm.
        gum_deviations: see `SurfaceOptions`.

    Raises:
        ValueError: arrays of different size.
    """
    height, width = image.shape[:2]
    for what, mask in (
        ("valid", valid),
        ("tooth mask", dentition.mask),
        ("above", dentition.above),
    ):
        if mask.shape != (height, width):
            raise ValueError(
                f"photograph {index}: the image is {width}x{height}, but '{what}' is "
                f"{mask.shape[1]}x{mask.shape[0]}; they must be of the same working image"
            )
    pose = placed.cam_from_world
    camera = np.array(
        [*pose[:3, :3].ravel(), *pose[:3, 3], placed.focal, width / 2, height / 2], np.float64
    )
    density = placed.focal / max(float(pose[2, :3] @ middle + pose[2, 3]), 1.0)
    lab = _lab(image)
    tooth = dentition.mask & valid
    void = find_void(lab[..., 0], tooth, density)
    shiny = highlights(image)
    gum = find_gum(lab, tooth, shiny > 0, dentition, density, gum_deviations) & valid & ~void
    return Photo(
        index=index,
        camera=camera,
        size=(height, width),
        density=density,
        image=np.ascontiguousarray(image, np.float32),
        texture=_texture(lab, density),
        upper=(tooth & dentition.above).astype(np.float32),
        lower=(tooth & ~dentition.above).astype(np.float32),
        upper_gum=(gum & dentition.above).astype(np.float32),
        lower_gum=(gum & ~dentition.above).astype(np.float32),
        dull=(1 - shiny).astype(np.float32),
        void=(void & valid).astype(np.float32),
        covered=np.zeros((height, width), np.float32),
        valid=valid,
    )


def _lab(image: Array32) -> Array32:
    """CIE Lab [H, W, 3] float32, each channel scaled as in 8-bit images (L 0..255)."""
    lab = np.asarray(cv2.cvtColor(np.ascontiguousarray(image, np.float32), cv2.COLOR_RGB2Lab))
    return np.asarray(lab * np.array([2.55, 1, 1], np.float32), np.float32)


def _texture(lab: Array32, density: float) -> Array32:
    plain = _LIGHT * lab[..., 0] + _RED * lab[..., 1]
    sigma = _NORMALISE * density
    mean = cv2.GaussianBlur(plain, (0, 0), sigma)
    spread = np.sqrt(cv2.GaussianBlur((plain - mean) ** 2, (0, 0), sigma)) + np.float32(_NOISE)
    normal = np.clip((plain - mean) / spread, -3, 3).astype(np.float32)
    return np.asarray(cv2.GaussianBlur(normal, (0, 0), max(0.07 * density, 0.4)), np.float32)


def find_gum(
    lab: Array32,
    tooth: Mask,
    shiny: Mask,
    dentition: Dentition,
    density: float,
    deviations: float,
) -> Mask:
    """Gum around the teeth, told from gloves, lips, retractors and the dark by its colour.

    The ring just beyond the crowns is gum nearly everywhere: its median colour and spread are those
    of this patient's gum in this light.

    Args:
        lab: [H, W, 3] float32, 8-bit scaling.
        tooth: [H, W] bool.
        shiny: [H, W] bool, highlights.
        dentition: the teeth.
        density: pixels per mm.
        deviations: furthest colour, in standard deviations.

    Returns:
        [H, W] bool; all False where nothing red is beside the crowns.
    """
    distance = cv2.distanceTransform((~tooth).astype(np.uint8), cv2.DIST_L2, 5) / density
    ring = (distance > _RING[0]) & (distance < _RING[1]) & _gumwards(tooth, dentition)
    red = lab[..., 1] > (np.median(lab[tooth, 1]) if tooth.any() else 0) + 6
    seed = lab[ring & red]
    if len(seed) < 50:
        return np.zeros(tooth.shape, bool)
    middle = np.median(seed, axis=0)
    spread = np.maximum(1.4826 * np.median(np.abs(seed - middle), axis=0), _GUM_SPREAD)
    smooth = np.asarray(cv2.GaussianBlur(lab, (0, 0), max(0.1 * density, 0.6)), np.float32)
    away = (smooth - middle.astype(np.float32)) / spread.astype(np.float32)
    away[..., 0] = np.where(
        away[..., 0] < 0, np.minimum(away[..., 0] + _GUM_SHADE / spread[0], 0), away[..., 0]
    )
    # Gloves and lips under them are both lighter and less red than gum.
    pale = (away[..., 0] - away[..., 1]) / np.float32(np.sqrt(2))
    like = ((away**2).sum(-1) < deviations**2) & (pale < _PALE) & ~tooth
    small = disc(0.35 * density)
    # Small wet highlights on the gum are gum; thin red seams of a glove are not.
    closed = cv2.morphologyEx((like | tooth).astype(np.uint8), cv2.MORPH_CLOSE, small)
    opened = cv2.morphologyEx(closed, cv2.MORPH_OPEN, small) > 0
    tissue = opened | tooth
    lit, light = (smooth[..., 0] > level for level in (_LIT * middle[0], middle[0] + _GUM_SHADE))
    tissue = tissue | _bright_holes(tissue, lit, _BRIGHT_HOLE * density**2)
    tissue = tissue | _highlights_within(tissue, light, red, shiny, _HIGHLIGHT * density**2)
    return joined_to(tissue, tooth) & ~tooth


def disc(radius: float) -> npt.NDArray[np.uint8]:
    """A disc of so many whole pixels, at least one, to erode and dilate with."""
    size = max(int(radius), 1)
    shape = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * size + 1, 2 * size + 1))
    return np.asarray(shape, np.uint8)


def joined_to(mask: Mask, seeds: Mask) -> Mask:
    """[H, W] bool: the pieces of a mask [H, W] that hold one of the seeds [H, W]."""
    count, label = cv2.connectedComponents(mask.astype(np.uint8), connectivity=4)
    held = np.zeros(count, bool)
    held[np.unique(label[seeds])] = True
    held[0] = False
    return held[label]


def find_void(lightness: Array32, tooth: Mask, density: float) -> Mask:
    """Where a photograph shows nothing but the dark around the jaws.

    Args:
        lightness: [H, W] float32, CIE L as in 8-bit images.
        tooth: [H, W] bool.
        density: pixels per mm.

    Returns:
        [H, W] bool; all False where no tooth is there to compare with.
    """
    if not tooth.any():
        return np.zeros(tooth.shape, bool)
    smooth = np.asarray(cv2.GaussianBlur(lightness, (0, 0), max(0.1 * density, 0.6)))
    dark = (smooth < _VOID * np.median(smooth[tooth])) & ~tooth
    narrow = disc(round(_VOID_SIZE / 2 * density))
    return np.asarray(cv2.morphologyEx(dark.astype(np.uint8), cv2.MORPH_OPEN, narrow) > 0)


def _bright_holes(tissue: Mask, bright: Mask, most: float) -> Mask:
    """Holes of at most `most` pixels, most of which are bright."""
    count, label = cv2.connectedComponents((~tissue).astype(np.uint8), connectivity=4)
    area = np.bincount(label.ravel(), minlength=count)
    lit = np.bincount(label[bright], minlength=count)
    hole = ((area <= most) & (lit > 0.7 * area)) | (area <= most * _SPECK)
    hole[0] = False
    return hole[label]


def _highlights_within(tissue: Mask, light: Mask, red: Mask, shiny: Mask, most: float) -> Mask:
    """Holes of at most `most` pixels that tissue encloses, lighter than it and as red."""
    count, label = cv2.connectedComponents((~tissue).astype(np.uint8), connectivity=4)

    def pixels(mask: Mask) -> npt.NDArray[np.int64]:
        return np.bincount(label[mask], minlength=count)

    area = pixels(~tissue)
    hole = (area <= most) & (pixels(light) > area / 2)
    hole &= pixels(red & ~shiny) >= _RED_SHARE * pixels(~shiny)
    hole[np.concatenate([label[0], label[-1], label[:, 0], label[:, -1]])] = False
    hole[0] = False
    return hole[label]


def _gumwards(tooth: Mask, dentition: Dentition) -> Mask:
    """[H, W] bool: beyond the row of teeth, not between the jaws."""
    y, x = np.mgrid[: tooth.shape[0], : tooth.shape[1]]
    places, across = dentition.levelled(x, y)
    along = np.rint(places).astype(np.int64)
    along -= along.min()
    size = int(along.max()) + 1
    highest = np.full(size, np.inf)
    lowest = np.full(size, -np.inf)
    np.minimum.at(highest, along[tooth], across[tooth])
    np.maximum.at(lowest, along[tooth], across[tooth])
    return (across < highest[along]) | (across > lowest[along])
