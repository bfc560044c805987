"""This pipeline beside COLMAP on the same views: cameras, points, and what a fit makes of them."""
