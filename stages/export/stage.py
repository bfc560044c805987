"""The stage `export`: files that leave the workspace, for viewers, printers and other programs."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
import numpy.typing as npt
from pydantic import Field

from pipeline.artifacts.confidence import FILLED
from pipeline.errors import ReconstructionError
from pipeline.installed import library_version
from pipeline.stage import Parts, Stage, StageConfig, StageContext

if TYPE_CHECKING:
    from pipeline.artifacts.teeth import Teeth
    from pipeline.artifacts.views import Views
    from stages.export.mesh.surface import Mesh
    from stages.export.scene import Scene


class ExportConfig(StageConfig):
    frame: Literal["input", "world"] = Field(
        "input",
        description="frame of all exports: input (that of given cameras or of a known scale, where "
        "there is one) or world (the reconstruction's own)",
    )
    colmap: bool = Field(True, description="write the COLMAP model and transforms.json")
    colmap_points: int = Field(
        50_000, ge=0, le=2_000_000, description="points in the COLMAP model and points.ply, at most"
    )
    mesh: bool = Field(True, description="write mesh.ply and mesh.stl")
    mesh_method: Literal["tsdf", "poisson"] = Field(
        "tsdf",
        description="tsdf: fuse depth rendered from the Gaussians; poisson: surface through the "
        "points",
    )
    mesh_faces: int = Field(60_000, ge=100, le=5_000_000, description="triangles, at most")
    mesh_resolution: int = Field(
        256, ge=32, le=1024, description="voxels across what a photograph shows"
    )
    mesh_cell: Literal[1, 2, 4, 8] = Field(
        2, description="edge of the mesh's cells in voxels; finer detail is evened out"
    )
    mesh_views: int = Field(
        12, ge=0, le=500, description="viewpoints between the photographs that are fused as well"
    )
    mesh_depth: float = Field(
        2.0,
        gt=0,
        le=100,
        description="the mesh reaches this far behind the scene's centre, in half widths of what a "
        "photograph shows",
    )
    mesh_confidence: float = Field(
        FILLED,
        ge=0,
        description="only points with a confidence above this support the mesh: up to it their "
        "depth was filled in, not measured",
    )
    video: bool = Field(True, description="write orbit.mp4")
    video_seconds: float = Field(8.0, ge=0.5, le=120, description="length of one loop")
    video_fps: int = Field(25, ge=1, le=60, description="frames per second")
    video_crf: int = Field(20, ge=0, le=51, description="x264 quality: smaller is better, larger")
    video_sway: float = Field(2.0, ge=0, le=30, description="rise and fall on the way, in degrees")
    viewer: bool = Field(True, description="write viewer.html")
    viewer_photos: bool = Field(
        True, description="embed the photographs in the page, for thumbnails and comparison"
    )
    viewer_photo_quality: int = Field(80, ge=10, le=100, description="their JPEG quality")
    viewer_sh_degree: int = Field(
        3, ge=0, le=3, description="highest spherical-harmonics degree that the page carries"
    )
    preview: bool = Field(True, description="write preview.png")


class ExportStage(Stage):
    """Writes splats, COLMAP model, nerfstudio cameras, mesh, video, viewer page and preview."""

    name = "export"
    version = 4
    summary = "viewer page, splats, mesh, video, COLMAP model, nerfstudio cameras and the teeth"
    Config = ExportConfig
    requires = ("views", "cameras", "gaussians")
    optional = ("points", "teeth")
    provides = ("exports",)
    rehearsals = ("stages.export.rehearsal:surface", "stages.export.rehearsal:film")
    libraries = (
        "av",
        "numba",
        "numpy",
        "open3d",
        "opencv-contrib-python-headless",
        "pillow",
        "pycolmap",
        "pymeshlab",
        "scipy",
    )

    def report(self) -> Parts:
        from stages.export.report import PARTS

        return PARTS

    def run(self, context: StageContext) -> None:
        from pipeline.artifacts.gaussians import write_gaussians_ply
        from stages.export.mesh.building import build_mesh
        from stages.export.mesh.files import write_mesh_ply, write_stl
        from stages.export.scene import assemble

        config: ExportConfig = context.config
        views, cameras = context.load("views"), context.load("cameras")
        if not len(cameras):
            raise ReconstructionError(
                "There is nothing to export: none of the photographs could be placed."
            )
        scene = assemble(
            views,
            cameras,
            context.load("gaussians"),
            context.load("points") if context.has("points") else None,
            cameras.input_from_world if config.frame == "input" else np.eye(4),
            context.threads,
            context.progress,
        )
        units = cameras.units if config.frame == "input" else "arbitrary"
        folder = context.output("exports")
        counts = {
            "photographs": len(views),
            "placed_photographs": len(scene.cameras),
            "gaussians": len(scene.gaussians),
        }
        skipped: dict[str, str] = {}
        write_gaussians_ply(folder / "splats.ply", scene.gaussians)
        if config.colmap:
            counts["colmap_points"] = _write_cameras(context, scene, folder, units)
        if context.has("teeth"):
            counts |= _write_teeth(context, views, scene, folder, config.frame, units)
        mesh = None
        if config.mesh:
            mesh = build_mesh(
                scene, config.mesh_method, config.mesh_resolution, config.mesh_cell,
                config.mesh_views, config.mesh_depth, config.mesh_confidence, config.mesh_faces,
                context.progress,
            )  # fmt: skip
            context.progress("mesh", 1, 1)
        frames = _write_video(context, scene, folder) if config.video else None
        page_bytes = _write_page(context, scene, folder) if config.viewer else 0
        if mesh is not None:
            write_mesh_ply(folder / "mesh.ply", mesh)
            write_stl(folder / "mesh.stl", mesh)
            counts["mesh_faces"] = len(mesh)
        elif config.mesh:
            skipped["mesh.ply, mesh.stl"] = "too little surface for a mesh"
            context.warn(
                "No mesh was made: too little of the surface is known. More photographs that "
                "overlap would help; the other exports are complete."
            )
        if frames is not None:
            counts["video_frames"] = frames
        if config.preview:
            _write_preview(context, scene, mesh, folder)
        _describe(scene, folder, config.frame, units, counts, skipped, self.libraries)
        context.summarize(
            splats=len(scene.gaussians),
            mesh_faces=counts.get("mesh_faces", 0),
            page_mb=round(page_bytes / 1e6, 2),
        )


def _write_cameras(context: StageContext, scene: Scene, folder: Path, units: str) -> int:
    """COLMAP model with its images, `points.ply`, `transforms.json`; returns the points written."""
    from pipeline.artifacts.views import to_uint8
    from stages.export import models
    from stages.export.scene import thinned

    context.progress("COLMAP model", 0, 1)
    for camera in scene.cameras:
        _write_image(folder / "colmap" / "images" / f"{camera.name}.png", scene.photos[camera.name])
        if scene.masked:
            mask = np.where(scene.masks[camera.name], np.uint8(255), np.uint8(0))
            _write_image(folder / "colmap" / "masks" / f"{camera.name}.png.png", mask)
    cloud = thinned(scene.points, context.config.colmap_points, context.seed)
    colors = to_uint8(cloud.colors)
    model = folder / "colmap" / "sparse" / "0"
    model.mkdir(parents=True)
    depths = [view.depth for view in scene.seen]
    count = models.write_colmap(model, scene.cameras, cloud.positions, colors, depths)
    models.write_cloud(folder / "points.ply", cloud.positions, colors)
    notes = {"dentalsplat_units": units}
    transforms = models.nerfstudio_transforms(scene.cameras, scene.masked, notes)
    models.write_json(folder / "transforms.json", transforms)
    context.progress("COLMAP model", 1, 1)
    return count


def _write_teeth(
    context: StageContext, views: Views, scene: Scene, folder: Path, frame: str, units: str
) -> dict[str, int]:
    """`teeth.json`, if there are teeth; returns their count, if so."""
    from stages.export.models import write_json
    from stages.export.teeth import describe_teeth

    teeth: Teeth = context.load("teeth")
    if not teeth.chosen:
        return {}
    found = describe_teeth(
        teeth, views, scene.cameras, scene.seen, _frame_name(scene, frame), units
    )
    write_json(folder / "teeth.json", found)
    return {"teeth": len(found["teeth"])}


def _write_image(path: Path, pixels: npt.NDArray[np.uint8]) -> None:
    from pipeline.artifacts.views import write_png

    path.parent.mkdir(parents=True, exist_ok=True)
    write_png(path, pixels)


def _write_video(context: StageContext, scene: Scene, folder: Path) -> int:
    from stages.export.page import rasterizer_constants
    from stages.export.pictures.frames import FramePainter
    from stages.export.pictures.video import Video

    config: ExportConfig = context.config
    places, place_of_frame = scene.path(config.video_seconds, config.video_fps, config.video_sway)
    last = {place: index for index, place in enumerate(place_of_frame)}
    near = rasterizer_constants(scene.gaussians, scene.cameras)["near"]
    paint = FramePainter(scene.gaussians, near, context.threads)
    size = (places[0].width, places[0].height)
    kept: dict[int, npt.NDArray[np.uint8]] = {}  # what the way back shows again
    file = folder / "orbit.mp4"
    with Video(file, size, config.video_fps, config.video_crf, context.threads > 1) as video:
        for index, place in enumerate(place_of_frame):
            context.progress("video", index, len(place_of_frame))
            frame = kept.pop(place) if place in kept else paint(places[place])
            video.add(frame)
            if index < last[place]:
                kept[place] = frame
    return len(place_of_frame)


def _write_page(context: StageContext, scene: Scene, folder: Path) -> int:
    from stages.export.page import build_page, rasterizer_constants

    config: ExportConfig = context.config
    context.progress("viewer page", 0, 1)
    page = build_page(
        scene.gaussians, scene.cameras, scene.orbit,
        scene.photos if config.viewer_photos else {},
        rasterizer_constants(scene.gaussians, scene.cameras),
        config.viewer_sh_degree, config.viewer_photo_quality,
    )  # fmt: skip
    context.progress("viewer page", 1, 1)
    return (folder / "viewer.html").write_bytes(page.encode())


def _write_preview(
    context: StageContext,
    scene: Scene,
    mesh: Mesh | None,
    folder: Path,
) -> None:
    from pipeline.artifacts.views import to_uint8
    from stages.export.pictures.preview import beside, contact_sheet, panel_size, shade_mesh

    context.progress("preview", 0, 1)
    middle = scene.orbit.middle()
    camera = panel_size(scene.cameras[middle])
    novel = beside(camera, scene.novel_camera())
    panels = [
        ("input photograph", scene.photos[scene.cameras[middle].name]),
        ("3D Gaussians, same viewpoint", to_uint8(scene.seen[middle].image)),
        ("3D Gaussians, new viewpoint", scene.picture(novel)),
    ]
    if mesh is not None:
        panels.append(("mesh, new viewpoint", shade_mesh(mesh, novel)))
    _write_image(folder / "preview.png", contact_sheet(panels, camera.width, camera.height))
    context.progress("preview", 1, 1)


def _frame_name(scene: Scene, frame: str) -> str:
    """What the frame of the exports is called: "world" where no other is known."""
    return "world" if np.array_equal(scene.frame_from_world, np.eye(4)) else frame


def _describe(
    scene: Scene,
    folder: Path,
    frame: str,
    units: str,
    counts: dict[str, int],
    skipped: dict[str, str],
    libraries: tuple[str, ...],
) -> None:
    """`scene.json` and `README.txt`."""
    from stages.export.models import write_json
    from stages.export.texts import readme, scene_description

    description = scene_description(
        files=sorted(path.name for path in folder.iterdir()),
        frame=_frame_name(scene, frame),
        units=units,
        up=scene.orbit.up.tolist(),
        similarity=scene.frame_from_world.tolist(),
        counts=counts,
        skipped=skipped,
        versions={name: library_version(name) for name in ("dentalsplat", *libraries)},
    )
    write_json(folder / "scene.json", description)
    (folder / "README.txt").write_text(readme(description))
