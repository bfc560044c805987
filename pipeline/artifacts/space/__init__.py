"""Where a scene lies: its scale, and the frames it can be given in."""
