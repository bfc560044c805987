"""`gaussians`: the fitted 3D Gaussians, as the standard 3DGS `.ply` (62 properties).

Gaussians fitted with a light beside the lens have a second file, `light.safetensors`, with what
spherical harmonics can't express; a viewer that knows the `.ply` alone shows the harmonics. The
colour behind them, where it is known and not black, is in `background.json`.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np
import numpy.typing as npt
from plyfile import PlyData, PlyElement

from pipeline.artifacts.base import Artifact
from pipeline.errors import RequestError
from pipeline.files import read_json, write_json
from pipeline.untrusted.scenes.ply import read_cloud

Array = npt.NDArray[np.float32]

#: 3DGS stores spherical harmonics up to degree 3: a constant and 15 more coefficients a colour.
SH_COEFFICIENTS = 16
#: More Gaussians than any scene has; their harmonics alone take 2 GB.
MOST_GAUSSIANS = 10_000_000
#: Numbers `f_rest_*` of a Gaussian for degrees 0 to 3.
REST_COUNTS = tuple(3 * ((degree + 1) ** 2 - 1) for degree in range(4))

#: PlayCanvas's compressed `.ply` bounds so many Gaussians at a time, and writes each within that;
#: harmonics from minus to plus half of this span fill a byte.
COMPRESSED_CHUNK, COMPRESSED_HARMONIC_SPAN = 256, 8.0
#: Its bounds, three each, and its words of a Gaussian.
COMPRESSED_BOUNDS = (("x", "y", "z"), ("scale_x", "scale_y", "scale_z"), ("r", "g", "b"))
COMPRESSED_WORDS = ("packed_position", "packed_rotation", "packed_scale", "packed_color")


@dataclass(frozen=True)
class Light:
    """Gaussians as a light beside the lens shows them (see `stages.splatting.light`).

    Attributes:
        albedo: [N, 3] float32, colour before the light, in the images' encoding (about 0..1).
        normals: [N, 3] float32 unit vectors, world.
        diffuse_share: k in 1 - k + k n.v, 0..1.
        falloff: exponent of the distance.
        distance: where the falloff is 1, world units.
        widths: exponents m of the narrow and the broad highlight lobe exp(m (n.v - 1)).
        strengths: of the two lobes, in linear light.
        gamma: of the images' encoding.
    """

    albedo: Array
    normals: Array
    diffuse_share: float
    falloff: float
    distance: float
    widths: tuple[float, float]
    strengths: tuple[float, float]
    gamma: float = 2.2

    def __getitem__(self, index: npt.NDArray[np.bool_] | npt.NDArray[np.integer]) -> Light:
        """The light of the Gaussians that a boolean mask [N] or an index array selects."""
        return replace(self, albedo=self.albedo[index], normals=self.normals[index])


@dataclass(frozen=True)
class Gaussians(Artifact):
    """Gaussians in world coordinates, parametrised as 3DGS stores them.

    Attributes:
        means: [N, 3] float32.
        quats_wxyz: [N, 4] float32, unit.
        log_scales: [N, 3] float32, natural logarithm of the standard deviations.
        logit_opacities: [N] float32.
        sh: [N, 16, 3] float32; coefficient 0 is the constant (f_dc), colour = .5 + sum(sh * basis).
        light: what shows them better than `sh` where a light beside the lens lit the scene, or
            None.
        background: sRGB colour in 0..1 of what is behind them all.
    """

    kind: ClassVar[str] = "gaussians"
    means: Array
    quats_wxyz: Array
    log_scales: Array
    logit_opacities: Array
    sh: Array
    light: Light | None = None
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __len__(self) -> int:
        return len(self.means)

    def save(self, folder: Path) -> None:
        write_gaussians_ply(folder / "gaussians.ply", self)
        if self.light is not None:
            write_light(folder / "light.safetensors", self.light)
        if any(self.background):
            write_json(folder / "background.json", {"background": list(self.background)})

    @classmethod
    def load(cls, folder: Path) -> Self:
        lit = folder / "light.safetensors"
        light = read_light(lit) if lit.exists() else None
        said = read_json(folder / "background.json") or {"background": (0.0, 0.0, 0.0)}
        red, green, blue = said["background"]
        return cls(
            **read_gaussians_ply(folder / "gaussians.ply"), light=light,
            background=(red, green, blue),
        )  # fmt: skip


def ply_properties(degree: int = 3) -> list[str]:
    """The property names of a 3DGS `.ply`, in order: 62 with harmonics up to degree 3."""
    rest = [f"f_rest_{k}" for k in range(REST_COUNTS[degree])]
    return [
        "x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", *rest,
        "opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3",
    ]  # fmt: skip


def ply_comment(text: str) -> str:
    """A line of a `.ply` header; what is no ASCII is written in words that are."""
    ascii_only = text.replace("\u00b1", "+-").encode("ascii", "replace").decode("ascii")
    return "comment " + " ".join(ascii_only.split())


def write_gaussians_ply(
    path: Path, gaussians: Gaussians, degree: int = 3, comments: Iterable[str] = ()
) -> None:
    """Write the `.ply` that every splat viewer reads (f_rest is channel-major, as in 3DGS).

    Args:
        degree: of the harmonics that are written; 3: the 62 properties of 3DGS.
        comments: lines for the header.
    """
    count = len(gaussians)
    rest = (
        gaussians.sh[:, 1 : (degree + 1) ** 2]
        .transpose(0, 2, 1)
        .reshape(count, REST_COUNTS[degree])
    )
    columns = np.concatenate(
        [
            gaussians.means, np.zeros((count, 3), np.float32), gaussians.sh[:, 0], rest,
            gaussians.logit_opacities[:, None], gaussians.log_scales, gaussians.quats_wxyz,
        ],
        axis=1,
    )  # fmt: skip
    dtype = np.dtype([(name, "<f4") for name in ply_properties(degree)])
    rows = np.ascontiguousarray(columns, "<f4").view(dtype).reshape(count)
    lines = [ply_comment(text).removeprefix("comment ") for text in comments]
    PlyData([PlyElement.describe(rows, "vertex")], byte_order="<", comments=lines).write(str(path))


def read_gaussians_ply(path: Path) -> dict[str, Array]:
    """Read a 3DGS `.ply` of any spherical-harmonics degree 0..3 into the fields of `Gaussians`.

    Raises:
        RequestError: it is damaged, lacks a property of these, has harmonics of no such degree, or
            more Gaussians than any scene.
    """
    always = [n for n in ply_properties() if n[0] != "n" and not n.startswith("f_rest_")]
    vertex = read_cloud(path, always)
    count = len(vertex["x"])
    if count > MOST_GAUSSIANS:
        raise RequestError(
            f"{path} has {count:,} Gaussians, more than the {MOST_GAUSSIANS:,} that are read. "
            "Prune it."
        )
    number = sum(name.startswith("f_rest_") for name in vertex)
    rest_names = [f"f_rest_{k}" for k in range(number)]
    if number not in REST_COUNTS or not vertex.keys() >= set(rest_names):
        raise RequestError(
            f"{path} has {number} properties f_rest_*, which are spherical harmonics of no degree "
            f"that is known: degrees 0 to 3 have {', '.join(map(str, REST_COUNTS[:-1]))} and "
            f"{REST_COUNTS[-1]}, numbered from 0. Write it with one of these."
        )

    def stack(names: list[str]) -> Array:
        with np.errstate(over="ignore"):  # doubles beyond float32 become infinite
            return np.stack([vertex[name] for name in names], -1).astype(np.float32)

    sh = np.zeros((count, SH_COEFFICIENTS, 3), np.float32)
    sh[:, 0] = stack([f"f_dc_{k}" for k in range(3)])
    if number:
        rest = stack(rest_names).reshape(count, 3, number // 3)
        sh[:, 1 : 1 + number // 3] = rest.transpose(0, 2, 1)
    return {
        "means": stack(["x", "y", "z"]),
        "quats_wxyz": stack([f"rot_{k}" for k in range(4)]),
        "log_scales": stack([f"scale_{k}" for k in range(3)]),
        "logit_opacities": stack(["opacity"])[:, 0],
        "sh": sh,
    }


#: fields of `Light` that are one number or two, in the order of the tensor `scene`
LIGHT_SCENE = ("diffuse_share", "falloff", "distance", "gamma")


def write_light(path: Path, light: Light) -> None:
    """Write tensors `albedo`, `normals` [N, 3], `lobes` [2, 2] (width, strength), `scene` [4]."""
    from safetensors.numpy import save_file

    scene = [getattr(light, name) for name in LIGHT_SCENE]
    tensors: dict[str, npt.NDArray[Any]] = {
        "albedo": np.ascontiguousarray(light.albedo, np.float32),
        "normals": np.ascontiguousarray(light.normals, np.float32),
        "lobes": np.stack([light.widths, light.strengths], 1).astype(np.float64),
        "scene": np.array(scene, np.float64),
    }
    save_file(tensors, path, {"scene": ",".join(LIGHT_SCENE)})


def read_light(path: Path) -> Light:
    """Read what `write_light` wrote."""
    from safetensors.numpy import load_file

    tensors = load_file(path)
    lobes = tensors["lobes"].tolist()
    scene = dict(zip(LIGHT_SCENE, tensors["scene"].tolist(), strict=True))
    return Light(
        albedo=tensors["albedo"], normals=tensors["normals"],
        widths=(lobes[0][0], lobes[1][0]), strengths=(lobes[0][1], lobes[1][1]), **scene,
    )  # fmt: skip
