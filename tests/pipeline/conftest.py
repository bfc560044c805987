from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

from toy_fixtures import run, toys

__all__ = ["run", "toys"]
