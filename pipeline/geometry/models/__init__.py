"""Models that others made: COLMAP's files, `transforms.json`, and whose photographs they mean."""
