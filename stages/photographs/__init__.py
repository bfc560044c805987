"""What can be measured of a photograph by itself, for every stage that asks."""
