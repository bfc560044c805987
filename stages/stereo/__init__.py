"""Dense stereo on the CPU: depth, confidence and normals for every view with a known camera.

Plane sweep with ZNCC, semi-global aggregation, geometric consistency between the views, and a
low-confidence completion where stereo knows nothing. Bytes do not depend on the thread count.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from stages.stereo.options import DenseOptions, DenseView

if TYPE_CHECKING:
    from stages.stereo.reconstruct import dense_depths

__all__ = ["DenseOptions", "DenseView", "dense_depths"]


def __getattr__(name: str) -> Any:
    """Import the kernels when they are asked for: the options alone cost nothing."""
    if name == "dense_depths":
        from stages.stereo.reconstruct import dense_depths

        return dense_depths
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
