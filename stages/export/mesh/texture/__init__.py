"""Which photograph colours which part of a mesh, and both in one file."""
