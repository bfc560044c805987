"""The dense surface of teeth and gum, on one chart per jaw."""
