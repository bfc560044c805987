"""Figures of a photograph beside its render, and pictures of both."""
