"""The scene as a triangle mesh: fused from what cameras see of it, repaired, written."""
