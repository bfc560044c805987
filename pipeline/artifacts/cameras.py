"""`cameras`: poses and intrinsics of the placed views, as a COLMAP sparse model."""

from __future__ import annotations

import json
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import ClassVar, Self

import numpy as np
import numpy.typing as npt

from pipeline.artifacts.base import Artifact
from pipeline.artifacts.space.scale import NO_SCALE, Scale

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Camera:
    """A pinhole camera (OpenCV frame: x right, y down, z forward; pixel centres at .5).

    Attributes:
        name: name of the view it belongs to.
        width, height: image size in pixels, of the view at working size.
        fx, fy, cx, cy: intrinsics in pixels.
        cam_from_world: [4, 4] float64 rigid transform.
    """

    name: str
    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    cam_from_world: Array

    @property
    def matrix(self) -> Array:
        """[3, 3] calibration matrix."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1]], np.float64)

    @property
    def rotation(self) -> Array:
        """[3, 3] rotation of `cam_from_world`."""
        return self.cam_from_world[:3, :3]

    @property
    def translation(self) -> Array:
        """[3] translation of `cam_from_world`."""
        return self.cam_from_world[:3, 3]

    @property
    def centre(self) -> Array:
        """[3] projection centre in the world."""
        return -self.rotation.T @ self.translation

    def project(self, points: npt.NDArray[np.floating]) -> tuple[Array, Array]:
        """Project world points [N, 3] to pixels [N, 2] and depths [N]."""
        x, y, z = np.asarray(points, np.float64).T
        # Column by column: several times faster than with arrays of rows of two and three.
        u, v, depth = (a * x + b * y + c * z + t for a, b, c, t in self.cam_from_world[:3].tolist())
        safe = np.where(np.abs(depth) < 1e-12, 1e-12, depth)
        pixels = np.empty((len(depth), 2))
        pixels[:, 0] = u / safe * self.fx + self.cx
        pixels[:, 1] = v / safe * self.fy + self.cy
        return pixels, depth

    def shows(
        self, pixels: npt.NDArray[np.floating], depths: npt.NDArray[np.floating]
    ) -> npt.NDArray[np.bool_]:
        """Which projected places, pixels [..., 2] and depths [...], are ahead and in its image."""
        within = (pixels >= 0).all(-1) & (pixels < (self.width, self.height)).all(-1)
        return np.asarray(within & (depths > 0))

    def unproject(self, depth: npt.NDArray[np.floating]) -> Array:
        """Lift a depth map [H, W] (z, not ray length) to world points [H, W, 3]."""
        height, width = depth.shape
        z = np.asarray(depth, np.float64)
        across, down = (np.arange(n) + 0.5 for n in (width, height))
        x = (across - self.cx) / self.fx * z
        y = ((down - self.cy) / self.fy)[:, None] * z
        x, y, z = (value - t for value, t in zip((x, y, z), self.translation, strict=True))
        points = np.empty((height, width, 3))
        for axis, (a, b, c) in enumerate(self.rotation.T.tolist()):
            points[..., axis] = a * x + b * y + c * z
        return points

    def resized(self, width: int, height: int) -> Camera:
        """The same camera for an image resampled to `width` x `height`."""
        sx, sy = width / self.width, height / self.height
        return replace(
            self, width=width, height=height,
            fx=self.fx * sx, cx=self.cx * sx, fy=self.fy * sy, cy=self.cy * sy,
        )  # fmt: skip


@dataclass(frozen=True)
class Cameras(Artifact):
    """The cameras of the views that could be placed; a view without an entry here is unplaced.

    Attributes:
        cameras: one entry per placed view, in the order of the views.
        input_from_world: [4, 4] similarity from our world to the frame of known input (a COLMAP
            model, `transforms.json`, millimetres); identity where nothing is known.
        scale: the unit of the frame that `input_from_world` leads to, where it comes from, and how
            sure it is.
        given: the user gave the cameras; `input_from_world` leads to their world.
        mouth_from_world: [4, 4] rotation and shift (in our units) to the frame of the mouth
            (`pipeline.artifacts.space.frames`), where its teeth tell it.
        provisional: only chained together, without any optimisation; `align` improves them.
    """

    kind: ClassVar[str] = "cameras"
    cameras: tuple[Camera, ...]
    input_from_world: Array = field(default_factory=lambda: np.eye(4))
    scale: Scale = NO_SCALE
    given: bool = False
    mouth_from_world: Array | None = None
    provisional: bool = False

    @property
    def units(self) -> str:
        """``"mm"`` or ``"arbitrary"``."""
        return self.scale.units

    def __len__(self) -> int:
        return len(self.cameras)

    def by_name(self) -> dict[str, Camera]:
        return {camera.name: camera for camera in self.cameras}

    def save(self, folder: Path) -> None:
        reconstruction(self.cameras).write_text(str(folder))
        frame = {
            "units": self.units,
            "scale": self.scale.as_dict(),
            "input_from_world": self.input_from_world.tolist(),
            "given": self.given,
            "mouth_from_world": (
                None if self.mouth_from_world is None else self.mouth_from_world.tolist()
            ),
            "provisional": self.provisional,
        }
        text = json.dumps(frame, indent=1)
        (folder / "frame.json").write_text(text + "\n")

    @classmethod
    def load(cls, folder: Path) -> Self:
        cameras = read_colmap(folder)
        frame_file = folder / "frame.json"
        if not frame_file.exists():  # a model from elsewhere
            return cls(cameras=cameras)
        frame = json.loads(frame_file.read_text())
        # Before there was a record of the scale, a file said its unit alone.
        before = {"unit": "mm" if frame.get("units") == "mm" else "none"}
        mouth = frame.get("mouth_from_world")
        return cls(
            cameras=cameras,
            input_from_world=np.asarray(frame["input_from_world"], np.float64),
            scale=Scale.from_dict(frame.get("scale", before)),
            given=bool(frame.get("given", False)),
            mouth_from_world=None if mouth is None else np.asarray(mouth, np.float64),
            provisional=frame.get("provisional", False),
        )


def reconstruction(cameras: tuple[Camera, ...]):  # type: ignore[no-untyped-def]  # pycolmap has no types
    """Build a `pycolmap.Reconstruction` with one PINHOLE camera and one posed image per entry."""
    import pycolmap

    model = pycolmap.Reconstruction()
    for index, camera in enumerate(cameras, start=1):
        parameters = [camera.fx, camera.fy, camera.cx, camera.cy]
        lens = pycolmap.Camera(
            camera_id=index, model="PINHOLE",
            width=camera.width, height=camera.height, params=parameters,
        )  # fmt: skip
        model.add_camera_with_trivial_rig(lens)
        pose = pycolmap.Rigid3d(camera.cam_from_world[:3])
        image = pycolmap.Image(name=f"{camera.name}.png", camera_id=index, image_id=index)
        model.add_image_with_trivial_frame(image, pose)
    return model


def read_colmap(folder: Path) -> tuple[Camera, ...]:
    """Read the posed images of a COLMAP model (text or binary), in the order of their names.

    Raises:
        ValueError: a camera model with lens distortion, which a pinhole camera can't stand for.
    """
    import pycolmap

    model = pycolmap.Reconstruction(str(folder))
    cameras = []
    for image in sorted(model.images.values(), key=lambda item: item.name):
        if not image.has_pose:
            continue
        lens = model.cameras[image.camera_id]
        distortion = [lens.params[index] for index in lens.extra_params_idxs()]
        if any(abs(value) > 1e-12 for value in distortion):
            raise ValueError(
                f"{folder} uses the camera model {lens.model_name} with distortion; undistort the "
                "images first (colmap image_undistorter)."
            )
        cameras.append(
            Camera(
                name=Path(image.name).stem,
                width=lens.width,
                height=lens.height,
                fx=lens.focal_length_x,
                fy=lens.focal_length_y,
                cx=lens.principal_point_x,
                cy=lens.principal_point_y,
                cam_from_world=np.vstack([image.cam_from_world().matrix(), [0, 0, 0, 1]]),
            )
        )
    return tuple(cameras)
