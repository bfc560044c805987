"""What comes from outside, and what happens around a run, may be anything."""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "pipeline"))

from toy_fixtures import run, toys

__all__ = ["run", "toys"]
