"""The settings of the stage `export`."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from pipeline.artifacts.confidence import COMPLETED
from pipeline.artifacts.space.frames import WANTED, Wanted
from pipeline.stage import StageConfig


class ExportConfig(StageConfig):
    frame: Wanted = Field("auto", description=f"frame of all exports: {WANTED}")
    splat_files: bool = Field(
        True,
        description="write, beside splats.ply, the smaller files for other viewers: one of "
        "constant colour, .sog, .spz and compressed .ply",
    )
    colmap: bool = Field(True, description="write the COLMAP model and transforms.json")
    colmap_points: int = Field(
        50_000, ge=0, le=2_000_000, description="points in the COLMAP model and points.ply, at most"
    )
    mesh: bool = Field(True, description="write a mesh as .ply, .stl and .glb")
    mesh_method: Literal["tsdf", "poisson"] = Field(
        "tsdf",
        description="tsdf: fuse depth rendered from the Gaussians; poisson: surface through the "
        "points",
    )
    mesh_faces: int = Field(
        60_000,
        ge=100,
        le=5_000_000,
        description="triangles of the mesh, at most, and of each closed model that stays closed so",
    )
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
        COMPLETED,
        ge=0,
        description="only points with a confidence above this support the mesh: up to it their "
        "depth was completed from what lies around them; 1.25 leaves out what one photograph alone "
        "shows, too (there the mesh is the shape that crowns have)",
    )
    mesh_jaws: bool = Field(
        True, description="write the mesh jaw by jaw as well, where crowns of both are known"
    )
    mesh_texture: int = Field(
        2048,
        ge=0,
        le=8192,
        description="width and height of the texture in .glb, pixels, at most; 0: no .glb",
    )
    mesh_base: bool = Field(
        False,
        description="write a closed model of each jaw with a flat base, for printing, too; what is "
        "behind the surface that was photographed is made up",
    )
    mesh_base_height: float = Field(
        8.0, gt=0, le=50, description="height of that base beyond the gums, mm"
    )
    mesh_base_depth: float = Field(
        6.0, ge=2, le=20, description="material behind the surface of such a model, mm"
    )
    video: bool = Field(True, description="write orbit.mp4")
    video_seconds: float = Field(8.0, ge=0.5, le=120, description="length of one loop")
    video_fps: int = Field(25, ge=1, le=60, description="frames per second")
    video_crf: int = Field(
        20, ge=1, le=51, description="x264 quality: smaller is better, and the file larger"
    )
    viewer: bool = Field(True, description="write viewer.html")
    viewer_photos: bool = Field(
        True, description="embed the photographs in the page, for thumbnails and comparison"
    )
    viewer_sh_degree: int = Field(
        3, ge=0, le=3, description="highest spherical-harmonics degree that the page carries"
    )
    preview: bool = Field(True, description="write preview.png")
