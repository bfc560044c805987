"""Which spots of which photographs are the same: features, matches, two-view geometry."""
