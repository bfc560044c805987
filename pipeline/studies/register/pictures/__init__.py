"""What the photographs of two visits show of a tooth: where its spots are in either."""
