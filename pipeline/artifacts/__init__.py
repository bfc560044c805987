"""Typed artifacts: what the stages hand to each other, in formats that other tools open."""

from pipeline.artifacts.base import KINDS, Artifact, artifact_class

__all__ = ["KINDS", "Artifact", "artifact_class"]
