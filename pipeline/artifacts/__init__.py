"""Typed artifacts: what the stages hand to each other, in formats that other tools open."""

from pipeline.artifacts.base import GROUP, KINDS, Artifact, artifact_class, kinds

__all__ = ["GROUP", "KINDS", "Artifact", "artifact_class", "kinds"]
