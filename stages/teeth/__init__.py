"""Each photograph by itself: what it shows, which pixels are teeth, the crowns, their numbers."""
