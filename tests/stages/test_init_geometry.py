"""Two-view geometry, the pair graph, focal length and mapping, on points projected exactly."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pipeline.artifacts.cameras import Camera
from pipeline.geometry.graph import spanning_pairs
from stages.init.placement import Placement
from stages.init.sfm.focal import better, search_focal
from stages.init.sfm.mapping import MappingInput, Solution, map_views
from stages.init.sfm.matching.features import Features
from stages.init.sfm.matching.two_view import (
    Correspondences,
    Lens,
    TwoView,
    angle_between,
    coherent_matches,
    trusted_edges,
    verify_pair,
)
from stages.init.sfm.options import ClassicalOptions, RefinementOptions
from stages.init.sfm.reconstruct import group_lenses
from stages.init.sfm.refine import refine_solution, with_zoomed
from stages.init.sfm.solver import Solver, known_focal, unknown_focal
from tests.stages.init_scene import FOCAL, HEIGHT, WIDTH, make_scene, orbit, worst_rotation


def edge(rotation, inliers=200, coherence=0.95):
    pose = np.hstack([rotation, [[1], [0], [0]]])
    return TwoView(300, np.arange(inliers), coherence, pose)


def yaw(degrees):
    return Rotation.from_euler("y", degrees, degrees=True).as_matrix()


def test_a_pair_with_false_matches_gives_its_rotation():
    given, poses = make_scene([0, 15])
    camera = given.lenses[0].camera(FOCAL)
    found = verify_pair(
        given.correspondences[0, 1], camera, camera, max_error=2, coherence_radius=40, seed=0
    )
    truth = poses[1][:3, :3] @ poses[0][:3, :3].T
    assert angle_between(found.rotation, truth) < 0.5
    assert 0.7 * 400 < len(found.inliers) < 0.85 * 400
    assert found.coherence > 0.85


def test_random_matches_are_not_believed():
    rng = np.random.default_rng(1)
    pair = rng.uniform(0, 380, (500, 2)), rng.uniform(0, 380, (500, 2))
    matches = Correspondences(np.zeros((500, 2), int), *pair, coherent_matches(*pair, 40.0))
    camera = Lens(WIDTH, HEIGHT).camera(FOCAL)
    found = verify_pair(matches, camera, camera, max_error=2, coherence_radius=40, seed=0)
    assert found is None or not trusted_edges({(0, 1): found}, 2)


def test_coherence_tells_matches_that_move_alone():
    grid = np.stack(np.meshgrid(np.arange(0, 200, 20.0), np.arange(0, 200, 20.0)), -1)
    grid = grid.reshape(-1, 2)
    moved = grid + np.array([30, 2])
    moved[17] += (0, 60)
    coherent = coherent_matches(grid, moved, 40.0)
    assert not coherent[17]
    assert coherent.sum() == len(grid) - 1
    assert not coherent_matches(grid[:2], moved[:2], 40.0).any()


def test_spanning_tree_takes_the_heaviest_edges():
    tree = spanning_pairs({(0, 1): 5.0, (1, 2): 4.0, (0, 2): 3.0, (3, 4): 1.0})
    assert tree == [(0, 1), (1, 2), (3, 4)]


def test_an_edge_that_contradicts_its_cycle_is_dropped():
    edges = {(0, 1): edge(yaw(10)), (1, 2): edge(yaw(10)), (0, 2): edge(yaw(21), 100)}
    assert trusted_edges(edges, 3) == [(0, 1), (0, 2), (1, 2)]
    edges[0, 2] = edge(yaw(45), 100)
    assert trusted_edges(edges, 3) == [(0, 1), (1, 2)]


def test_incoherent_pairs_do_not_link_views():
    edges = {(0, 1): edge(yaw(10)), (1, 2): edge(yaw(10), 70, 0.7)}
    assert trusted_edges(edges, 3) == [(0, 1)]


@pytest.mark.parametrize("method", ["incremental", "global"])
def test_mapping_finds_the_cameras_twice_the_same(method, tmp_path):
    given, poses = make_scene([-20, 0, 15, 30], count=250)
    solver = Solver(given, ClassicalOptions(), 1.0, 0, 1, tmp_path)
    edges = solver.edges_used(None) or solver._edges([FOCAL])
    options = {
        "refine_focal": False, "method": method, "max_error": 2.0, "min_tri_angle": 1.0,
        "seed": 0, "scratch": tmp_path,
    }  # fmt: skip
    first, second = (map_views(given, edges, [FOCAL], **options) for _ in range(2))
    assert sorted(first.poses) == [0, 1, 2, 3]
    assert worst_rotation(first, poses) < 0.2
    assert first.error < 0.6
    assert np.median(first.triangulation_angles()) > 10
    for name in ("points", "observed_point", "observed_view", "residuals"):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name))
    for view, pose in first.poses.items():
        np.testing.assert_array_equal(pose, second.poses[view])


def test_the_focal_length_comes_from_the_views(tmp_path):
    given, poses = make_scene([-22, 0, 20])
    solver = Solver(given, ClassicalOptions(), 1.0, 0, 2, tmp_path)
    solution, determined = unknown_focal(solver, True, lambda *_: None)
    assert determined
    assert solution.focals[0] == pytest.approx(FOCAL, rel=0.03)
    assert worst_rotation(solution, poses) < 0.3


def test_the_other_mapper_is_asked_for_views_that_links_lead_to_only(tmp_path, monkeypatch):
    given, _ = make_scene([-20, 0, 20], count=200)
    alone = replace(
        given, positions=[*given.positions, given.positions[0][:5]], lens_of_view=[0] * 4,
        points=[*given.points, np.arange(5)],
    )  # fmt: skip
    for shown, left_out, asked in ((given, None, []), (alone, None, []), (alone, 2, ["global"])):
        solver = Solver(shown, ClassicalOptions(), 1.0, 0, 1, tmp_path)
        best = solver.solve([FOCAL], False)
        assert sorted(best.poses) == [0, 1, 2]
        poses = {view: pose for view, pose in best.poses.items() if view != left_out}
        mappers = []
        monkeypatch.setattr(solver, "solve", lambda *args, to=mappers: to.append(args[2]))
        solver.with_other_mapper(replace(best, poses=poses), False)
        assert mappers == asked


def test_threads_change_nothing(tmp_path):
    given, _ = make_scene([-15, 0, 15], count=200)
    first, second = (
        unknown_focal(Solver(given, ClassicalOptions(), 1.0, 0, n, tmp_path), True, lambda *_: None)
        for n in (1, 3)
    )
    np.testing.assert_array_equal(first[0].points, second[0].points)
    assert first[0].focals == second[0].focals


def test_a_known_focal_length_is_refined_and_left_only_for_a_good_reason(tmp_path):
    weak, strong = (make_scene(yaws, count=200)[0] for yaws in ([-3, 0, 3], [-25, 0, 25]))
    for given, known, expected in (
        (strong, FOCAL * 1.03, FOCAL),
        (strong, FOCAL * 1.8, FOCAL),  # as in a cropped photograph
        (weak, FOCAL * 1.8, FOCAL * 1.8),
    ):
        lens = replace(given.lenses[0], focal=known)
        solver = Solver(replace(given, lenses=[lens]), ClassicalOptions(), 1.0, 0, 1, tmp_path)
        solution = known_focal(solver, True, lambda *_: None)
        assert solution.focals[0] == pytest.approx(expected, rel=0.02)


def test_a_focal_length_that_exif_decides_stays_in_the_last_adjustment(tmp_path):
    given, poses = make_scene([0, 3, 6], noise=0.5, seed=2)
    given = replace(given, lenses=[replace(given.lenses[0], focal=FOCAL)])
    solver = Solver(given, ClassicalOptions(), 1.0, 0, 1, tmp_path)
    best = known_focal(solver, True, lambda *_: None)
    found = refine_solution(solver, best, True, RefinementOptions())
    assert found.focals[0] == pytest.approx(FOCAL, rel=0.01)
    assert worst_rotation(found, poses) < 0.3


def test_a_photograph_on_its_side_has_the_lens_of_the_others(tmp_path):
    scene, poses = make_scene([-20, 0, 20])
    quarter = np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]])  # anticlockwise
    poses[2] = np.block([[quarter @ poses[2][:3]], [np.eye(4)[3:]]])
    shapes = [(HEIGHT, WIDTH), (HEIGHT, WIDTH), (WIDTH, HEIGHT)]

    def held(view, pixels):
        return pixels[:, ::-1] * (1, -1) + (0, WIDTH) if view == 2 else pixels

    features = [
        Features(
            held(view, pixels), np.zeros((len(pixels), 128), np.float32), np.ones(len(pixels)),
            np.ones(len(pixels)), np.arange(len(pixels)),
        )
        for view, pixels in enumerate(scene.positions)
    ]  # fmt: skip
    matches = {
        (i, j): replace(
            those, positions_i=held(i, those.positions_i), positions_j=held(j, those.positions_j),
            roll_j=-90.0 if j == 2 else 0.0,
        )
        for (i, j), those in scene.correspondences.items()
    }  # fmt: skip
    lenses, of_view = group_lenses(shapes, [None] * 3)
    assert (lenses, of_view) == ([Lens(WIDTH, WIDTH)], [0, 0, 0])
    given = MappingInput.of(lenses, of_view, features, matches, shapes)
    solver = Solver(given, ClassicalOptions(), 1.0, 0, 1, tmp_path)
    found, determined = unknown_focal(solver, True, lambda *_: None)
    assert determined
    assert found.focals[2] == found.focals[0] == pytest.approx(FOCAL, rel=0.02)
    assert worst_rotation(found, poses) < 0.3


@pytest.mark.parametrize("focal", [None, FOCAL])
def test_a_photograph_with_another_zoom_gets_a_lens_of_its_own(tmp_path, focal):
    for zoom in ([1, 1, 1.4, 1, 1], [1, 1, 0.8, 1, 1], [1] * 5):
        given, poses = make_scene([-25, -12, 0, 12, 25], zoom=zoom)
        lens = replace(given.lenses[0], focal=focal)
        solver = Solver(replace(given, lenses=[lens]), ClassicalOptions(), 1.0, 0, 1, tmp_path)
        ratio = FOCAL / lens.long_side
        alike = refine_solution(solver, solver.solve_ratio(ratio, True), True, RefinementOptions())
        apart, found = with_zoomed(solver, alike, True, RefinementOptions())
        assert len(apart.given.lenses) == (1 if zoom == [1] * 5 else 2)
        for view, factor in enumerate(zoom):
            assert found.focals[view] == pytest.approx(FOCAL * factor, rel=0.04)
        assert worst_rotation(found, poses) < 0.3
        assert with_zoomed(solver, alike, False, RefinementOptions()) == (solver, alike)


def solution_with(views, error):
    return Solution(
        {view: np.eye(4) for view in range(views)}, {}, np.zeros((1, 3)), np.zeros(1, int),
        np.zeros(1, int), np.zeros((1, 2)), np.array([error]),
    )  # fmt: skip


def test_focal_search_prefers_views_then_the_minimum_between_candidates():
    def solve(ratio):
        views = 2 if ratio < 0.8 else 3
        return solution_with(views, 0.1 if views == 2 else 0.3 + np.log(ratio / 1.6) ** 2)

    result = search_focal(solve)
    assert result.determined
    assert len(result.solution.poses) == 3
    assert result.ratio == pytest.approx(1.6, rel=0.02)


def test_focal_search_says_when_it_finds_no_minimum():
    result = search_focal(lambda ratio: solution_with(3, 1 / ratio))
    assert not result.determined
    assert search_focal(lambda ratio: None) is None


def test_more_views_are_better_than_small_errors():
    many, few = solution_with(3, 0.9), solution_with(2, 0.1)
    assert better(many, few) is many
    assert better(few, many) is many
    assert better(None, few) is few


def test_the_normalised_world_stands_upright():
    turn = Rotation.from_euler("xyz", [50, 20, 130], degrees=True).as_matrix()
    world = np.random.default_rng(0).normal(size=(500, 3)) * 0.3
    poses = []
    for pose in orbit([-30, 0, 30]):
        moved = np.eye(4)
        moved[:3, :3] = pose[:3, :3] @ turn.T
        moved[:3, 3] = 7 * pose[:3, 3]
        poses.append(moved)
    points = 7 * world @ turn.T
    cameras = tuple(Camera(str(k), 9, 9, 9, 9, 4, 4, pose) for k, pose in enumerate(poses))
    placement = Placement((), cameras, points, (), {}, np.diag([3.0, 3, 3, 1])).normalised()
    new_points, back = placement.points, placement.input_from_world
    np.testing.assert_allclose(new_points @ back[:3, :3].T + back[:3, 3], 3 * points, atol=1e-9)
    new_poses = [camera.cam_from_world for camera in placement.cameras]
    np.testing.assert_allclose(np.median(new_points, axis=0), 0, atol=0.02)
    depths = [new_points @ pose[2, :3] + pose[2, 3] for pose in new_poses]
    assert np.median(np.concatenate(depths)) == pytest.approx(1, abs=0.05)
    assert new_poses[1][1, 1] > 0.99  # the middle camera's down is the world's y
    assert new_poses[1][2, 2] > 0.99
    for old, new in zip(poses, new_poses, strict=True):  # nothing moves in the image
        before, after = points @ old[:3, :3].T + old[:3, 3], new_points @ new[:3, :3].T + new[:3, 3]
        np.testing.assert_allclose(before[:, :2] / before[:, 2:], after[:, :2] / after[:, 2:])
