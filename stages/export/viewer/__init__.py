"""The viewer page: one HTML file, and how the scene gets into it."""
