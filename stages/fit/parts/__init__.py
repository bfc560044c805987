"""The parts of the fit, in the order in which gradients pass them: from the camera to the scene."""

from stages.fit.parts.base import Part
from stages.fit.parts.density import Density, Isotropic, Mcmc
from stages.fit.parts.floaters import Floaters
from stages.fit.parts.light import Light
from stages.fit.parts.objectives import Depth, Flow, Variation
from stages.fit.parts.picture import Background, Exposure
from stages.fit.parts.poses import Focal, Poses
from stages.fit.parts.progressive import Progressive
from stages.fit.parts.start import Coarse, Filling, Saturation, Shading
from stages.fit.parts.surface import Surface
from stages.fit.parts.warp import Warp

PARTS: tuple[type[Part], ...] = (
    Progressive, Filling, Shading, Saturation, Coarse, Exposure, Background, Depth, Flow, Light,
    Isotropic, Variation, Warp, Mcmc, Surface, Poses, Focal, Density, Floaters,
)  # fmt: skip
