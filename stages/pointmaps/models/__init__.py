"""One module per pointmap model that a user may have installed."""
