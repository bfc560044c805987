"""Sixteen numbers at a time inside numba kernels."""
