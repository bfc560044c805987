"""Scenes that others made: cameras, COLMAP's models, clouds of points, meshes."""
