"""What teeth did and where the second visit's cameras stood, from spots seen in both visits.

The first visit is the world. Each camera of the second is placed in it by the teeth that did not
move; a tooth's motion is a rigid one. All unknowns are found together, by Gauss-Newton steps on the
distances between where spots are seen and where they should be.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from pipeline.artifacts.cameras import Camera
from pipeline.geometry.rigid import exponential, moved_by, nearest_rotation
from pipeline.studies.register.pictures.matching import Spots

Array = npt.NDArray[np.float64]

#: Residuals beyond this many pixels count less (Huber).
HUBER = 0.7
#: Unknowns of a tooth (shift mm, turn rad) and of a camera (the same, log of the focal length).
TOOTH, CAMERA = 6, 7
#: How far a camera's focal length may be off, as a share.
FOCAL = 0.01
#: Lever that turns are weighed against shifts with: half a crown, mm.
LEVER = 4.0


@dataclass(frozen=True)
class State:
    """Attributes:
    motions: FDI number -> [4, 4] what the tooth did, in the first visit's frame, mm.
    cameras: of the second visit, in that frame.
    """

    motions: Mapping[int, Array]
    cameras: tuple[Camera, ...]


@dataclass(frozen=True)
class Block:
    """Normal equations of one tooth in one pair of photographs.

    Attributes:
        tooth, first, second: as in `Spots`.
        matrix, vector: [13, 13], [13] of tooth (6) and camera (7).
        weight: its number of spots.
    """

    tooth: int
    first: int
    second: int
    matrix: Array
    vector: Array
    weight: float


def blocks_of(spots: Iterable[Spots], state: State, centres: Mapping[int, Array]) -> list[Block]:
    """Linearise the spots of several teeth and pairs of photographs (see `block_of`)."""
    return [
        block_of(s, state.motions[s.tooth], state.cameras[s.second], centres[s.tooth])
        for s in spots
    ]


def block_of(spots: Spots, motion: Array, camera: Camera, centre: Array) -> Block:
    """Linearise: the tooth turns about `centre` [3] (as it was), the camera about itself."""
    world = spots.points @ motion[:3, :3].T + motion[:3, 3]
    about = world - (motion[:3, :3] @ centre + motion[:3, 3])
    local = world @ camera.rotation.T + camera.translation
    x, y, z = local.T
    focal = np.array([camera.fx, camera.fy])
    flat = local[:, :2] / z[:, None]
    zero = np.zeros_like(x)
    lens = np.stack(
        [
            np.stack([focal[0] / z, zero, -focal[0] * x / z**2], -1),
            np.stack([zero, focal[1] / z, -focal[1] * y / z**2], -1),
        ],
        1,
    )  # [N, 2, 3]
    by_world = lens @ camera.rotation
    jacobian = np.empty((len(x), 2, TOOTH + CAMERA))
    jacobian[..., :3] = by_world
    jacobian[..., 3:6] = -by_world @ _skews(about)
    jacobian[..., 6:9] = lens
    jacobian[..., 9:12] = -lens @ _skews(local)
    jacobian[..., 12] = flat * focal
    off = spots.pixels - (flat * focal + (camera.cx, camera.cy))
    size = np.linalg.norm(off, axis=1)
    weight = np.minimum(1, HUBER / np.maximum(size, 1e-9))
    information = weight[:, None, None] * spots.information
    pulled = (information @ jacobian).reshape(-1, TOOTH + CAMERA)
    return Block(
        spots.tooth, spots.first, spots.second,
        jacobian.reshape(-1, TOOTH + CAMERA).T @ pulled, pulled.T @ off.ravel(),
        float(weight.sum()),
    )  # fmt: skip


def _skews(points: Array) -> Array:
    """[N, 3, 3] matrices of the cross products with points [N, 3]."""
    made = np.zeros((len(points), 3, 3))
    x, y, z = points.T
    made[:, 0, 1], made[:, 0, 2], made[:, 1, 2] = -z, y, -x
    made[:, 1, 0], made[:, 2, 0], made[:, 2, 1] = z, -y, x
    return made


@dataclass(frozen=True)
class Pull:
    """What is known of a tooth besides: its displacement [6], and how sure that is [6, 6]."""

    tooth: int
    information: Array
    goal: Array


@dataclass(frozen=True)
class System:
    """The normal equations of everything: first the teeth, then the cameras.

    Attributes:
        teeth: FDI numbers, in the order of their unknowns.
        matrices, vectors: [C, U, U], [C, U]: what each camera's photograph contributes.
    """

    teeth: tuple[int, ...]
    matrices: Array
    vectors: Array

    def place(self, tooth: int) -> slice:
        """Where a tooth's unknowns are."""
        start = TOOTH * self.teeth.index(tooth)
        return slice(start, start + TOOTH)


def system_of(blocks: Sequence[Block], cameras: int) -> System:
    """Put blocks, linearised at one state, together; focal lengths are held loosely."""
    teeth = tuple(sorted({block.tooth for block in blocks}))
    start = TOOTH * len(teeth)
    size = start + CAMERA * cameras
    system = System(teeth, np.zeros((cameras, size, size)), np.zeros((cameras, size)))
    for block in blocks:
        tooth = system.place(block.tooth)
        camera = slice(start + CAMERA * block.second, start + CAMERA * (block.second + 1))
        matrix, vector = system.matrices[block.second], system.vectors[block.second]
        matrix[tooth, tooth] += block.matrix[:TOOTH, :TOOTH]
        matrix[tooth, camera] += block.matrix[:TOOTH, TOOTH:]
        matrix[camera, tooth] += block.matrix[TOOTH:, :TOOTH]
        matrix[camera, camera] += block.matrix[TOOTH:, TOOTH:]
        vector[tooth] += block.vector[:TOOTH]
        vector[camera] += block.vector[TOOTH:]
    for k in range(cameras):
        focal = start + CAMERA * k + CAMERA - 1
        system.matrices[k, focal, focal] += 1 / FOCAL**2
    return system


def solved(
    system: System,
    matrix: Array,
    vector: Array,
    pulls: Sequence[Pull],
    drift: Mapping[int, Array],
) -> tuple[Array, Array]:
    """[U] step of all unknowns, and the matrix [U, U] of the equations.

    Args:
        system: says which unknown is what.
        matrix, vector: the sum over the photographs that are to count.
        pulls: what else is known of the teeth.
        drift: FDI number -> [6] the displacement of each tooth at the state.
    """
    matrix, vector = matrix.copy(), vector.copy()
    for pull in pulls:
        at = system.place(pull.tooth)
        matrix[at, at] += pull.information
        vector[at] += pull.information @ (pull.goal - drift[pull.tooth])
    diagonal = np.einsum("ii->i", matrix)
    # What no photograph says anything about stays where it is.
    diagonal += 1e-7 * diagonal + 1e-9 * max(float(diagonal.max()), 1e-12)
    return np.asarray(np.linalg.solve(matrix, vector), np.float64), matrix


def moved_tooth(motion: Array, change: Array, centre: Array) -> Array:
    """[4, 4] a motion after a step [6]: shift, and turn about where the centre [3] is now."""
    turn, _ = exponential(np.concatenate([np.zeros(3), change[3:]]))
    now = motion[:3, :3] @ centre + motion[:3, 3]
    result = np.eye(4)
    result[:3, :3] = nearest_rotation(turn @ motion[:3, :3])
    result[:3, 3] = now + change[:3] - result[:3, :3] @ centre
    return result


def moved_view(camera: Camera, change: Array) -> Camera:
    """A camera after a step [7]."""
    zoom = float(np.exp(np.clip(change[6], -0.05, 0.05)))
    pose = moved_by(change[:6], camera.cam_from_world)
    return replace(camera, cam_from_world=pose, fx=camera.fx * zoom, fy=camera.fy * zoom)


def displacement(motion: Array, centre: Array) -> Array:
    """[6] of a motion: shift of the centre [3] (mm) and rotation vector (rad)."""
    from scipy.spatial.transform import Rotation

    shift = motion[:3, :3] @ centre + motion[:3, 3] - centre
    return np.concatenate([shift, Rotation.from_matrix(motion[:3, :3]).as_rotvec()])


def travel(change: Array) -> float:
    """How far a crown's points go by a displacement [6], mm: root mean square."""
    lever = np.sqrt(2 / 3) * LEVER
    return float(np.hypot(np.linalg.norm(change[:3]), lever * np.linalg.norm(change[3:])))
