"""Cameras that are known: a COLMAP model, or a `transforms.json` as nerfstudio writes it."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path, PurePath
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.artifacts.cameras import Camera
from pipeline.artifacts.space.scale import NO_SCALE, Scale
from pipeline.artifacts.views import View, to_uint8
from pipeline.errors import RequestError
from pipeline.geometry.models.colmap import quiet_pycolmap
from pipeline.untrusted.files import UnusableFile
from pipeline.untrusted.paths import user_path
from pipeline.untrusted.scenes.cameras import Lens, PosedLens, check_pose
from pipeline.untrusted.scenes.colmap import Pose, read_cloud, read_model
from pipeline.untrusted.scenes.transforms import read_transforms

Array = npt.NDArray[np.float64]

#: Folders of COLMAP's models; `isdigit` also takes digits that `int` doesn't.
_NUMBER = re.compile(r"[0-9]{1,9}")
COLMAP_FILES = ("cameras", "images", "points3D", "rigs", "frames")
#: What messages call the cameras where no setting is named.
SETTING = "cameras"
#: How far the poses that a COLMAP model says twice may be apart, where they are written in digits.
_POSES_AGREE = 1e-3


@dataclass(frozen=True)
class KnownCamera:
    """A posed image of the user's.

    Attributes:
        name: file name or path of its image, as the model has it.
        lens: `pycolmap.Camera`, in the pixels of that image.
        cam_from_world: [4, 4], OpenCV axes, in the model's world.
    """

    name: str
    lens: Any
    cam_from_world: Array


def model_files(path: Path, setting: str = SETTING) -> dict[str, Path]:
    """The files of a model: label -> file.

    Args:
        path: a folder with a COLMAP model (text or binary; also with ``sparse/0`` or ``0`` in it,
            and of several such the one that holds most), a folder with a `transforms.json`, or such
            a file itself.
        setting: name of the setting that gave the path, for messages.

    Raises:
        RequestError: there is nothing of the kind.
    """
    path = user_path(path, setting)
    if not path.exists():
        raise RequestError(f"{setting}: there is no {path.absolute()}. Check the path.")
    if path.is_file() and path.suffix.lower() == ".json":
        return {"cameras/transforms.json": path}
    for folders in ([path], numbered(path), [path / "sparse"], numbered(path / "sparse")):
        models = [model for model in map(_files_of_model, folders) if model]
        if models:  # COLMAP's first model is not always its largest
            return max(models, key=_bytes_of_images)
    if (path / "transforms.json").is_file():
        return {"cameras/transforms.json": path / "transforms.json"}
    raise RequestError(
        f"{setting}: {path} holds no cameras. Give a folder with a COLMAP model (cameras.bin "
        "and images.bin, or .txt), or a transforms.json as nerfstudio writes it."
    )


def numbered(folder: Path) -> list[Path]:
    """The folders 0, 1, 2, ... in which COLMAP leaves its models, in their order."""
    try:
        found = [entry for entry in folder.iterdir() if _NUMBER.fullmatch(entry.name)]
    except OSError:  # no folder, or none that may be read
        return []
    return sorted(found, key=lambda entry: int(entry.name))


def _files_of_model(folder: Path) -> dict[str, Path]:
    """Label -> file of a COLMAP model; none if it is not whole."""
    for suffix in (".bin", ".txt"):
        found = {
            f"cameras/{stem}{suffix}": folder / f"{stem}{suffix}"
            for stem in COLMAP_FILES
            if (folder / f"{stem}{suffix}").is_file()
        }
        if f"cameras/cameras{suffix}" in found and f"cameras/images{suffix}" in found:
            return found
    return {}


def _bytes_of_images(model: dict[str, Path]) -> int:
    return max(path.stat().st_size for path in model.values() if path.stem == "images")


def read_cameras(files: Iterable[Path], setting: str = SETTING) -> tuple[list[KnownCamera], Scale]:
    """Read what `model_files` found.

    Args:
        files: those of one model.
        setting: name of the setting that gave them, for messages.

    Returns:
        The posed images sorted by name, and the scale of their world as the file says it.

    Raises:
        RequestError: the files are damaged, or hold no posed image.
    """
    files = list(files)
    is_list = files[0].suffix.lower() == ".json"
    source = files[0] if is_list else files[0].parent
    try:
        posed, scale = read_transforms(source) if is_list else (_posed(source), NO_SCALE)
    except UnusableFile as error:
        raise RequestError(
            f"{setting}: {source} {error}. Is it whole? Give the cameras as the program that "
            "found them wrote them."
        ) from error
    if not posed:
        raise RequestError(f"{setting}: {source} holds no posed image.")
    cameras = [KnownCamera(one.name, _lens(one.lens), one.cam_from_world) for one in posed]
    return sorted(cameras, key=lambda camera: camera.name), scale


def _posed(folder: Path) -> list[PosedLens]:
    """The posed images of a COLMAP model, as its own reader poses them."""
    model = read_model(folder)
    if model.has_points:
        read_cloud(folder)  # a model that is half there is refused, whatever is wanted of it
    rigid = {number: _rigid(image.cam_from_world) for number, image in model.images.items()}
    for number, image in model.images.items() if model.frames else ():
        frame, sensor_from_rig = model.frame_of(number)
        framed = _rigid(frame.rig_from_world)
        if sensor_from_rig is not None:
            framed = _rigid(sensor_from_rig) * framed
        apart = np.abs(framed.matrix() - rigid[number].matrix()).max()
        if apart > _POSES_AGREE * max(1.0, np.abs(framed.translation).max()):
            raise UnusableFile(
                f"is damaged: its images and its frames say different poses of {image.name}"
            )
        rigid[number] = framed
    found = []
    for number, image in model.images.items():
        pose = np.vstack([rigid[number].matrix(), [0, 0, 0, 1]])
        check_pose(pose, f"image {number} ({image.name})", "the pose")
        found.append(PosedLens(image.name, model.lenses[image.camera], pose))
    return found


def _rigid(pose: Pose) -> Any:
    pycolmap = quiet_pycolmap()
    w, x, y, z = pose.quat_wxyz
    rotation = pycolmap.Rotation3d(np.array([x, y, z, w]))
    if abs(np.linalg.norm(pose.quat_wxyz) - 1) > 1e-9:  # written with few digits
        rotation.normalize()
    return pycolmap.Rigid3d(rotation, np.array(pose.translation))


def _lens(lens: Lens) -> Any:
    """`pycolmap.Camera` of a lens that was checked."""
    return quiet_pycolmap().Camera(
        model=lens.model, width=lens.width, height=lens.height, params=lens.parameters
    )


def matching_cameras(
    cameras: list[KnownCamera], views: Iterable[View], setting: str = SETTING,
    others: Iterable[View] = (),
) -> dict[str, KnownCamera]:  # fmt: skip
    """Name of a view -> its camera: by the name of the source file, with or without suffix.

    Models that we exported have the names of views, and no others: a model of all frames of a film
    (000, 001, ...) is none of ours where only some of them are views. Of all these ways the one
    that finds most cameras holds, so that photographs 000, 005, 010 are not taken for views of
    these names.

    Args:
        cameras: of the model.
        views: with names of their own.
        setting: name of the setting that gave the model, for messages.
        others: photographs that are held out, which have no such names; they are found in the way
            that finds most of the views.

    Raises:
        RequestError: fewer than two views have a camera, or one has several.
    """
    views = list(views)
    counted = {view.name for view in views}
    views += others
    schemes: tuple[tuple[Callable[[View], str], Callable[[str], str]], ...] = (
        (lambda view: view.source_name, str),
        (lambda view: PurePath(view.source_name).name, lambda name: _path(name).name),
        (lambda view: PurePath(view.source_name).stem, lambda name: _path(name).stem),
        (lambda view: view.name, lambda name: _path(name).stem),  # a model that we exported
    )
    foreign = sorted({_path(camera.name).stem for camera in cameras} - counted)
    schemes = schemes[:-1] if foreign else schemes
    best: dict[str, list[KnownCamera]] = {}
    most = (0, 0)
    for name_of_view, name_of_camera in schemes:
        fitting = {
            view.name: [c for c in cameras if name_of_camera(c.name) == name_of_view(view)]
            for view in views
            if name_of_view(view)
        }
        found = {name: those for name, those in fitting.items() if those}
        number = len(found.keys() & counted), len(found)
        if number > most:
            best, most = found, number
    several = next((those for those in best.values() if len(those) > 1), None)
    if several is not None:
        raise RequestError(
            f"{setting}: {len(several)} cameras fit one photograph "
            f"({', '.join(camera.name for camera in several[:3])}). Give each image a name of its "
            "own."
        )
    if len(best) >= 2:
        return {name: those[0] for name, those in best.items()}
    if best:
        raise RequestError(
            f"{setting}: of the {len(views)} photographs {next(iter(best.values()))[0].name} alone "
            "has a camera there; two at least are needed."
        )
    raise RequestError(
        f"{setting}: none of the {len(views)} photographs has a camera there. The names there are "
        f"like {cameras[0].name}, the photographs' like {views[0].source_name or views[0].name}."
        f"{_numbers_only(foreign, counted, cameras)}"
    )


def _numbers_only(foreign: list[str], names: set[str], cameras: list[KnownCamera]) -> str:
    """Of a model whose names would be those of views, if it had no others: a sentence."""
    if not foreign or len({_path(camera.name).stem for camera in cameras} & names) < 2:
        return ""
    return (
        f" The numbers of the photographs as they were read ({', '.join(sorted(names)[:3])}, ...) "
        f"are not meant by these names, for no photograph has the number {foreign[0]}: give the "
        "photographs under the names that the model has."
    )


def _path(name: str) -> PurePath:
    """The path of an image as a model has it, perhaps one that was made under Windows."""
    return PurePath(name.replace("\\", "/"))


def pinhole_camera(view: View, known: KnownCamera, setting: str = SETTING) -> Camera:
    """The camera of a view without the distortion of its lens, in the model's world.

    The lens may refer to the stored pixel grid of the photograph, to the upright one, or to either
    at another size.

    Raises:
        RequestError: the lens's image has another shape than the photograph.
    """
    lens = known.lens
    working_from_lens = working_pixels_from_lens(view, known, setting)
    linear = working_from_lens[:2, :2]
    focal = np.abs(linear) @ np.array([lens.focal_length_x, lens.focal_length_y])
    centre = working_from_lens @ np.array([lens.principal_point_x, lens.principal_point_y, 1.0])
    pose = np.eye(4)
    pose[:3] = _turn(working_from_lens) @ known.cam_from_world[:3]
    return Camera(
        view.name, view.width, view.height, float(focal[0]), float(focal[1]),
        float(centre[0]), float(centre[1]), pose,
    )  # fmt: skip


def _turn(working_from_lens: Array) -> Array:
    """[3, 3] R in A K = K' R: rows of A are axes of the working image, turned by quarters."""
    linear = working_from_lens[:2, :2]
    turn = np.eye(3)
    turn[:2, :2] = np.sign(np.where(np.abs(linear) > 1e-9, linear, 0))
    return turn


def as_pinhole(view: View, known: KnownCamera, setting: str = SETTING) -> tuple[View, Camera]:
    """The view as a pinhole camera sees it, and that camera (`pinhole_camera`).

    Distortion is taken out of the image; what the lens did not see is masked.

    Raises:
        RequestError: the lens's image has another shape than the photograph.
    """
    lens = known.lens
    camera = pinhole_camera(view, known, setting)
    coefficients = np.array([lens.params[index] for index in lens.extra_params_idxs()])
    # a fisheye lens bends the picture without any coefficient, too
    if "FISHEYE" not in lens.model_name and not (np.abs(coefficients) > 1e-9).any():
        return view, camera
    source = _distorted(view, known, camera, setting)
    straight = resampled(view, source)
    parameters = " ".join(f"{value:.9g}" for value in lens.params)
    text = f"{lens.model_name} {lens.width} {lens.height} {parameters}"
    return replace(straight, lens_taken_out=text), camera


def lens_of(view: View, text: str) -> KnownCamera:
    """The lens that `as_pinhole` has written as a text (`View.lens_taken_out`), at the origin."""
    model, width, height, *parameters = text.split()
    lens = quiet_pycolmap().Camera(
        model=model, width=int(width), height=int(height),
        params=[float(value) for value in parameters],
    )  # fmt: skip
    return KnownCamera(view.name, lens, np.eye(4))


def bending(view: View, known: KnownCamera, setting: str) -> float:
    """By how many pixels at most the distortion of a lens moves what its view shows."""
    straight = np.stack(np.meshgrid(np.arange(view.width), np.arange(view.height)), -1)
    bent = _distorted(view, known, pinhole_camera(view, known, setting), setting)
    return float(np.linalg.norm(bent - straight, axis=-1).max())


def _distorted(view: View, known: KnownCamera, camera: Camera, setting: str) -> Array:
    """[H, W, 2] where a view has what a pinhole camera sees at each pixel (`resampled`)."""
    working_from_lens = working_pixels_from_lens(view, known, setting)
    turn = _turn(working_from_lens)
    v, u = np.mgrid[: view.height, : view.width] + 0.5
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)], -1)
    pixels = known.lens.img_from_cam(np.ascontiguousarray((rays @ turn).reshape(-1, 3)))
    pixels = np.clip(np.where(np.isfinite(pixels), pixels, -1e6), -1e6, 1e6)
    source = pixels @ working_from_lens[:2, :2].T + working_from_lens[:2, 2] - 0.5
    return np.asarray(source.reshape(view.height, view.width, 2))


def resampled(view: View, source: npt.NDArray[np.floating[Any]]) -> View:
    """The view whose pixels [H, W] come from the positions `source` [H, W, 2] of the old ones.

    Positions are of array indices (pixel centres at integers). What comes from outside is masked.
    """
    position = source.astype(np.float32)
    image = cv2.remap(
        view.image, position[..., 0], position[..., 1], cv2.INTER_CUBIC,
        borderMode=cv2.BORDER_REPLICATE,
    )  # fmt: skip
    inside = (position > -0.5).all(-1)
    inside &= (position[..., 0] < view.width - 0.5) & (position[..., 1] < view.height - 0.5)
    if view.mask is not None:
        inside &= (
            cv2.remap(
                view.mask.astype(np.float32), position[..., 0], position[..., 1], cv2.INTER_LINEAR
            )
            > 0.5
        )
    image = rounded(np.where(inside[..., None], image, 0))
    return replace(view, image=image, mask=None if inside.all() else inside)


def rounded(image: npt.NDArray[np.floating[Any]]) -> npt.NDArray[np.float32]:
    """The image at eight bits, as it is at rest: the next stage must see what this one sees."""
    return to_uint8(image).astype(np.float32) / np.float32(255)


def working_pixels_from_lens(view: View, known: KnownCamera, setting: str) -> Array:
    """[3, 3] affine map from the pixels of the model's image to the view's.

    Of a photograph that is stored as a mirror image (and whose file says so) the lens can only be
    that of the upright picture: a camera of the stored one sees a world that is mirrored too.
    """
    lens = known.lens
    width, height = view.source_size if min(view.source_size) > 0 else (view.width, view.height)
    upright = view.upright_size
    shape = lens.width / lens.height
    mirrored = (np.linalg.det(view.working_from_source[:2, :2]) < 0) != view.turned_over
    if abs(np.log(shape * height / width)) < 0.02 and not mirrored:
        scale = np.diag([width / lens.width, height / lens.height, 1.0])
        return np.asarray(view.working_from_source @ scale)
    if abs(np.log(shape * upright[1] / upright[0])) < 0.02:
        scale = np.diag([upright[0] / lens.width, upright[1] / lens.height, 1.0])
        return np.asarray(view.working_from_upright @ scale)
    how = " and is stored as a mirror image" if mirrored else ""
    raise RequestError(
        f"{setting}: the camera of {known.name} is for an image of {lens.width} x {lens.height} "
        f"pixels, but the photograph {view.source_name or view.name} has {width} x {height}{how}. "
        "Give the photographs that the cameras were made from."
    )
