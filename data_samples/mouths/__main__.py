"""Write photographs of synthetic mouths: see `batch`."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from mouths.batch import main

if __name__ == "__main__":
    main()
