"""Dense stereo on the CPU: depth, confidence and normals for every view with a known camera.

Plane sweep with ZNCC, semi-global aggregation, geometric consistency between the views, and a
low-confidence completion where stereo knows nothing. Bytes do not depend on the thread count.
"""

from stages.init.dense.options import DenseOptions, DenseView
from stages.init.dense.reconstruct import dense_depths

__all__ = ["DenseOptions", "DenseView", "dense_depths"]
