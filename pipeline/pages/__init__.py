"""What pages are made of: parts, tables, charts, pictures, and the run that they tell of."""
