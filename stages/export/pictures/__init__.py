"""Orbits around the scene, the video along one, and the preview."""
