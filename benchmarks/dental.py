"""The dental path against the truth: labels, cameras, surface, seconds.

    python benchmarks/dental.py --data DIR [--only 001,012,022] [--long-side 512] [--threads 2]

DIR holds `scan_video_a/` (exact cameras, `teeth.ply`) and, where there is one, `dental_photos_a/`
(cameras of reference only). Nothing here is known to the method: no focal length, no order.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import open3d

from pipeline.artifacts.cameras import Camera
from pipeline.artifacts.dental.fdi import teeth_of
from pipeline.artifacts.teeth import Dentition
from pipeline.artifacts.views import View
from pipeline.errors import ReconstructionError
from pipeline.geometry.rigid import angle_between, nearest_rotation
from pipeline.geometry.similarity import similarity
from stages.dentition.overlay import sheet
from stages.dentition.working import resized_dentition, working_view
from stages.init.dental.numbering.arch_options import ArchOptions
from stages.init.dental.reconstruct import Reconstruction, reconstruct_teeth
from stages.init.dental.solution import PlacedView
from stages.init.dental.surface.options import SurfaceOptions
from stages.init.sfm.matching.epipolar import fundamental_between, sampson_distance
from stages.teeth.choose import choose
from stages.teeth.reader import PhotographReader

Array = npt.NDArray[np.float64]

TRIPLES = (
    "001,012,022", "005,012,018", "004,011,019", "003,011,020", "002,011,021", "000,012,023",
    "005,012,023", "000,011,018", "001,009,020", "003,014,022",
)  # fmt: skip
PHOTOS = "0_right,1_frontal,2_left"
#: Of the video's frames, and the photographs' unless --long-side says otherwise.
SIZE = (512, 384)
#: Share of the pairs that an alignment is made of; the rest are outliers.
KEPT = 85
#: Relief is what is left of the mean over so much (mm), where it is no more than a step between
#: crowns, and where the surface is that of the same crown (mm).
RELIEF, STEEP, ELSEWHERE = 2.0, 1.5, 4.0


class Scan:
    """The scanned crowns: which tooth a ray meets, and how far a point is from them."""

    def __init__(self, path: Path) -> None:
        mesh = open3d.io.read_triangle_mesh(str(path))
        component, count, _ = mesh.cluster_connected_triangles()
        component, vertices = np.asarray(component), np.asarray(mesh.vertices)
        triangles = np.asarray(mesh.triangles)
        large = [k for k, size in enumerate(count) if size > 300]
        centres = np.array(
            [vertices[np.unique(triangles[component == k])].mean(axis=0) for k in large]
        )
        self._tooth_of = np.zeros(component.max() + 1, np.int64)
        above = centres[:, 1] > np.median(centres[:, 1])
        for chosen, jaw in ((above, "upper"), (~above, "lower")):
            mine = np.flatnonzero(chosen)
            back = centres[mine, 2].min() - 5
            angle = np.arctan2(centres[mine, 0] - centres[mine, 0].mean(), centres[mine, 2] - back)
            for number, tooth in zip(mine[np.argsort(angle)], teeth_of(jaw), strict=True):
                self._tooth_of[large[number]] = tooth
        self._component = component
        self._scene = open3d.t.geometry.RaycastingScene(nthreads=1)
        self._scene.add_triangles(
            open3d.core.Tensor(vertices.astype(np.float32)),
            open3d.core.Tensor(triangles.astype(np.uint32)),
        )

    def look(self, camera: Camera) -> tuple[npt.NDArray[np.int64], Array]:
        """[H, W] FDI number (0: none) and [H, W, 3] point that each pixel sees."""
        rays = self._scene.create_rays_pinhole(
            open3d.core.Tensor(camera.matrix), open3d.core.Tensor(camera.cam_from_world),
            camera.width, camera.height,
        )  # fmt: skip
        found = self._scene.cast_rays(rays, nthreads=1)
        far, rays = found["t_hit"].numpy(), rays.numpy().astype(np.float64)
        hit = np.isfinite(far)
        tooth = np.zeros(far.shape, np.int64)
        triangle = found["primitive_ids"].numpy()[hit].astype(np.int64)
        tooth[hit] = self._tooth_of[self._component[triangle]]
        return tooth, rays[..., :3] + rays[..., 3:] * np.where(hit, far, np.nan)[..., None]

    def nearest(self, points: Array) -> Array:
        """[N, 3] the nearest points of the scan."""
        query = open3d.core.Tensor(np.ascontiguousarray(points, np.float32))
        found = self._scene.compute_closest_points(query, nthreads=1)["points"]
        return np.asarray(found.numpy(), np.float64)


@dataclass(frozen=True)
class Case:
    """Photographs and their true (or reference) cameras."""

    name: str
    views: list[View]
    cameras: list[Camera]


def read_case(data: Path, names: str, long_side: int = SIZE[0]) -> Case:
    """Photographs of this long side; frames as they are."""
    size = (long_side, long_side * 3 // 4) if names == PHOTOS else SIZE
    cameras, views = [], []
    if names == PHOTOS:
        frames = json.loads((data / "dental_photos_a/transforms_reference.json").read_text())
    else:
        frames = json.loads((data / "scan_video_a/transforms.json").read_text())
    for number, name in enumerate(names.split(",")):
        if names == PHOTOS:
            frame = frames["frames"][name]
            matrix = np.array(frame["K"]) * long_side / 1024
            image = cv2.imread(str(data / f"dental_photos_a/images/{name}.jpg"))
        else:
            frame = next(f for f in frames["frames"] if Path(f["file_path"]).stem == name)
            focal = frames["fl_x"]
            matrix = np.array([[focal, 0, frames["cx"]], [0, focal, frames["cy"]], [0, 0, 1]])
            image = cv2.imread(str(data / "scan_video_a" / frame["file_path"]))
        if image.shape[1::-1] != size:
            image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
        pose = np.array(frame["w2c_opencv"])
        pose = pose if len(pose) == 4 else np.vstack([pose, [0, 0, 0, 1]])
        views.append(View(f"{number:03d}", image[..., ::-1].astype(np.float32) / 255))
        cameras.append(
            Camera(name, *size, matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2], pose)
        )
    return Case(names, views, cameras)


def read_teeth(case: Case, threads: int) -> list[Dentition | None]:
    """The crowns of each photograph as the stage `teeth` reads them; None: it is set aside."""
    working = [working_view(view) for view in case.views]
    readings = PhotographReader(working, threads).read(lambda *_: None)
    images = [view.image for view in working]
    chosen = choose(readings, images, case.name.split(","))
    return [
        None if d.set_aside or not d.all_crowns else resized_dentition(d, (v.width, v.height))
        for d, v in zip(chosen, case.views, strict=True)
    ]


def count_labels(case: Case, scan: Scan, teeth: Reconstruction) -> tuple[int, int, int]:
    """Crowns labelled right, wrong, and left without a number. Those at the row's ends are out."""
    right = wrong = none = 0
    for camera, dentition, placed in zip(
        case.cameras, teeth.dentitions, teeth.fit.views, strict=True
    ):
        if dentition is None or placed is None:
            continue
        truth, _ = scan.look(camera)
        for jaw in ("upper", "lower"):
            for crown, label in zip(dentition.crowns(jaw), placed.teeth(jaw), strict=True):
                inside = truth[_middle_of(crown, truth.shape)]
                inside = inside[(inside > 0) & ((inside < 30) == (jaw == "upper"))]
                if crown.cut_left or crown.cut_right or not len(inside):
                    continue
                true = int(np.bincount(inside).argmax())
                right += label == true
                none += label == 0
                wrong += label not in (true, 0)
    return right, wrong, none


def _middle_of(crown, shape):  # type: ignore[no-untyped-def]
    """The middle half of a crown as slices."""
    ends = np.stack([crown.zenith, 0.5 * (crown.zenith + crown.tip)])
    rows = np.sort(ends[:, 1]).astype(int)
    column = int(crown.zenith[0])
    reach = max(int(0.25 * crown.width), 1)
    return slice(max(rows[0], 0), min(rows[1] + 1, shape[0])), slice(
        max(column - reach, 0), min(column + reach + 1, shape[1])
    )


def rotation_errors(case: Case, placed: tuple[PlacedView | None, ...]) -> Array:
    """Degrees per view after the one rotation that fits best."""
    pairs = [(v.cam_from_world[:3, :3], c.rotation)
             for v, c in zip(placed, case.cameras, strict=True) if v is not None]  # fmt: skip
    turn = nearest_rotation(np.sum([truth.T @ found for found, truth in pairs], axis=0))
    return np.array([angle_between(found, truth @ turn) for found, truth in pairs])


def focal_errors(case: Case, placed: tuple[PlacedView | None, ...]) -> list[float]:
    """Percent by which each focal length found is longer than the true (or reference) one."""
    return [
        100 * (view.focal / float(np.sqrt(camera.fx * camera.fy)) - 1)
        for view, camera in zip(placed, case.cameras, strict=True)
        if view is not None
    ]


def epipolar_errors(case: Case, teeth: Reconstruction) -> tuple[float, float]:
    """Median Sampson distance in pixels of landmarks seen in two neighbouring photographs, under
    the cameras found and under the true (or reference) ones."""
    seen = [
        _landmarks(dentition, placed)
        for dentition, placed in zip(teeth.dentitions, teeth.fit.views, strict=True)
    ]
    found: list[Array] = []
    truth: list[Array] = []
    for i in range(len(seen) - 1):
        shared = sorted(set(seen[i]) & set(seen[i + 1]))
        ends = [np.array([seen[k][name] for name in shared]).reshape(-1, 2) for k in (i, i + 1)]
        ours = [_camera(teeth, k) for k in (i, i + 1)]
        found.append(sampson_distance(fundamental_between(*ours), *ends))
        truth.append(sampson_distance(fundamental_between(*case.cameras[i : i + 2]), *ends))
    return float(np.median(np.concatenate(found))), float(np.median(np.concatenate(truth)))


def _landmarks(dentition: Dentition, placed: PlacedView) -> dict[tuple[str, int], Array]:
    """Zeniths and papillae by tooth."""
    found: dict[tuple[str, int], Array] = {}
    for jaw in ("upper", "lower"):
        for crown, tooth in zip(dentition.crowns(jaw), placed.teeth(jaw), strict=True):
            if tooth and not (crown.cut_left or crown.cut_right or crown.doubtful):
                found["zenith", tooth] = crown.zenith
            if tooth and crown.papilla_right is not None:
                found["papilla", tooth] = crown.papilla_right
    return found


def _camera(teeth: Reconstruction, number: int) -> Camera:
    placed, view = teeth.fit.views[number], teeth.views[number]
    assert placed is not None
    size = (view.width, view.height)
    centre = (size[0] / 2, size[1] / 2)
    return Camera("", *size, placed.focal, placed.focal, *centre, placed.cam_from_world)


def surface_scores(
    case: Case, scan: Scan, teeth: Reconstruction
) -> tuple[float, float, float, float]:
    """Median and 90 % of the distance of tooth depths to the scan after similarity and ICP, mm;
    share within 1 mm; share of the tooth pixels that have depth."""
    seen = list(_seen(case, scan, teeth))
    covered, shown = sum(int(s.both.sum()) for s in seen), sum(s.shown for s in seen)
    source = np.concatenate([s.found[s.both] for s in seen])
    target = np.concatenate([s.truth[s.both] for s in seen])
    drawn = np.random.default_rng(0).permutation(len(source))[:15_000]
    motion = _aligned(source, target)
    for _ in range(25):
        nearest = scan.nearest(_moved(source[drawn], motion))
        motion = _best(source[drawn], nearest, motion)
    placed_points = _moved(source, motion)
    distance = np.linalg.norm(scan.nearest(placed_points) - placed_points, axis=1)
    return (
        float(np.median(distance)), float(np.percentile(distance, 90)),
        float(np.mean(distance < 1)), covered / shown,
    )  # fmt: skip


def relief_scores(case: Case, scan: Scan, teeth: Reconstruction) -> tuple[float, float]:
    """How much of the crowns' relief is there (1: all of it), and by how much it is off (RMS, mm).

    Relief is how far a pixel's point is from the camera, less the mean of some 2 mm around it.
    """
    seen = list(_seen(case, scan, teeth))
    motion = _aligned(
        np.concatenate([s.found[s.both] for s in seen]),
        np.concatenate([s.truth[s.both] for s in seen]),
    )
    found, truth = [], []
    for s in seen:
        points = _moved(s.found.reshape(-1, 3), motion).reshape(s.found.shape)
        ours, true = (np.linalg.norm(p - s.camera.centre, axis=-1) for p in (points, s.truth))
        near = s.both & (np.abs(ours - true) < ELSEWHERE)
        reach = RELIEF * s.camera.fx / float(np.median(true[near]))
        ours, true = (_less_mean(distance, near, reach) for distance in (ours, true))
        kept = near & (np.abs(true) < STEEP)
        found.append(ours[kept])
        truth.append(true[kept])
    one, other = np.concatenate(found), np.concatenate(truth)
    return float(one @ other / (other @ other)), float(np.sqrt(np.mean((one - other) ** 2)))


def _less_mean(values: Array, mask: npt.NDArray[np.bool_], reach: float) -> Array:
    """Values [H, W] less their Gaussian mean within a mask."""
    total = cv2.GaussianBlur(np.where(mask, values, 0), (0, 0), reach)
    weight = cv2.GaussianBlur(mask.astype(np.float64), (0, 0), reach)
    return np.asarray(values - total / np.maximum(weight, 1e-9))


@dataclass(frozen=True)
class Seen:
    """What a photograph shows: points [H, W, 3] found and true, where there are both, and on how
    many pixels it shows teeth."""

    camera: Camera
    found: Array
    truth: Array
    both: npt.NDArray[np.bool_]
    shown: int


def _seen(case: Case, scan: Scan, teeth: Reconstruction) -> Iterator[Seen]:
    for number, (camera, view, dentition) in enumerate(
        zip(case.cameras, teeth.surface.views, teeth.dentitions, strict=True)
    ):
        if view is None or dentition is None or teeth.fit.views[number] is None:
            continue
        ids, points = scan.look(camera)
        tooth = _tooth_pixels(case, ids, dentition)
        both = tooth & (view.depth > 0) & np.isfinite(points[..., 0])
        found = _camera(teeth, number).unproject(view.depth)
        yield Seen(camera, found, points, both, int(tooth.sum()))


def _tooth_pixels(case, ids, dentition):  # type: ignore[no-untyped-def]
    """Where the photograph shows teeth: by the scan where the camera is exact, else as found."""
    tooth = dentition.mask if case.name == PHOTOS else ids > 0
    return cv2.erode(tooth.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0


def _moved(points: Array, motion: tuple[float, Array, Array]) -> Array:
    return motion[0] * points @ motion[1].T + motion[2]


def _aligned(source: Array, target: Array) -> tuple[float, Array, Array]:
    """The similarity that brings most of the pairs together."""
    motion = similarity(source, target, np.ones(len(source)))
    for _ in range(5):
        motion = _best(source, target, motion)
    return motion


def _best(source, target, motion):  # type: ignore[no-untyped-def]
    """The similarity of the pairs that the last one brings nearest."""
    error = np.linalg.norm(_moved(source, motion) - target, axis=1)
    kept = error < np.percentile(error, KEPT)
    return similarity(source[kept], target[kept], np.ones(int(kept.sum())))


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--data", type=Path, required=True, help="holds scan_video_a")
    parser.add_argument("--only", default="", help="one set, as 001,012,022 or 'photos'")
    parser.add_argument("--long-side", type=int, default=SIZE[0], help="of the photographs, pixels")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--pictures", type=Path, help="where to write the pictures")
    options = parser.parse_args()
    if not (options.data / "scan_video_a" / "teeth.ply").is_file():
        sys.exit(f"{options.data} has no scan_video_a/teeth.ply.")
    scan = Scan(options.data / "scan_video_a" / "teeth.ply")
    sets = [*TRIPLES, PHOTOS] if (options.data / "dental_photos_a").is_dir() else [*TRIPLES]
    if options.only:
        sets = [PHOTOS if options.only == "photos" else options.only]
    print(
        "| set | labels right / wrong / none | margin | rotation, degrees | focal off, % | "
        "epipolar error of landmarks, px: found / truth | surface median / p90, "
        "mm | within 1 mm | covered | relief: share / off, mm | CPU s | wall s |"
    )
    print("|---|---|---|---|---|---|---|---|---|---|---|---|")
    for names in sets:
        case = read_case(options.data, names, options.long_side)
        cpu, wall = time.process_time(), time.perf_counter()
        try:
            teeth = reconstruct_teeth(
                case.views, names.split(","), read_teeth(case, options.threads),
                [None] * len(case.views), ArchOptions(), SurfaceOptions(), accept_doubtful=False,
                threads=options.threads, progress=lambda *_: None,
            )  # fmt: skip
        except ReconstructionError as error:
            print(f"| {names} | {error} |")
            continue
        cpu, wall = time.process_time() - cpu, time.perf_counter() - wall
        labels = " / ".join(map(str, count_labels(case, scan, teeth)))
        errors = " ".join(f"{error:.1f}" for error in rotation_errors(case, teeth.fit.views))
        focals = " ".join(f"{error:+.0f}" for error in focal_errors(case, teeth.fit.views))
        epipolar = " / ".join(f"{error:.1f}" for error in epipolar_errors(case, teeth))
        median, most, within, covered = surface_scores(case, scan, teeth)
        share, off = relief_scores(case, scan, teeth)
        cells = (
            names, labels, f"{teeth.fit.margin:.0f}", errors, focals, epipolar,
            f"{median:.3f} / {most:.2f}", f"{100 * within:.0f} %", f"{100 * covered:.1f} %",
            f"{share:.2f} / {off:.3f}", f"{cpu:.1f}", f"{wall:.1f}",
        )  # fmt: skip
        print(f"| {' | '.join(cells)} |", flush=True)
        if options.pictures:
            options.pictures.mkdir(parents=True, exist_ok=True)
            shown = {"teeth": sheet(list(teeth.labelled.values())), "turned": teeth.turned}
            for name, picture in shown.items():
                path = options.pictures / f"{names.replace(',', '_')}_{name}.png"
                cv2.imwrite(str(path), picture[..., ::-1])


if __name__ == "__main__":
    main()
