"""Gaussians as files: the full one, and smaller ones for viewers that know less."""
