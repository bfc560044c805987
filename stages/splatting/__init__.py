"""The Gaussian model and the differentiable rasterizer on the CPU.

`render` draws finished Gaussians; `rasterizer.rasterize` is the differentiable function, on numpy
arrays; `torch_api.rasterization` is the same for torch, with the signature of gsplat and a choice
of backends; `reference` says in plain torch what all of them have to give; `loss` and `adam` are
the other kernels of the fit. Imports nothing until a name is used.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from stages.splatting.rendering import RenderedView, render

__all__ = ["RenderedView", "render"]


def __getattr__(name: str) -> Any:
    if name in __all__:
        from stages.splatting import rendering

        return getattr(rendering, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
