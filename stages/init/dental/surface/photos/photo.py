"""What the surface needs of one placed photograph: camera, texture, and where tooth and gum are."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.artifacts.dental.fdi import Jaw
from pipeline.artifacts.teeth import Dentition
from stages.init.dental.solution import PlacedView
from stages.init.dental.surface.photos.tissue import (
    eight_bit_lab,
    find_hardware,
    find_void,
    joined_to,
    without_small_holes,
)
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
        covered: [H, W] float32 0 or 1: lip, cheek, or what holds them may hide teeth and gum.
        hardware: [H, W] float32 0..1: how sure it is metal that is fixed to the crowns.
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
    hardware: Array32
    valid: Mask

    def tooth_of(self, jaw: Jaw) -> Array32:
        """[H, W] float32 0 or 1: teeth of this jaw."""
        return self.upper if jaw == "upper" else self.lower

    def gum_of(self, jaw: Jaw) -> Array32:
        """[H, W] float32 0 or 1: gum of this jaw."""
        return self.upper_gum if jaw == "upper" else self.lower_gum

    def away_from_teeth(self) -> Array32:
        """[H, W] float32: pixels to the nearest tooth of either jaw; 0 on one."""
        none = ((self.upper == 0) & (self.lower == 0)).astype(np.uint8)
        return np.asarray(cv2.distanceTransform(none, cv2.DIST_L2, 5), np.float32)

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
        hardware=enlarged(photo.hardware),
        valid=full.valid,
    )


def prepare_photo(
    index: int,
    image: Array32,
    valid: Mask,
    dentition: Dentition,
    placed: PlacedView,
    middle: Array64,
) -> Photo:
    """Prepare one photograph.

    Args:
        index: its place among the photographs.
        image: [H, W, 3] float32 sRGB 0..1.
        valid: [H, W] bool.
        dentition: its teeth.
        placed: its camera.
        middle: [3] a point amid the teeth, mm.

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
    lab = eight_bit_lab(image)
    tooth = dentition.mask & valid
    void = find_void(lab[..., 0], tooth, density)
    on_jaws = without_small_holes(dentition.on_jaws_mask, density) & valid & ~void
    gum = joined_to(on_jaws | tooth, tooth) & ~tooth
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
        dull=(1 - highlights(image)).astype(np.float32),
        void=(void & valid).astype(np.float32),
        covered=(valid & ~(on_jaws | tooth | void)).astype(np.float32),
        hardware=find_hardware(lab, tooth, density),
        valid=valid,
    )


def _texture(lab: Array32, density: float) -> Array32:
    plain = _LIGHT * lab[..., 0] + _RED * lab[..., 1]
    sigma = _NORMALISE * density
    mean = cv2.GaussianBlur(plain, (0, 0), sigma)
    spread = np.sqrt(cv2.GaussianBlur((plain - mean) ** 2, (0, 0), sigma)) + np.float32(_NOISE)
    normal = np.clip((plain - mean) / spread, -3, 3).astype(np.float32)
    return np.asarray(cv2.GaussianBlur(normal, (0, 0), max(0.07 * density, 0.4)), np.float32)
