"""Dense stereo on the CPU: depth, confidence and normals for every view with a known camera.

Plane sweep with ZNCC, semi-global aggregation, geometric consistency between the views, and a
low-confidence completion where stereo knows nothing. Bytes do not depend on the thread count.
"""
