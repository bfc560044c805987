"""The stage `export`: files that leave the workspace, for viewers, printers and other programs."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from pipeline.errors import ReconstructionError
from pipeline.installed import library_version
from pipeline.stage import Parts, Stage, StageContext
from stages.export.config import ExportConfig

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from pipeline.artifacts.dental.fdi import Jaw
    from pipeline.artifacts.space.frames import Frame
    from pipeline.artifacts.space.scale import Scale
    from pipeline.artifacts.teeth import Teeth
    from pipeline.artifacts.views import Views
    from stages.export.measuring.mouth import Mouth
    from stages.export.mesh.surface import Mesh
    from stages.export.mesh.texture.sight import Sight
    from stages.export.scene import Scene
    from stages.export.viewer.page import Knowledge


class ExportStage(Stage):
    """Writes splats, COLMAP model, nerfstudio cameras, mesh, video, viewer page and preview."""

    name = "export"
    version = 27
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
        from pipeline.artifacts.space.frames import frame_of
        from pipeline.artifacts.space.scale import Scale
        from stages.export.beside import Beside
        from stages.export.mesh.building import raw_surface
        from stages.export.scene import assemble
        from stages.export.splatfiles.writing import write_splats

        config: ExportConfig = context.config
        views, cameras = context.load("views"), context.load("cameras")
        if not len(cameras):
            raise ReconstructionError(
                "There is nothing to export: none of the photographs could be placed."
            )
        frame = frame_of(cameras, config.frame)
        if frame.lacking:
            context.warn(frame.lacking)
        scale = cameras.scale
        if frame.name == "world":
            scale = Scale("none", scale.source)
        comments = [f"dentalsplat: {scale.text}"]
        scene = assemble(
            views,
            cameras,
            context.load("gaussians"),
            context.load("points") if context.has("points") else None,
            frame,
            context.threads,
            context.progress,
        )
        folder = context.output("exports")
        counts = {
            "photographs": len(views),
            "placed_photographs": len(scene.cameras),
            "gaussians": len(scene.gaussians),
        }
        skipped: dict[str, str] = {}
        mouth, teeth, raw, model_points = None, None, None, None
        with Beside(context.threads) as files, Beside(context.threads) as surface:
            files.give(write_splats, folder, scene, frame.stands, comments, config.splat_files)
            if config.colmap:
                import pycolmap  # noqa: F401  only in this thread can signals wait meanwhile

                model_points = files.give(_write_cameras, context, scene, folder, scale)
            if context.has("teeth"):
                mouth, teeth = _write_teeth(context, views, scene, folder, frame, scale)
            if config.mesh:
                import pymeshlab  # noqa: F401  its Qt outlives no other thread: aborts at exit

                raw = raw_surface(
                    scene, config.mesh_method, config.mesh_resolution, config.mesh_cell,
                    config.mesh_views, config.mesh_depth, config.mesh_confidence, context.progress,
                )  # fmt: skip
                context.progress("mesh", 1, 1)
            finished = surface.give(
                _finish_surface, context, scene, raw, mouth, teeth, folder, frame, scale,
                skipped,
            )  # fmt: skip
            frames = _write_video(context, scene, folder) if config.video else None
        mesh_faces, page_bytes = finished()
        made = {
            "colmap_points": model_points() if model_points else None,
            "teeth": len(teeth["teeth"]) if teeth else None,
            "mesh_faces": mesh_faces,
            "video_frames": frames,
        }
        counts |= {name: count for name, count in made.items() if count is not None}
        _describe(scene, folder, frame, scale, counts, skipped, self.libraries)
        context.summarize(
            splats=len(scene.gaussians),
            mesh_faces=counts.get("mesh_faces", 0),
            page_mb=round(page_bytes / 1e6, 2),
        )


def _finish_surface(
    context: StageContext, scene: Scene, raw: Mesh | None, mouth: Mouth | None,
    teeth: dict[str, Any] | None, folder: Path, frame: Frame, scale: Scale,
    skipped: dict[str, str],
) -> tuple[int | None, int]:  # fmt: skip
    """From the surface as it comes to the mesh, and to all files that rest on it.

    Returns:
        Triangles of the mesh, None where there is none; bytes of the viewer page, 0 without one.
    """
    from stages.export.mesh.building import clean_mesh
    from stages.export.mesh.jaws import crown_maps, jaws_of
    from stages.export.mesh.rims import even_border
    from stages.export.mesh.texture.sight import sights

    config: ExportConfig = context.config
    mesh = (
        clean_mesh(raw, config.mesh_faces, scene.voxel(config.mesh_resolution))
        if raw is not None
        else None
    )
    seen: Sequence[Sight] = ()
    jaws: Mapping[Jaw, npt.NDArray[np.bool_]] = {}
    if mesh is not None:
        seen = sights(mesh, scene.cameras, scene.masks)
        if mouth is not None:
            up = None if mouth.axes is None else mouth.axes[1]
            jaws = jaws_of(mesh, seen, crown_maps(mouth.dentitions, scene.cameras), up)
        if jaws:
            mesh = even_border(mesh, jaws["upper"])
            seen = sights(mesh, scene.cameras, scene.masks)
    page_bytes = 0
    if config.viewer:
        known = _knowledge(scene, frame, scale, mouth, teeth, mesh, jaws)
        page_bytes = _write_page(context, scene, folder, known)
    if mesh is not None:
        _write_mesh(context, scene, mesh, seen, jaws, folder, frame, scale, skipped)
    elif config.mesh:
        skipped["mesh"] = "too little surface for a mesh"
        context.warn(
            f"No mesh was made: too little of the surface is known{_more_surface(config)}. The "
            "other exports are complete."
        )
    if config.preview:
        _write_preview(scene, mesh, folder)
    return len(mesh) if mesh is not None else None, page_bytes


def _more_surface(config: ExportConfig) -> str:
    """The end of a sentence: what would help where there is too little for a mesh."""
    changed = [
        f"export.{name}={value} (as a rule {usual})"
        for name in ("mesh_confidence", "mesh_resolution", "mesh_cell", "mesh_depth")
        if (value := getattr(config, name)) != (usual := ExportConfig.model_fields[name].default)
    ]
    if not changed:
        return ". More photographs that overlap would help"
    return f" with {' and '.join(changed)}. Leave that out, or take more photographs that overlap"


def _write_mesh(
    context: StageContext, scene: Scene, mesh: Mesh, seen: Sequence[Sight],
    jaws: Mapping[Jaw, npt.NDArray[np.bool_]], folder: Path, frame: Frame, scale: Scale,
    skipped: dict[str, str],
) -> None:  # fmt: skip
    """The mesh together and jaw by jaw, with colours, for slicers, with a texture, as models."""
    from stages.export.mesh.texture.atlas import textured
    from stages.export.mesh.writing import Writer, write_meshes, write_models

    config: ExportConfig = context.config
    colored = None
    if config.mesh_texture:
        photos = [scene.photos[camera.name] for camera in scene.cameras]
        colored = textured(mesh, seen, photos, config.mesh_texture)
    writer = Writer(folder, frame, scale)
    write_meshes(writer, mesh, colored, jaws if config.mesh_jaws else {})
    if config.mesh_base:
        lacking = write_models(
            writer, mesh, jaws, config.mesh_base_height, config.mesh_base_depth, config.mesh_faces
        )
        if lacking:
            skipped["model"] = lacking
            context.warn(
                "Not every closed model that was asked for (export.mesh_base) was made: "
                f"{lacking}. The other exports are complete."
            )


def _write_cameras(context: StageContext, scene: Scene, folder: Path, scale: Scale) -> int:
    """COLMAP model with its images, `points.ply`, `transforms.json`; returns the points written."""
    from pipeline.artifacts.views import to_uint8
    from pipeline.untrusted.scenes.transforms import SCALE
    from stages.export import models
    from stages.export.scene import thinned

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
    notes: dict[str, Any] = {SCALE: scale.as_dict()}
    if scale.unit == "mm":
        notes["units"] = "mm"
    transforms = models.nerfstudio_transforms(scene.cameras, scene.masked, notes)
    models.write_json(folder / "transforms.json", transforms)
    return count


def _write_teeth(
    context: StageContext, views: Views, scene: Scene, folder: Path, frame: Frame, scale: Scale
) -> tuple[Mouth | None, dict[str, Any] | None]:
    """`teeth.json` and `teeth.csv`, if there are teeth; returns both, measured."""
    from stages.export.measuring.measures import NOTES
    from stages.export.measuring.mouth import read_mouth
    from stages.export.measuring.teeth_table import teeth_table
    from stages.export.models import write_json
    from stages.export.teeth import describe_teeth

    teeth: Teeth = context.load("teeth")
    if not teeth.chosen:
        return None, None
    found = describe_teeth(teeth, views, scene.cameras, scene.seen, frame.name, scale)
    mouth = read_mouth(teeth, views, scene.cameras, scene.seen, scene.orbit.up, scale)
    found |= {"measurement_notes": NOTES, "measurements": list(mouth.measurements)}
    write_json(folder / "teeth.json", found)
    (folder / "teeth.csv").write_text(teeth_table(found), encoding="utf-8")
    return mouth, found


def _knowledge(
    scene: Scene, frame: Frame, scale: Scale, mouth: Mouth | None,
    teeth: dict[str, Any] | None, mesh: Mesh | None, jaws: Mapping[Jaw, npt.NDArray[np.bool_]],
) -> Knowledge:  # fmt: skip
    """What the viewer shows beside the scene."""
    from stages.export.mesh.jaws import jaws_at
    from stages.export.mesh.rims import even_rims
    from stages.export.texts import describe_frame
    from stages.export.viewer.knowledge import (
        coarse,
        directions,
        photographs_that_saw,
        seen_surfaces,
    )
    from stages.export.viewer.page import Knowledge

    surfaces = seen_surfaces(scene.cameras, scene.seen, scene.masks)
    overlay, side = None, None
    if mesh is not None:
        small = even_rims(coarse(mesh))
        overlay = small.vertices, small.faces, jaws_at(small.vertices, mesh, jaws)
        side = jaws_at(scene.gaussians.means, mesh, jaws)
    return Knowledge(
        scale=scale.as_dict(),
        frame=describe_frame(frame),
        teeth=directions(teeth["teeth"], scene.cameras) if teeth else (),
        measurements=mouth.measurements if mouth else (),
        axes=mouth.axes if mouth else None,
        jaws=side,
        seen=photographs_that_saw(scene.gaussians.means, surfaces),
        mesh=overlay,
    )


def _write_image(path: Path, pixels: npt.NDArray[np.uint8]) -> None:
    from pipeline.artifacts.views import write_png

    path.parent.mkdir(parents=True, exist_ok=True)
    write_png(path, pixels)


def _write_video(context: StageContext, scene: Scene, folder: Path) -> int:
    from stages.export.pictures.frames import film_frame
    from stages.export.pictures.video import Video
    from stages.export.viewer.page import rasterizer_constants

    config: ExportConfig = context.config
    places, place_of_frame = scene.path(config.video_seconds, config.video_fps)
    last = {place: index for index, place in enumerate(place_of_frame)}
    near = rasterizer_constants(scene.gaussians, scene.cameras)["near"]
    size = (places[0].width, places[0].height)
    kept: dict[int, npt.NDArray[np.uint8]] = {}  # what the way back shows again
    file = folder / "orbit.mp4"
    with Video(file, size, config.video_fps, config.video_crf, context.threads > 1) as video:
        for index, place in enumerate(place_of_frame):
            context.progress("video", index, len(place_of_frame))
            frame = (
                kept.pop(place) if place in kept else film_frame(scene.painter, places[place], near)
            )
            video.add(frame)
            if index < last[place]:
                kept[place] = frame
    return len(place_of_frame)


def _write_page(context: StageContext, scene: Scene, folder: Path, knowledge: Knowledge) -> int:
    from stages.export.viewer.page import build_page, rasterizer_constants

    config: ExportConfig = context.config
    page = build_page(
        scene.gaussians, scene.cameras, scene.orbit,
        scene.photos if config.viewer_photos else {},
        rasterizer_constants(scene.gaussians, scene.cameras),
        config.viewer_sh_degree, knowledge,
    )  # fmt: skip
    return (folder / "viewer.html").write_bytes(page.encode())


def _write_preview(scene: Scene, mesh: Mesh | None, folder: Path) -> None:
    from pipeline.artifacts.views import to_uint8
    from stages.export.pictures.preview import contact_sheet, panel_size, shade_mesh

    middle = scene.orbit.middle()
    camera = panel_size(scene.cameras[middle])
    novel = scene.novel_camera(camera)
    panels = [
        ("input photograph", scene.photos[scene.cameras[middle].name]),
        ("3D Gaussians, same viewpoint", to_uint8(scene.seen[middle].image)),
        ("3D Gaussians, new viewpoint", scene.picture(novel)),
    ]
    if mesh is not None:
        panels.append(("mesh, new viewpoint", shade_mesh(mesh, novel)))
    _write_image(folder / "preview.png", contact_sheet(panels, camera.width, camera.height))


def _describe(
    scene: Scene,
    folder: Path,
    frame: Frame,
    scale: Scale,
    counts: dict[str, int],
    skipped: dict[str, str],
    libraries: tuple[str, ...],
) -> None:
    """`scene.json` and `README.txt`."""
    from stages.export.models import write_json
    from stages.export.texts import readme, scene_description

    description = scene_description(
        files=sorted(path.name for path in folder.iterdir()),
        frame=frame,
        scale=scale,
        up=scene.orbit.up.tolist(),
        counts=counts,
        skipped=skipped,
        versions={name: library_version(name) for name in ("dentalsplat", *libraries)},
    )
    write_json(folder / "scene.json", description)
    (folder / "README.txt").write_text(readme(description))
