"""Generated mouths in photographs with exact outlines, numbers, cameras and depth, and what is true
of them by their own meshes: for what `stages.export.measuring` says.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from data_samples.mouths import Mouth
from data_samples.mouths.cameras import Camera as TrueCamera
from data_samples.mouths.cameras import look
from data_samples.mouths.rays import cast, ray_scene
from pipeline.artifacts.cameras import Camera
from pipeline.artifacts.dental.fdi import is_left, is_upper
from pipeline.artifacts.teeth import Crown, Dentition, filled
from stages.dentition.crowns import dentition_of
from stages.export.measuring.places import with_primary
from tests.stages.mouth_case import outlines_of

#: Degrees from the patient's left, and from above.
YAWS = ((-42.0, 4.0), (3.0, 4.0), (40.0, 4.0))


def photographed(
    mouth: Mouth, angles: tuple[tuple[float, float], ...] = YAWS, size: tuple[int, int] = (640, 480)
) -> tuple[list[Dentition], list[Camera], list[np.ndarray]]:
    """Exact outlines with true numbers, cameras and depth, from some yaws and pitches.

    Args:
        mouth: what is photographed.
        angles: yaw and pitch of each photograph, degrees.
        size: width, height of the photographs.
    """
    width, height = size
    scene = ray_scene((mouth.vertices, mouth.triangles))
    dentitions, cameras, depths = [], [], []
    for k, (yaw, pitch) in enumerate(angles):
        focal = 1.9 * width
        pose = look(yaw, pitch, 2.0, 125.0, mouth.pivot)
        true = TrueCamera(width, height, focal, focal, width / 2, height / 2, pose)
        v, u = np.mgrid[:height, :width] + 0.5
        hit = cast(scene, true.rays(np.stack([u, v], -1).reshape(-1, 2)))
        seen = np.isfinite(hit["t_hit"])
        labels = np.zeros(width * height, np.uint8)
        labels[seen] = mouth.fdi[mouth.triangles[hit["primitive_ids"][seen], 0]]
        depth = np.where(seen, hit["t_hit"], 0).reshape(height, width)
        labels = labels.reshape(height, width)
        # 18 etc. are no numbers of ours
        read = dentition_of(outlines_of(labels, tell=False), f"{k:03d}", (width, height), "front")
        dentitions.append(numbered(read, labels))
        cameras.append(
            Camera(f"{k:03d}", width, height, focal, focal, width / 2, height / 2,
                   true.cam_from_world)
        )  # fmt: skip
        depths.append(depth)
    return dentitions, cameras, depths


def numbered(read: Dentition, labels: np.ndarray) -> Dentition:
    def named(crown: Crown) -> Crown:
        inside = labels[filled((crown,), read.size)]
        return replace(crown, number=int(np.bincount(inside[inside > 0]).argmax()), doubt=0.001)

    return replace(read, upper=tuple(map(named, read.upper)), lower=tuple(map(named, read.lower)))


def truth(mouth: Mouth) -> dict[str, float]:
    """The same values from the crowns' own meshes (mm; x left, y up, z out), where there are the
    teeth for them: permanent, or the primary ones that stand in their places."""
    teeth = {tooth.plan.fdi: tooth for tooth in mouth.teeth}

    def tip(n: int) -> np.ndarray:
        """Middle of the biting edge, where it turns into the outer face."""
        tooth = teeth[n]
        ends = tooth.vertices[:, 1] * (-1 if is_upper(n) else 1)
        edge = tooth.vertices[ends >= ends.max() - 0.5]
        out = edge @ tooth.outward
        return edge[out >= out.max() - 0.2].mean(0)

    def face(n: int, height: float) -> float:
        """How far out the outer face of a lower tooth reaches at a height, or at its edge."""
        v = teeth[n].vertices
        height = min(height, v[:, 1].max() - 0.4)
        return float(v[abs(v[:, 1] - height) < 0.4][:, 2].max())

    def meet(pair: list[int]) -> float:
        ends = []
        for n in pair:
            tooth, side = teeth[n], -1 if is_left(n) else 1
            low = tooth.vertices[tooth.local[:, 1] < 0.35 * tooth.plan.height]
            ends.append(side * (side * low[:, 0]).max())
        return float(np.mean(ends))

    def there(*group: int) -> list[int]:
        return [m for n in group for m in with_primary((n,)) if m in teeth]

    values = {}
    upper, lower = there(11, 21), there(31, 41)
    if upper and lower:
        above, below = (np.mean([tip(n) for n in pair], axis=0) for pair in (upper, lower))
        level = min(above[1], below[1])
        values["overjet"] = above[2] - float(np.mean([face(n, level - 0.4) for n in lower]))
        values["overbite"] = below[1] - above[1]
        if len(upper) == len(lower) == 2:
            values["midline_shift"] = meet(lower) - meet(upper)
    for name, canines, molars in (("upper", (13, 23), (16, 26)), ("lower", (43, 33), (46, 36))):
        if len(pair := there(*canines)) == 2:
            values[f"intercanine_{name}"] = float(np.linalg.norm(tip(pair[0]) - tip(pair[1])))
        if len(pair := there(*molars)) == 2:
            ends = [teeth[n].labial for n in pair]
            values[f"intermolar_{name}"] = float(np.linalg.norm(ends[0] - ends[1]))
    return values
