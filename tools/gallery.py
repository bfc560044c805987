"""The pictures of `docs/gallery.md`, the page itself, and the picture of README and home page.

    python tools/gallery.py [--work runs/gallery]

Runs the photographs that the repository holds, takes pictures of what comes out (with Chromium
where it is a page), and does the same with photographs that are refused: what is said then stands
on the page word for word. Nothing of it shows a patient.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import open3d

ROOT = Path(__file__).resolve().parents[1]
SAMPLES = ROOT / "data_samples"
PICTURES = ROOT / "docs" / "gallery"
PAGE = ROOT / "docs" / "gallery.md"
#: The picture of README and the site's home page: the preview of the three photographs.
FIRST = ROOT / "docs" / "preview.jpg"
#: A picture on the page: its longest side, and JPEG quality.
SIDE, QUALITY = 960, 82
WINDOW = (1280, 800)
#: Three of the twelve frames, the outer ones and the middle one: too far apart for features.
FAR_APART = ("000.jpg", "006.jpg", "011.jpg")
HEAD = """\
# Gallery

What comes out of the sample data, and what is refused. `make gallery` makes this page and its
pictures.
"""


@dataclass(frozen=True)
class Shot:
    """The viewer page with something switched on.

    Attributes:
        name: of the picture.
        address: what follows the `#`.
        caption: what it shows.
    """

    name: str
    address: str
    caption: str


SHOTS = (
    Shot("viewer", "", "The viewer, as it opens."),
    Shot("numbers", "numbers=fdi", "The teeth with their FDI numbers."),
    Shot(
        "support", "support=1",
        "What no photograph has seen is magenta, what only one has seen amber.",
    ),
    Shot("jaw", "jaw=upper", "The upper jaw alone."),
    Shot("section", "cut=across,0.1", "Cut by a plane."),
    Shot("mesh", "mesh=1", "The mesh over the scene."),
    Shot("sides", "sides=1", "Right and left beside each other."),
)  # fmt: skip


@dataclass(frozen=True)
class Refusal:
    """Photographs that can't become a scene.

    Attributes:
        name: of the case.
        title: what is wrong with them.
        photographs: RGB [H, W, 3].
    """

    name: str
    title: str
    photographs: tuple[np.ndarray, ...]


def pipeline(*arguments: str) -> subprocess.CompletedProcess[str]:
    """`pipeline` with these arguments, from the repository's root."""
    return subprocess.run(
        [sys.executable, "-m", "dentalsplat", *arguments],
        capture_output=True, text=True, check=False, cwd=ROOT,
    )  # fmt: skip


def reconstructed(
    name: str, work: Path, *photographs: Path, settings: tuple[str, ...] = ()
) -> Path:
    """The results of a case, with some settings (``--set``).

    Raises:
        SystemExit: it could not be made.
    """
    workspace = work / name
    said = [word for setting in settings for word in ("--set", setting)]
    done = pipeline("run", *map(str, photographs), "-w", str(workspace), *said)
    if done.returncode:
        raise SystemExit(f"{name}: {done.stderr}")
    return workspace / "results"


def save(picture: np.ndarray, name: str) -> str:
    """Write a picture [H, W, 3] BGR for the page; returns its Markdown address."""
    small = min(1.0, SIDE / max(picture.shape[:2]))
    size = (round(picture.shape[1] * small), round(picture.shape[0] * small))
    picture = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
    options = [cv2.IMWRITE_JPEG_QUALITY, QUALITY, cv2.IMWRITE_JPEG_PROGRESSIVE, 1]
    cv2.imwrite(str(PICTURES / f"{name}.jpg"), picture, options)
    return f"gallery/{name}.jpg"


def screenshot(page: Path, address: str, work: Path) -> np.ndarray:
    """A page as Chromium shows it: [H, W, 3] BGR.

    Raises:
        SystemExit: there is no Chromium, or it made no picture.
    """
    browser = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "chrome"))), "")
    if not browser:
        raise SystemExit("The gallery needs Chromium: `make chromium` installs it.")
    file = work / "screenshot.png"
    file.unlink(missing_ok=True)
    command = [
        browser, "--headless", "--no-sandbox", "--hide-scrollbars", "--use-angle=swiftshader",
        "--enable-unsafe-swiftshader", f"--window-size={WINDOW[0]},{WINDOW[1]}",
        "--virtual-time-budget=10000", f"--user-data-dir={work / 'profile'}",
        f"--screenshot={file}", f"file://{page.resolve()}#{address}",
    ]  # fmt: skip
    subprocess.run(command, capture_output=True, timeout=180, check=False)
    picture = cv2.imread(str(file))
    if picture is None:
        raise SystemExit(f"Chromium made no picture of {page}.")
    return picture


def shaded(file: Path) -> np.ndarray:
    """A mesh that lies on its base, z up, from the front and above: [H, W, 3] BGR."""
    mesh = open3d.t.io.read_triangle_mesh(str(file))
    scene = open3d.t.geometry.RaycastingScene()
    scene.add_triangles(mesh)
    vertices = mesh.vertex.positions.numpy().astype(np.float64)
    centre = (vertices.min(0) + vertices.max(0)) / 2
    eye = centre + 4 * np.linalg.norm(np.ptp(vertices, axis=0)) * np.array([0.25, -0.8, 0.55])
    down = [0, 0, -1]  # what Open3D calls up leads down the picture
    rays = scene.create_rays_pinhole(16, centre, eye, down, 640, 420).numpy()
    rays[..., 3:] /= np.linalg.norm(rays[..., 3:], axis=-1, keepdims=True)
    hit = scene.cast_rays(open3d.core.Tensor(rays))
    normals, seen = hit["primitive_normals"].numpy(), np.isfinite(hit["t_hit"].numpy())
    light = np.array([-0.4, -0.7, 0.6])  # of length 1
    shade = 0.25 + 0.7 * np.clip(normals @ light, 0, 1)
    color = np.where(seen[..., None], shade[..., None] * np.array([205, 225, 240]), 255)
    return np.asarray(color, np.uint8)


def models(results: Path) -> str:
    """The section of the closed models."""
    jaws = np.hstack([shaded(results / f"model_{jaw}.stl") for jaw in ("upper", "lower")])
    caption = "The models of both jaws; what no photograph shows is made up."
    return (
        "## Models to print\n\nThe same three photographs, with `--set export.mesh_base=true`.\n\n"
        f"![{caption}]({save(jaws, 'far_models')})\n\n{caption}\n"
    )


def written(photographs: list[np.ndarray] | tuple[np.ndarray, ...], folder: Path) -> Path:
    """The folder, with these photographs and no others."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    for k, image in enumerate(photographs):
        cv2.imwrite(str(folder / f"{k}.png"), image[..., ::-1])
    return folder


def beside(images: list[np.ndarray] | tuple[np.ndarray, ...], height: int = 240) -> np.ndarray:
    """Photographs RGB in a row, as one picture BGR."""
    shown = [
        cv2.resize(image, (round(image.shape[1] * height / image.shape[0]), height),
                   interpolation=cv2.INTER_AREA)
        for image in images
    ]  # fmt: skip
    return np.hstack(shown)[..., ::-1]


def refusals() -> Iterator[Refusal]:
    """Cases that no scene can come of."""
    samples = [
        cv2.imread(str(SAMPLES / "three_photos" / f"{name}.jpg"))[..., ::-1]
        for name in ("right_buccal", "frontal", "left_buccal")
    ]
    yield Refusal("one", "One photograph", (samples[1],))
    shaken = [cv2.blur(image, (61, 1)) for image in samples]
    yield Refusal("shaken", "Shaken: nothing can be made out", tuple(shaken))
    walls = [np.full((384, 512, 3), shade, np.uint8) for shade in ((182, 176, 160), (96, 120, 160))]
    yield Refusal("walls", "No teeth, and nothing to hold on to", tuple(walls))
    ends = [samples[0], samples[0][:, ::-1]]
    yield Refusal("mirrored", "A photograph and its own mirror image", tuple(ends))


def scene(
    name: str, title: str, text: str, results: Path, work: Path, shots: tuple[Shot, ...]
) -> str:
    """The section of a case."""
    lines = [f"## {title}\n", text, ""]
    preview = save(cv2.imread(str(results / "preview.png")), f"{name}_preview")
    lines += [f"![Photograph, reconstruction, new view and mesh]({preview})\n"]
    record = json.loads((results / "scene.json").read_text())
    lines += [record["scale"]["text"], ""]
    for shot in shots:
        picture = screenshot(results / "viewer.html", shot.address, work)
        lines += [f"![{shot.caption}]({save(picture, f'{name}_{shot.name}')})\n", shot.caption, ""]
    return "\n".join(lines)


def refused(case: Refusal, work: Path) -> str:
    """The section of a case that must be refused.

    Raises:
        SystemExit: it was not.
    """
    folder = written(case.photographs, work / f"{case.name}_photographs")
    done = pipeline("run", str(folder), "-w", str(work / case.name))
    if done.returncode not in (2, 3):
        raise SystemExit(f"{case.title}: not refused (exit status {done.returncode})")
    message = done.stderr.strip().split("\n\n")[-1].replace(f"{work}/", "runs/gallery/")
    picture = save(beside(case.photographs), f"refused_{case.name}")
    return (
        f"### {case.title}\n\n![The photographs]({picture})\n\nExit status {done.returncode}:\n\n"
        f"> {message}\n"
    )


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--work", type=Path, default=ROOT / "runs" / "gallery")
    work = parser.parse_args().work
    work.mkdir(parents=True, exist_ok=True)
    shutil.rmtree(PICTURES, ignore_errors=True)
    PICTURES.mkdir()
    frames = SAMPLES / "twelve_frames"
    far = [frames / name for name in FAR_APART]
    far_results = reconstructed("far", work, *far, settings=("export.mesh_base=true",))
    sections = [
        HEAD,
        scene(
            "three", "Three photographs",
            "`pipeline run data_samples/three_photos`: a synthetic mouth, three photographs.",
            reconstructed("three", work, SAMPLES / "three_photos"), work, SHOTS,
        ),
        scene(
            "twelve", "Twelve frames",
            "`pipeline run data_samples/twelve_frames`: the same mouth, twelve frames around it.",
            reconstructed("twelve", work, frames), work, SHOTS[:1],
        ),
        scene(
            "far", "Three photographs 45° apart",
            "Three of these frames, with the teeth as landmarks: no feature links them.",
            far_results, work, SHOTS[1:3],
        ),
        models(far_results),
        "## Refused\n\nA scene that can't be trusted is not shown. What is said instead:\n",
        *(refused(case, work) for case in refusals()),
    ]  # fmt: skip
    PAGE.write_text("\n".join(sections))
    preview = cv2.imread(str(work / "three" / "results" / "preview.png"))
    cv2.imwrite(str(FIRST), preview, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    size = sum(path.stat().st_size for path in PICTURES.iterdir())
    print(
        f"{PAGE.relative_to(ROOT)}, {len(list(PICTURES.iterdir()))} pictures, {size / 1e6:.1f} MB"
    )


if __name__ == "__main__":
    main()
