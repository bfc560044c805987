"""The numba kernels of the rasterizer and of the losses: arrays in, arrays out."""
