"""The presets of the paper, its baselines and its ablations: what each of them changes."""

from __future__ import annotations

from typing import Any

import pytest

from pipeline.config import Config, load_config
from stages.fit.settings import resolve
from stages.fit.stage import FitStage
from tests.stages.test_fit_trainer import case, context

BASELINES = ("3dgs", "instantsplat", "cf3dgs")
ABLATIONS = {
    "no_sap": {"sap.mode": ("prune", "off")},
    "no_flow": {"fit.lambda_flow": (0.01, 0.0)},
    "no_flow_mask": {"flow.mask": ("consistency", "none")},
    "no_gradient": {"fit.absgrad": ("split", "off")},
}


def flat(config: Config) -> dict[str, Any]:
    """Dotted name -> value, of a whole config."""
    values = {f"run.{name}": value for name, value in config.run.model_dump().items()}
    for section, fields in config.sections.items():
        values |= {f"{section}.{name}": value for name, value in fields.model_dump().items()}
    return values


def differences(one: str, other: str) -> dict[str, tuple[Any, Any]]:
    a, b = flat(load_config(one)), flat(load_config(other))
    return {name: (a[name], b[name]) for name in a if a[name] != b[name]}


@pytest.mark.parametrize("name", sorted(ABLATIONS))
def test_an_ablation_is_the_paper_less_one_thing(name: str) -> None:
    assert differences("paper", name) == ABLATIONS[name]


def test_the_paper_adds_to_3dgs_what_it_says() -> None:
    assert set(differences("3dgs", "paper")) == {
        "run.stages",
        "sap.mode",
        "flow.consistency_relative",
        "flow.consistency_absolute",
        "flow.min_texture",
        "fit.lambda_flow",
        "fit.absgrad",
        "fit.percent_dense",
        "fit.max_gaussians",
        "fit.optimize_poses",
        "fit.pose_lr_init",
        "fit.pose_lr_final",
    }


@pytest.mark.parametrize("name", ["paper", *BASELINES])
def test_nothing_of_our_own_is_in_the_paper_and_its_baselines(name: str) -> None:
    config = load_config(name)
    fit = config.sections["fit"].model_dump()
    off = {
        "light": "none", "headlight": 0.0, "lambda_depth": 0.0, "coarse_fraction": 0.0,
        "hold_surface": False, "warp_levels": 0, "fill_share": 1.0, "trusted_confidence": 1.0,
        "normal_neighbours": 0, "initial_opacity": 0.1, "initial_scale": 1.0, "sh_degree": 3,
        "exposure": False, "strategy": "default", "lambda_tv": 0.0,
    }  # fmt: skip
    assert {key: fit[key] for key in off} == off
    assert fit["saturation"] > 1
    # the same with any number of views: our own schedule does not reach them
    decided = {key for key, value in fit.items() if value == "auto"}
    light = {"light_albedo_lr", "light_normal_lr", "light_strengths", "light_strength_lr"}
    assert decided <= light | {"pose_lr_init", "pose_lr_final", "backend"}
    assert fit["optimize_poses"] is False or not decided & {"pose_lr_init", "pose_lr_final"}
    assert ("flow" in config.run.stages) == (fit["lambda_flow"] > 0)


def test_rates_of_positions_follow_a_schedule_of_30000_iterations() -> None:
    for name in ("3dgs", "paper", "cf3dgs", "instantsplat"):
        settings = resolve(load_config(name).sections["fit"].model_dump(), 6, 0)
        end = 1.6e-4 * 0.01 ** (settings.iterations / 30000)
        assert settings.position_lr_init == 1.6e-4
        assert settings.position_lr_final == pytest.approx(end, rel=1e-3)


@pytest.mark.parametrize("name", ["paper", *BASELINES, *ABLATIONS])
def test_a_preset_runs(tmp_path, name: str) -> None:
    views, cameras, points = case()
    values = load_config(name).sections["fit"].model_dump()
    values |= {"iterations": 24, "densify_from_iter": 5, "densification_interval": 10,
               "initial_points": 1500, "progressive_pose_iterations": 5}  # fmt: skip
    here = context(tmp_path, views, cameras, points, **values)
    FitStage().run(here)
    assert here.figures["gaussians"] > 100
    assert here.figures["train_psnr"] > 8
