"""Not a stage: the geometry of pointmaps that init and align share.

`similarity`: Procrustes, Weiszfeld focal lengths, PnP; `start`: all pairs in one world; `depths`:
one depth map per view from its pairs; `world`: the normalised frame.
"""
