"""Structure from motion: cameras and sparse points from features that photographs share."""
