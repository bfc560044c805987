"""What the Dockerfile takes for granted, as far as that can be checked without Docker."""

from __future__ import annotations

import configparser
import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
TEXT = (ROOT / "Dockerfile").read_text()


def test_it_copies_what_there_is_and_all_that_is_packaged() -> None:
    copied: set[str] = set()
    for line in re.findall(r"^COPY (.*)$", TEXT, re.MULTILINE):
        copied |= set(line.split()[:-1])
    assert all((ROOT / name).exists() for name in copied)
    config = configparser.ConfigParser()
    config.read(ROOT / "setup.cfg")
    packages = {name.split(".")[0] for name in config["options"]["packages"].split()}
    assert packages | {"configs", "setup.cfg", "constraints.txt"} <= copied
    ignored = (ROOT / ".dockerignore").read_text().splitlines()
    assert {line[1:] for line in ignored if line.startswith("!")} == copied
    assert "*" in ignored, "nothing else goes to the builder: photographs least of all"


def test_its_system_packages_are_those_that_are_needed() -> None:
    script = (ROOT / "tools" / "system-packages").read_text().partition("browser)")[0]
    wanted = set(re.findall(r"\|\| want (\S+)", script)) - {"python3-venv"}
    assert wanted and wanted <= set(TEXT.split())


def test_its_extra_and_command_exist() -> None:
    config = configparser.ConfigParser()
    config.read(ROOT / "setup.cfg")
    (extras,) = re.findall(r"tools/requirements.py ([\w ]+) >", TEXT)
    assert set(extras.split()) <= set(config["options.extras_require"])
    assert "pipeline warmup" in TEXT and 'ENTRYPOINT ["pipeline"]' in TEXT
    assert re.search(r"^USER \d+:\d+$", TEXT, re.MULTILINE), "not root, and no account is needed"


def test_what_it_installs_is_pinned() -> None:
    installs = re.findall(r"pip install .*?(?= \\$|$)", TEXT, re.MULTILINE)
    assert len(installs) == 2
    assert all("--constraint constraints.txt" in install for install in installs)
    assert installs[0].endswith(" requirements.txt") and installs[1].endswith(" --no-deps .")
