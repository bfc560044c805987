"""Teeth on a ball whose shape is known, photograph by photograph."""

from dataclasses import replace

import numpy as np

from pipeline.artifacts.teeth import Crown, Dentition, Teeth
from tests.stages import export_scene as scene

#: Where the middles of the crowns lie on the ball (unit vectors of the world, -z to the cameras).
PLACES = {11: (0.1, -0.25, -1.0), 74: (-0.3, 0.3, -1.0)}
CAP = 0.15  # angle from a crown's middle to its border


def cap_outline(camera, direction, count=24):
    """[K, 2] pixels of the border of a round crown on the ball."""
    middle = np.array(direction) / np.linalg.norm(direction)
    across = np.cross(middle, [0, 1.0, 0])
    across /= np.linalg.norm(across)
    angle = np.linspace(0, 2 * np.pi, count, endpoint=False)[:, None]
    ring = np.cos(angle) * across + np.sin(angle) * np.cross(middle, across)
    return camera.project(np.cos(CAP) * middle + np.sin(CAP) * ring)[0]


def crown_at(camera, number, doubt):
    outline = cap_outline(camera, PLACES[number])
    jaw = "upper" if number == 11 else "lower"
    return Crown(
        jaw=jaw, zenith=outline[0], tip=outline[12], papilla_left=None, papilla_right=None,
        embrasure_left=None, embrasure_right=None, width=float(np.ptp(outline[:, 0])),
        height=float(np.ptp(outline[:, 1])), outline=outline,
        number=number, doubt=doubt,
    )  # fmt: skip


def teeth_of_ball():
    """Three placed photographs, one that could not be placed, and one that is set aside."""
    doubts = ((0.02, 0.3), (0.1, 0.15), (0.4, 0.5))
    size = (scene.WIDTH, scene.HEIGHT)
    views = []
    for camera, (upper, lower) in zip(scene.ball_cameras(), doubts, strict=True):
        unsure = replace(crown_at(camera, 11, 1.0), number=0)
        views.append(
            Dentition(
                camera.name, size, "front", (crown_at(camera, 11, upper), unsure),
                (crown_at(camera, 74, lower),),
            )
        )  # fmt: skip
    lost = replace(views[0], name="003")
    same = "it shows the same as Smith John 7.jpg, which is clearer"
    return Teeth((*views, lost, replace(views[0], name="004", set_aside=same)))
