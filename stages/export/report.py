"""What the page about a run says of the files that came out."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

from pipeline.pages.parts import Hero, Link
from pipeline.pages.pictures import from_file
from pipeline.stage import Parts

if TYPE_CHECKING:
    from pipeline.pages.case import Case

LINKS = (
    Link("results/viewer.html", "Turn the scene around"),
    Link("results/orbit.mp4", "Video"),
    Link("results/mesh.stl", "Mesh (.stl)"),
    Link("results/mesh_without_scale.stl", "Mesh without a scale (.stl)"),
    Link("results/mesh.glb", "Mesh with photographs (.glb)"),
    Link("results/mesh_without_scale.glb", "Mesh with photographs, without a scale (.glb)"),
    Link("results/splats.ply", "Splats (.ply)"),
    Link("results/README.txt", "What the files are"),
)


def links(case: Case) -> Iterator[Link]:
    """The files, unless they are those of an earlier run."""
    if case.failed is None and case.providers("exports"):
        yield from LINKS


def preview(case: Case) -> Iterator[Hero]:
    """The scene as it came out."""
    for name in case.providers("exports")[::-1]:
        folder = case.folder(name, "exports")
        if folder and (folder / "preview.png").is_file():
            said = "The scene, rendered from several directions."
            yield Hero(from_file(folder / "preview.png", said, "", 1100), said)
            return


PARTS: Parts = {"preview": preview, "links": links}
