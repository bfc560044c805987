"""The viewer page of a ball with two teeth, and what scripts on it begin with."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np

from pipeline.artifacts.space.scale import Scale
from pipeline.artifacts.views import to_uint8
from stages.export.pictures.orbits import find_orbit
from stages.export.viewer.knowledge import photographs_that_saw, seen_surfaces
from stages.export.viewer.page import Knowledge, build_page, rasterizer_constants
from stages.splatting.rendering import render
from tests.stages import export_scene as scene

MM = Scale("mm", "length", 2.0).as_dict()
#: The ball's world is y-down: the patient's left is +x, up -y, out -z.
AXES = np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]])


def solid_ball() -> Any:
    ball = scene.ball_gaussians(degree=1)
    opaque = np.full_like(ball.logit_opacities, 6.0)
    return replace(ball, logit_opacities=opaque, log_scales=ball.log_scales + 0.2)


def tooth(number: int, x: float, y: float) -> dict[str, Any]:
    centre = np.array([x, y, -np.sqrt(1 - x * x - y * y)])
    return {
        "fdi": number, "universal": "8" if number == 11 else "25", "doubt": 0.01,
        "jaw": "upper" if number < 30 else "lower", "centre": centre.tolist(),
        "towards": [0, 0, -1],
    }  # fmt: skip


#: As `stages.export.measuring.measures` says that a value is no measurement.
ESTIMATED = {
    "because": "the upper teeth cover the edges", "covered_percent": 38.2,
    "covered_percent_uncertainty": 16.8,
}  # fmt: skip


def measurement(**changes: Any) -> dict[str, Any]:
    return {
        "name": "overjet", "title": "Overjet", "method": "how", "value": 2.5, "uncertainty": 0.4,
        "unit": "mm", "sure": "sure", "doubt": 0.0, "direction": "", "teeth": [11, 41],
        "points": [[0, -0.1, -1], [0, 0.1, -1]], "estimated": None, "not_visible": "",
    } | changes  # fmt: skip


@cache
def ball_page(times: int = 1) -> str:
    """The page of the ball; every photograph is there so many times."""
    ball, cameras = solid_ball(), scene.ball_cameras()
    seen = [render(ball, camera) for camera in cameras]
    surfaces = seen_surfaces(cameras, seen, {})
    jaws = np.where(ball.means[:, 1] < 0, 1, 2).astype(np.uint8)
    triangles = np.array([[0, 1, 2], [1, 3, 2]])
    corners = np.array([[-1, -1, -1.5], [1, -1, -1.5], [-1, 1, -1.5], [1, 1, -1.5]])
    knowledge = Knowledge(
        scale=MM, teeth=[tooth(11, -0.2, -0.2), tooth(41, -0.1, 0.3)],
        measurements=[
            measurement(value=-2.5),
            measurement(name="hidden", title="Overbite", value=None, uncertainty=None,
                        points=None, not_visible="the upper teeth cover the edges"),
            measurement(name="overbite", title="Overbite", value=3.1, uncertainty=2.2,
                        sure="unsure", estimated=ESTIMATED),
            measurement(title="Edge to edge", value=-0.02),
        ],
        axes=AXES, jaws=jaws, seen=photographs_that_saw(ball.means, surfaces),
        mesh=(corners, triangles, np.array([1, 1, 2, 2], np.uint8)),
    )  # fmt: skip
    return build_page(
        ball, cameras * times, find_orbit(cameras * times, [3.0] * 3 * times),
        {camera.name: to_uint8(view.image) for camera, view in zip(cameras, seen, strict=True)},
        rasterizer_constants(ball, cameras), knowledge=knowledge,
    )  # fmt: skip


HEAD = """
const $ = (id) => document.getElementById(id);
const page = window.dentalsplat;
const press = (key, on = document.body, more = {}) =>
  on.dispatchEvent(new KeyboardEvent("keydown", { key, bubbles: true, ...more }));
const said = () => $("live").textContent;
const canvas = $("canvas");
canvas.setPointerCapture = () => {};
const click = (x, y) => {
  for (const type of ["pointerdown", "pointerup"]) {
    canvas.dispatchEvent(new PointerEvent(type,
      { pointerId: 5, clientX: x, clientY: y, button: 0, bubbles: true }));
  }
};
const colours = () => {
  const sums = [0, 0, 0, 0];
  page.pixels().forEach((value, k) => { sums[k % 4] += value; });
  return sums.slice(0, 3);
};
const numbers = () => [...document.querySelectorAll("#drawing .number")].map((n) => n.textContent);
"""
