"""What setup.cfg requires, for `pip install -r`, with Open3D without CUDA where there is one.

    python tools/requirements.py [EXTRA ...]

Nothing here uses Open3D's GPU code, and the wheel without it is a quarter of the download. In
setup.cfg it can't be named: it would write its files over those of an Open3D that is there.
"""

from __future__ import annotations

import configparser
import platform
import re
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

SETUP = Path(__file__).resolve().parents[1] / "setup.cfg"


def requirements(extras: Sequence[str], system: str, machine: str) -> Iterator[str]:
    """The requirements of the package and of some of its extras.

    Args:
        extras: by their names in setup.cfg.
        system, machine: as `platform` names them.

    Raises:
        KeyError: there is no such extra.
    """
    config = configparser.ConfigParser()
    config.read(SETUP)
    listed = [config["options"]["install_requires"]]
    listed += [config["options.extras_require"][extra] for extra in extras]
    without_cuda = (system, machine) == ("Linux", "x86_64")
    for line in "\n".join(listed).split("\n"):
        if line:
            yield re.sub(r"^open3d\b", "open3d-cpu", line) if without_cuda else line


if __name__ == "__main__":
    print("\n".join(requirements(sys.argv[1:], platform.system(), platform.machine())))
