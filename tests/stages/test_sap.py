"""Voxel downsampling and scale-adaptive pruning, on clouds with known outliers."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError

from pipeline.artifacts.points import Points
from pipeline.errors import ReconstructionError
from pipeline.geometry.cloud import median_spacing
from pipeline.stage import LocalContext
from stages.sap.budget import reduce_cloud
from stages.sap.downsample import Cloud, voxel_downsample, voxel_size_for
from stages.sap.prune import oversized, survivors
from stages.sap.spacing import point_scales
from stages.sap.stage import SapConfig, SapStage


def sheet(count: int = 4000, seed: int = 0, outliers: int = 0) -> Points:
    """Points on a square of side 1 at z = 1, and far outliers at the end."""
    rng = np.random.default_rng(seed)
    positions = np.column_stack([rng.random((count, 2)), np.ones(count)])
    far = rng.choice([-1, 1], (outliers, 3)) * rng.uniform(3, 6, (outliers, 3))
    positions = np.concatenate([positions, far]).astype(np.float32)
    total = len(positions)
    return Points(
        positions,
        rng.random((total, 3)).astype(np.float32),
        np.tile(np.float32([0, 0, -1]), (total, 1)),
        rng.uniform(2, 9, total).astype(np.float32),
        np.zeros(total, np.float32),
    )


def cloud_of(points: Points) -> Cloud:
    return Cloud(points.positions, points.colors, points.normals, points.confidence)


def run(folder: Path, points: Points, threads: int = 1, **settings) -> LocalContext:
    context = LocalContext(SapConfig(**settings), folder, {"points": points}, threads=threads)
    SapStage().run(context)
    return context


def test_scale_is_the_root_mean_square_distance_to_three_neighbours():
    positions = np.array([[0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3], [50, 0, 0]], np.float32)
    scales = point_scales(positions)
    assert scales[0] == pytest.approx(np.sqrt((1 + 4 + 9) / 3))
    assert scales[4] == pytest.approx(np.sqrt((49**2 + 50**2 + 2504) / 3))
    assert point_scales(np.zeros((4, 3), np.float32)) == pytest.approx(np.sqrt(1e-7))
    assert point_scales(positions[:1]) == pytest.approx(np.sqrt(1e-7))
    assert len(point_scales(positions[:0])) == 0


@pytest.mark.parametrize("unit", [1e-3, 1e3])
def test_what_is_pruned_does_not_depend_on_the_unit_of_the_world(unit):
    positions = np.random.default_rng(0).normal(size=(2000, 3)) / 100
    scales = point_scales(positions)
    np.testing.assert_allclose(point_scales(positions * unit), scales * unit, rtol=1e-5)
    assert oversized(scales).sum() == 2


def test_masks_follow_the_formula():
    scales = np.concatenate([np.full(996, 1.0), [2.0, 3.0, 5.0, 9.0]])
    assert oversized(scales, 0.999).nonzero()[0].tolist() == [999]
    assert oversized(scales, 0.997).nonzero()[0].tolist() == [997, 998, 999]
    # From `large_count` points on: more than 4 times the mean (1.015).
    assert oversized(scales, 0.999, large_count=1000).nonzero()[0].tolist() == [998, 999]
    # M1: never below the mean, whatever the quantile.
    assert oversized(scales, 0.001).nonzero()[0].tolist() == [996, 997, 998, 999]
    assert survivors(scales, "prune", 0.997).sum() == 997
    assert survivors(scales, "keep", 0.997).sum() == 3
    assert survivors(scales, "off", 0.997).all()
    with pytest.raises(ValueError, match="mode"):
        survivors(scales, "both")


def test_voxels_hold_the_confidence_weighted_mean():
    cloud = Cloud(
        np.float32([[0.1, 0.1, 0], [0.3, 0.1, 0], [5, 5, 5]]),
        np.float32([[1, 0, 0], [0, 1, 0], [0, 0, 1]]),
        np.float32([[0, 0, 1], [0, 1, 0], [0, 0, 0]]),
        np.float32([4.0, 2.0, 1.0]),
    )
    merged = voxel_downsample(cloud, 1.0)
    assert len(merged) == 2
    np.testing.assert_allclose(merged.positions[0], [0.15, 0.1, 0], atol=1e-3)
    np.testing.assert_allclose(merged.colors[0], [0.75, 0.25, 0], atol=1e-3)
    np.testing.assert_allclose(np.linalg.norm(merged.normals, axis=1), [1, 0], atol=1e-6)
    np.testing.assert_allclose(merged.positions[1], [5, 5, 5])
    assert merged.confidence[0] == pytest.approx(3.5, abs=1e-2)
    assert merged.confidence[1] == 1


def test_the_voxel_size_meets_the_target():
    points = sheet(5000).positions
    size = voxel_size_for(points, 700, median_spacing(points))
    left = len(voxel_downsample(cloud_of(sheet(5000)), size))
    assert 600 < left <= 700
    assert voxel_size_for(points, 5000, 0.01) == 0
    assert voxel_size_for(points, 1, 0.01) > 0.99


def test_outliers_are_pruned_and_the_surface_stays(tmp_path):
    points = sheet(4000, outliers=4)
    context = run(tmp_path, points, target_points=0, voxel_size=0)
    result = context.result("points")
    assert (np.abs(result.positions[:, 2] - 1) < 1e-6).all()
    assert len(result) >= 3999
    assert context.figures["points_before"] == 4004
    assert context.figures["points_after_downsampling"] == 4004
    assert context.figures["points_after_pruning"] == len(result)
    np.testing.assert_allclose(result.scale, point_scales(result.positions), rtol=1e-6)


def test_modes_and_order(tmp_path):
    points = sheet(4000, outliers=4)
    plain = {"target_points": 0, "voxel_size": 0}
    kept = run(tmp_path / "keep", points, mode="keep", **plain).result("points")
    assert len(kept) in (4, 5)
    assert len(run(tmp_path / "off", points, mode="off", **plain).result("points")) == 4004
    first = run(tmp_path / "first", points, order="prune_first", target_points=1000)
    assert first.figures["points_after_downsampling"] <= 1000
    assert (np.abs(first.result("points").positions[:, 2] - 1) < 1e-6).all()


def test_target_and_voxel_size_reduce(tmp_path):
    context = run(tmp_path / "target", sheet(5000), target_points=800)
    assert 700 < context.figures["points_after_downsampling"] <= 800
    coarse = run(tmp_path / "voxel", sheet(5000), target_points=0, voxel_size=8)
    fine = run(tmp_path / "fine", sheet(5000), target_points=0, voxel_size=4)
    counts = [c.figures["points_after_downsampling"] for c in (coarse, fine)]
    assert counts[0] < counts[1] < 5000


def test_fill_neither_eats_the_budget_nor_vanishes():
    known = cloud_of(sheet(6000, 1))
    back = sheet(9000, 2)
    fill = Cloud(
        back.positions + np.float32([0, 0, 2]), back.colors, back.normals,
        np.full(9000, 1.1, np.float32),
    )  # fmt: skip
    both = Cloud(*(np.concatenate([getattr(known, n), getattr(fill, n)]) for n in vars(known)))
    reduced = reduce_cloud(both, 1.0, 1000, 1.25, 0.15, 1)
    assert 100 < reduced.fill <= 150
    assert 750 < len(reduced.cloud) - reduced.fill <= 850
    assert (reduced.cloud.confidence[-reduced.fill :] <= 1.25).all()
    only_fill = reduce_cloud(fill, 0.0, 1000, 1.25, 0.15, 1)
    assert 850 < only_fill.fill == len(only_fill.cloud) <= 1000
    few_known = reduce_cloud(
        Cloud(*(np.concatenate([getattr(known, n)[:50], getattr(fill, n)]) for n in vars(known))),
        0.0, 1000, 1.25, 0.15, 1,
    )  # fmt: skip
    assert len(few_known.cloud) - few_known.fill == 50
    assert few_known.fill > 700
    without = reduce_cloud(both, 1.0, 1000, 1.25, 0.0, 1)  # no share of the budget is no fill
    assert without.fill == 0 and 850 < len(without.cloud) <= 1000


def test_any_thread_count_gives_the_same_bytes(tmp_path):
    for threads in (1, 2):
        run(tmp_path / str(threads), sheet(3000, outliers=5), threads, target_points=900)
    one, two = (tmp_path / n / "points" / "points.ply" for n in ("1", "2"))
    assert one.read_bytes() == two.read_bytes()


def test_impossible_settings_are_refused():
    for wrong in ({"quantile": 7}, {"quantile": 0}, {"quantile": 1}, {"mode": "both"}, {"q": 0.9}):
        with pytest.raises(ValidationError):
            SapConfig(**wrong)


def test_nothing_left_is_a_diagnosis(tmp_path):
    with pytest.raises(ReconstructionError, match="overlap"):
        run(tmp_path, sheet(10)[np.zeros(10, bool)])
    broken = sheet(5)
    broken.positions[:] = np.nan
    with pytest.raises(ReconstructionError, match="overlap"):
        run(tmp_path, broken)
