"""Meshes with photographs on them, jaw by jaw, closed for printing, bent as the fit bent them."""

import io
import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh
from PIL import Image
from scipy.spatial import cKDTree

from pipeline.artifacts.cameras import Camera
from pipeline.artifacts.space.scale import Scale
from pipeline.artifacts.teeth import Teeth
from pipeline.stage import LocalContext
from stages.dentition.crowns import Outline, dentition_of
from stages.export.mesh.bend import bent
from stages.export.mesh.building import clean_mesh, made_of
from stages.export.mesh.jaws import LOWER, NEITHER, UPPER, jaws_at, jaws_of
from stages.export.mesh.rims import without_fringes
from stages.export.mesh.surface import (
    Mesh,
    face_normals,
    keep_vertices,
    repair,
    turned_faces,
)
from stages.export.mesh.texture.atlas import packed, textured
from stages.export.mesh.texture.glb import write_glb
from stages.export.mesh.texture.levelling import levelled
from stages.export.mesh.texture.sight import sights
from stages.export.stage import ExportConfig, ExportStage
from tests.stages import export_scene as scene
from tests.stages.sheet_case import sheet

SIZE = 96


def flat() -> Mesh:
    return sheet(
        21, 21, lambda u, v: (2 * u - 1, 2 * v - 1, 0 * u), lambda u, v: (u, v, 0.5 + 0 * u)
    )


def camera(x: float, name: str = "000") -> Camera:
    """4 before the sheet, which it sees from edge to edge if x is 0."""
    pose = np.eye(4)
    pose[:3, 3] = [-x, 0, 4]
    return Camera(name, SIZE, SIZE, 2 * SIZE, 2 * SIZE, SIZE / 2, SIZE / 2, pose)


def picture(of: Camera, mesh: Mesh, brighter: float = 0.0) -> np.ndarray:
    """What a camera sees of the flat sheet, whose colour is its place."""
    places = of.unproject(np.full((SIZE, SIZE), 4.0))
    color = np.stack([(places[..., 0] + 1) / 2, (places[..., 1] + 1) / 2, 0.5 + 0 * places[..., 0]])
    return np.clip(255 * color.transpose(1, 2, 0) * 0.8 + brighter, 0, 255).astype(np.uint8)


def two_cameras() -> tuple[list[Camera], list[np.ndarray], dict[str, np.ndarray]]:
    """Each sees half of the sheet alone; the second is brighter."""
    cameras = [camera(-0.3, "000"), camera(0.3, "001")]
    pictures = [picture(cameras[0], flat()), picture(cameras[1], flat(), 40)]
    return cameras, pictures, {c.name: np.ones((SIZE, SIZE), bool) for c in cameras}


def test_photographs_sit_where_they_were_taken(tmp_path: Path) -> None:
    mesh = replace(flat(), colors=0.8 * flat().colors)
    one, masks = camera(0.0), {"000": np.ones((SIZE, SIZE), bool)}
    masks["000"][:20] = False
    found = textured(mesh, sights(mesh, [one], masks), [picture(one, mesh)], 256)
    assert 0.6 < found.photographed.mean() < 0.9, "what is masked is not used"
    np.testing.assert_allclose(found.vertices[found.faces], mesh.vertices[mesh.faces])
    write_glb(tmp_path / "mesh.glb", found.moved(np.diag([1e-3, 1e-3, 1e-3, 1])), {"a": 1})
    read = trimesh.load(tmp_path / "mesh.glb").to_geometry()
    assert read.faces.shape == mesh.faces.shape
    np.testing.assert_allclose(np.ptp(read.vertices, axis=0), [2e-3, 2e-3, 0], atol=1e-9)
    image = np.asarray(read.visual.material.baseColorTexture.convert("RGB")).astype(float)
    middles = read.visual.uv[read.faces].mean(1)  # trimesh has v upwards
    column = (middles[:, 0] * image.shape[1]).astype(int)
    row = ((1 - middles[:, 1]) * image.shape[0]).astype(int)
    truth = (1e3 * read.vertices[read.faces].mean(1) + 1) / 2 * 255
    said = image[row, column, :2]
    error = np.abs(said - 0.8 * truth[:, :2]).max(1)
    assert error[found.photographed].max() < 8
    assert error[~found.photographed].max() < 20


def test_the_same_bytes_and_never_larger_than_asked() -> None:
    mesh, (cameras, pictures, masks) = flat(), two_cameras()
    first, again = (textured(mesh, sights(mesh, cameras, masks), pictures, 64) for _ in range(2))
    assert first.picture == again.picture and first.places.tobytes() == again.places.tobytes()
    width, height = Image.open(io.BytesIO(first.picture)).size
    assert max(width, height) <= 64
    assert (first.places >= 0).all() and (first.places <= 1).all()
    part = first.part(np.arange(len(mesh.faces)) < 10)
    np.testing.assert_allclose(part.vertices[part.faces], first.vertices[first.faces[:10]])


def test_photographs_are_not_shrunk_for_faces_that_none_shows() -> None:
    """A quarter of 20,000 faces: with a patch each they would fill the texture twice."""
    mesh = sheet(
        101, 101, lambda u, v: (2 * u - 1, 2 * v - 1, 0 * u), lambda u, v: (u, v, 0.5 + 0 * u)
    )
    one, masks = camera(0.0), {"000": np.ones((SIZE, SIZE), bool)}
    masks["000"][:24] = False
    mesh = replace(mesh, colors=0.8 * mesh.colors)
    found = textured(mesh, sights(mesh, [one], masks), [picture(one, mesh)], 200)
    assert (~found.photographed).sum() * 16 > 2 * 200**2
    image = Image.open(io.BytesIO(found.picture))
    assert max(image.size) <= 200
    pixels = found.places[found.faces] * image.size
    shown = np.ptp(pixels[found.photographed].reshape(-1, 2), axis=0)
    assert shown.min() > 0.7 * SIZE and shown.max() > 0.98 * SIZE
    column, row = pixels.mean(1).astype(int).T
    error = np.abs(np.asarray(image)[row, column] - 255 * mesh.colors[mesh.faces].mean(1))
    assert np.median(error[~found.photographed]) < 6


def test_seams_are_evened_out() -> None:
    mesh = flat()
    label = (mesh.vertices[mesh.faces].mean(1)[:, 0] > 0).astype(np.int64)
    colors = np.zeros((2, len(mesh.vertices), 3))
    colors[0], colors[1] = 100, 160
    added = levelled(mesh.faces, label, colors, np.full((len(mesh.vertices), 3), 50.0))
    seam = np.intersect1d(mesh.faces[label == 0], mesh.faces[label == 1])
    gap = np.abs((colors + added[:2])[0, seam] - (colors + added[:2])[1, seam])
    assert gap.max() < 8, "60 before"
    assert (
        np.abs(added[0][~np.isin(np.arange(len(mesh.vertices)), mesh.faces[label == 0])]).max() == 0
    )


def test_rectangles_do_not_overlap() -> None:
    sizes = [(int(w), int(h)) for w, h in np.random.default_rng(0).integers(1, 60, (40, 2))]
    corners, width, height = packed(sizes, 200)
    taken = np.zeros((height, width), int)
    for (x, y), (w, h) in zip(corners, sizes, strict=True):
        taken[y : y + h, x : x + w] += 1
    assert taken.max() == 1 and taken.sum() == sum(w * h for w, h in sizes) and width <= 200


def test_gums_go_with_the_nearest_crowns() -> None:
    mesh, one = flat(), camera(0.0)
    seen = sights(mesh, [one], {"000": np.ones((SIZE, SIZE), bool)})
    crowns = np.zeros((SIZE, SIZE), np.int8)
    crowns[25:44], crowns[50:60] = 1, -1  # y leads down
    jaws = jaws_of(mesh, seen, [crowns])
    assert set(jaws) == {"upper", "lower"} and (jaws["upper"] ^ jaws["lower"]).all()
    height = mesh.vertices[mesh.faces].mean(1)[:, 1]
    assert jaws["upper"][height < -0.15].all() and jaws["lower"][height > 0.1].all()
    assert jaws_of(mesh, seen, [np.maximum(crowns, 0)]) == {}, "one jaw is not two"
    assert jaws_of(mesh, seen, [None]) == {}
    z = mesh.vertices[0, 2]
    places = np.array([[0, -0.3, z], [0, 0.3, z + 0.01], [0, 0.3, z + 9], [np.nan, 0, z]])
    assert jaws_at(places, mesh, jaws).tolist() == [UPPER, LOWER, NEITHER, NEITHER]
    assert not jaws_at(places, mesh, {}).any()


def test_scraps_of_crowns_at_the_border_are_no_jaw() -> None:
    """Of the lower crowns a photograph of the upper ones shows some tips (closed models were made
    of them)."""
    mesh = sheet(
        81, 81, lambda u, v: (2 * u - 1, 2 * v - 1, 0 * u), lambda u, v: (u, v, 0.5 + 0 * u)
    )
    seen = sights(mesh, [camera(0.0)], {"000": np.ones((SIZE, SIZE), bool)})

    def found(lower: int) -> dict:
        crowns = np.zeros((SIZE, SIZE), np.int8)
        crowns[20 : SIZE - lower - 1], crowns[SIZE - lower :] = 1, -1
        return jaws_of(mesh, seen, [crowns])

    assert found(2) == {}
    assert 500 < found(9)["lower"].sum() < 2000


def test_the_underside_of_upper_crowns_is_the_upper_jaws() -> None:
    """Where they bite in front; as much of it was called the lower jaw's, and stood out from it."""
    mesh = sheet(
        41, 61,
        lambda u, v: (
            2 * u - 1,
            np.interp(v, [0, 0.4, 0.6, 1], [-1, -0.1, -0.08, 1]),
            np.interp(v, [0, 0.4, 0.6, 1], [-0.3, -0.3, 0, 0]),
        ),
        lambda u, v: (u, v, 0.5 + 0 * u),
    )  # fmt: skip
    seen = sights(mesh, [camera(0.0)], {"000": np.ones((SIZE, SIZE), bool)})
    crowns = np.zeros((SIZE, SIZE), np.int8)
    crowns[25:42], crowns[50:60] = 1, -1
    middle = mesh.vertices[mesh.faces].mean(1)
    ledge = (middle[:, 2] > -0.28) & (middle[:, 2] < -0.02)
    assert jaws_of(mesh, seen, [crowns])["lower"][ledge].mean() > 0.3
    jaws = jaws_of(mesh, seen, [crowns], np.array([0.0, -1, 0]))
    assert jaws["upper"][ledge].all() and jaws["lower"][middle[:, 1] > 0].all()


def test_points_follow_the_bend_of_the_fit() -> None:
    """The points of a ball that the fit made 3 % larger."""
    cameras = scene.ball_cameras()
    depths = [scene.ball_depth(camera) for camera in cameras]
    start = scene.ball_points()
    start = replace(start, positions=np.float32(0.97) * start.positions)
    front = start.positions[:, 2] < -0.5
    before = np.linalg.norm(start.positions[front], axis=1)
    after = np.linalg.norm(bent(start, cameras, depths).positions[front], axis=1)
    assert np.median(np.abs(before - 1)) > 0.029
    assert np.median(np.abs(after - 1)) < 0.005
    unknown = replace(start, normals=np.zeros_like(start.normals))
    assert np.array_equal(bent(unknown, cameras, depths).positions, unknown.positions)
    unseen = bent(start, cameras, [0 * depth for depth in depths])
    assert np.array_equal(unseen.positions, start.positions)


def ball_teeth() -> Teeth:
    """Crowns on the ball: six above, six below."""
    views = []
    for one in scene.ball_cameras():
        outlines = []
        for place, (upper, lower) in enumerate(
            zip((13, 12, 11, 21, 22, 23), (43, 42, 41, 31, 32, 33), strict=True)
        ):
            left = 50 + 11 * place
            for jaw, number, y in (("upper", upper, 38), ("lower", lower, 64)):
                corners = [(left, y), (left + 10, y), (left + 10, y + 18), (left, y + 18)]
                polygon = np.array(corners, float)
                outlines.append(Outline(polygon, jaw, 0.9, {number: 0.9}, number, 0.05))  # type: ignore[arg-type]
        size = (scene.WIDTH, scene.HEIGHT)
        views.append(dentition_of(outlines, one.name, size, "front", roll=0.0))
    return Teeth(tuple(views))


def export(folder: Path, scale: Scale, given: bool = False, **settings: object) -> LocalContext:
    case = scene.ball_case()
    case["teeth"] = ball_teeth()
    case["cameras"] = replace(
        case["cameras"], scale=scale, mouth_from_world=np.diag([1.0, -1, -1, 1]),
        input_from_world=np.diag([6.0, 6, 6, 1]), given=given,
    )  # fmt: skip
    config = ExportConfig(
        mesh_faces=3000, mesh_resolution=64, mesh_views=2, video=False, viewer=False,
        preview=False, colmap=False, splat_files=False, **settings,
    )  # type: ignore[arg-type]  # fmt: skip
    context = LocalContext(config, folder, case, threads=1)
    ExportStage().run(context)
    return context


def stands(model: trimesh.Trimesh, base: np.ndarray) -> bool:
    """Whether the centre of mass of a solid is above its base, of triangles [N, 3, 3]."""
    corners = cv2.convexHull(base[..., :2].reshape(-1, 1, 2).astype(np.float32))
    x, y, _ = model.center_mass
    return cv2.pointPolygonTest(corners, (float(x), float(y)), True) > 0.5


def test_the_stage_writes_each_jaw_and_models_of_both(tmp_path: Path) -> None:
    scale = Scale("mm", "textbook_teeth", 15.0)
    context = export(tmp_path, scale, mesh_base=True, mesh_base_height=2.0, mesh_base_depth=2.0)
    assert not context.warnings
    home = tmp_path / "exports"
    description = json.loads((home / "scene.json").read_text())
    names = {
        f"mesh{part}.{end}" for part in ("", "_upper", "_lower") for end in ("ply", "stl", "glb")
    }
    names |= {"model_upper.stl", "model_lower.stl"}
    assert names <= set(description["files"]) and not description["skipped"]
    turned = description["frame"]["file_from_frame"]
    np.testing.assert_allclose(np.diag(turned["mesh_upper.glb"]), [1e-3, 1e-3, 1e-3, 1])
    whole = trimesh.load(home / "mesh.ply")
    parts = {}
    for jaw, up in (("upper", 1), ("lower", -1)):
        part = parts[jaw] = trimesh.load(home / f"mesh_{jaw}.ply")
        assert up * np.median(part.vertices[:, 1]) > 1
        model = trimesh.load(home / f"model_{jaw}.stl")
        assert model.is_watertight and model.is_winding_consistent and model.volume > 50
        # on a printer's bed: z up, the base down, the front (z of the frame) towards -y
        base = -model.vertices[:, 2].min()
        assert base == pytest.approx((up * part.vertices[:, 1]).max() + 2, abs=0.05)
        flat = (model.triangles_center[:, 2] < 0.05 - base) & (model.face_normals[:, 2] < -0.99)
        assert stands(model, model.vertices[model.faces[flat]]), "it doesn't tip over"
        frame_from_file = np.linalg.inv(turned[f"model_{jaw}.stl"])
        np.testing.assert_allclose(frame_from_file[:3, :3] @ [0, -1, 0], [0, 0, 1])
        np.testing.assert_allclose(frame_from_file[:3, :3] @ [0, 0, -1], [0, up, 0])
        # back in the frame, the front of the model is the surface that was seen
        back = model.copy().apply_transform(frame_from_file)
        away, _ = cKDTree(back.vertices).query(part.vertices)
        assert np.median(away) < 0.3, "no further than a voxel"
        textured_part = trimesh.load(home / f"mesh_{jaw}.glb").to_geometry()
        np.testing.assert_allclose(1e3 * textured_part.bounds, part.bounds, atol=1e-3)
    assert sum(len(part.faces) for part in parts.values()) == len(whole.faces)
    text = (home / "README.txt").read_text()
    assert "made up, not measured" in text and "metres" in text


def test_models_lie_on_their_bases_in_the_frame_of_given_cameras(tmp_path: Path) -> None:
    """That of these has y down; a printer prints a file as it lies."""
    export(
        tmp_path, Scale("mm", "cameras"), given=True, mesh_base=True, mesh_base_height=2.0,
        mesh_base_depth=2.0, mesh_texture=0,
    )  # fmt: skip
    home = tmp_path / "exports"
    frame = json.loads((home / "scene.json").read_text())["frame"]
    assert frame["name"] == "input" and "mesh_upper.stl" not in frame["file_from_frame"]
    for jaw in ("upper", "lower"):
        part, model = (trimesh.load(home / f"{stem}_{jaw}.stl") for stem in ("mesh", "model"))
        base = model.vertices[:, 2].min()
        flat = (model.triangles_center[:, 2] < base + 0.05) & (model.face_normals[:, 2] < -0.99)
        assert stands(model, model.vertices[model.faces[flat]]), "it doesn't tip over"
        model.apply_transform(np.linalg.inv(frame["file_from_frame"][f"model_{jaw}.stl"]))
        away, _ = cKDTree(model.vertices).query(part.vertices)
        assert np.median(away) < 0.3, "no further than a voxel"


def test_without_a_scale_no_model_is_made_and_why_is_said(tmp_path: Path) -> None:
    context = export(tmp_path, Scale(), mesh_base=True, mesh_texture=0)
    assert len(context.warnings) == 1 and "no scale is known" in context.warnings[0]
    names = {path.name for path in (tmp_path / "exports").iterdir()}
    assert "mesh_upper_without_scale.stl" in names
    assert not any(name.endswith(".glb") or name.startswith("model") for name in names)
    description = json.loads((tmp_path / "exports" / "scene.json").read_text())
    assert "model" in description["skipped"]


def test_in_our_own_frame_the_units_are_our_own_though_millimetres_are_known(
    tmp_path: Path,
) -> None:
    context = export(
        tmp_path, Scale("mm", "length", 2.0), frame="world", mesh_base=True, mesh_texture=0
    )
    (told,) = context.warnings
    home = tmp_path / "exports"
    scene = json.loads((home / "scene.json").read_text())
    assert scene["scale"]["unit"] == "none" and scene["scale"]["source"] == "length"
    np.testing.assert_array_equal(scene["frame"]["frame_from_world"], np.eye(4))
    assert "export.frame=world" in scene["skipped"]["model"]
    for text in (told, scene["scale"]["text"], (home / "README.txt").read_text()):
        assert "own units" in text and "no scale is known" not in text


def test_what_guessed_points_made_beside_trusted_ones_is_told() -> None:
    """A wall whose end is guessed to curl out; between trusted points guessed ones may help."""
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(0, 10, 0.5), np.arange(0, 6, 0.5)))
    start = scene.ball_points()[np.arange(len(x))]
    wall = np.stack([x, y, 0 * x], 1)
    trusted = replace(
        start, positions=wall.astype(np.float32), normals=np.float32([[0, 0, -1]]).repeat(len(x), 0)
    )
    curl = np.stack([np.full(12, 9.3), np.arange(0, 6, 0.5), np.full(12, -0.9)], 1)
    between = np.float64([[3.25, 3.25, 0.05], [6.25, 2.25, 0]])
    guessed = np.concatenate([curl, between]).astype(np.float32)
    vertices = np.concatenate([curl + 0.05, between + 0.02, wall + 0.03])
    made = made_of(guessed, vertices, trusted, 0.2)
    assert made[:12].all() and not made[12:].any()
    assert not made_of(guessed[:0], vertices, trusted, 0.2).any()


def test_tatters_at_the_rims_are_cut_off() -> None:
    """Tongues of .6 at one side of a sheet, a bridge as narrow beside a hole; the rest stays."""
    whole = sheet(121, 81, lambda u, v: (12 * u, 8 * v, 0 * u), lambda u, v: (u, v, 0 * u))
    x, y, _ = whole.vertices.T
    tongue = (x > 9.95) & (np.mod(y, 2) > 0.65)
    hole = (x > 4) & (x < 6) & (y > 0.65) & (y < 3)
    mesh = without_fringes(keep_vertices(whole, ~tongue & ~hole), 0.5)
    x, y, _ = mesh.vertices.T
    assert x.max() < 10.3, "tongues"
    assert not ((x > 4.6) & (x < 5.4) & (y < 1)).any(), "a bridge"
    for corner in ((0, 0), (0, 8), (9.9, 8)):
        assert np.hypot(x - corner[0], y - corner[1]).min() < 0.5
    assert len(mesh) > 0.9 * len(keep_vertices(whole, ~hole & (whole.vertices[:, 0] < 9.95)))
    assert without_fringes(mesh, 9.0) is mesh, "nothing is wider than that"
    assert without_fringes(mesh, 0.1) is mesh, "its edges are too long to tell"


@pytest.mark.parametrize("most", [100, 300, 1000])
def test_a_mesh_has_no_more_triangles_than_asked_whatever_its_rims_have(most: int) -> None:
    wave = sheet(300, 60, lambda u, v: (60 * u, 12 * v, np.sin(20 * u)), lambda u, v: (u, v, 0 * u))
    holes = np.stack(np.meshgrid(np.arange(4, 60, 8), [3, 9], [0]), -1).reshape(-1, 3)
    away, _ = cKDTree(holes).query(wave.vertices * (1, 1, 0))
    ragged = keep_vertices(wave, away > 1.2)
    mesh = clean_mesh(ragged, most, 0.02)
    assert mesh is not None and 0.9 * most < len(mesh) <= most
    solid = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    spots, _ = trimesh.sample.sample_surface(solid, 20_000, seed=0)
    off, _ = cKDTree(spots).query(ragged.vertices)
    assert off.mean() < (0.3 if most == 100 else 0.12), "the surface is still there"


def test_a_repaired_surface_has_two_sides() -> None:
    """Some faces look inward, as closed holes and simplification leave them."""
    flat = sheet(20, 20, lambda u, v: (u, v, 0 * u), lambda u, v: (u, v, 0 * u))
    faces = flat.faces.copy()
    inward = np.array([70, 71, 200, 301])
    faces[inward] = faces[inward][:, ::-1]
    spoilt = replace(flat, faces=faces)
    assert (np.flatnonzero(turned_faces(spoilt)) == inward).all()
    mended = repair(spoilt, 10_000, 30)
    assert not turned_faces(mended).any()
    normals = face_normals(mended)
    assert (normals[:, 2] * face_normals(flat)[0, 2] > 0).all()
    area = np.linalg.norm(normals, axis=1).sum() / 2
    assert area == pytest.approx(np.linalg.norm(face_normals(flat), axis=1).sum() / 2)
