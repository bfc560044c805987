"""What the photographs show of teeth, gum and what is fixed to them."""
