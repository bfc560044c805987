"""`doctor` finds what is broken and says how to mend it."""

from __future__ import annotations

import configparser
import re
from pathlib import Path
from types import SimpleNamespace

import pytest

from pipeline.front import checkup


def by_name(findings: list[checkup.Finding]) -> dict[str, checkup.Finding]:
    return {finding.name: finding for finding in findings}


def test_missing_library_is_a_problem(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(checkup, "LIBRARIES", {"numpy": "numpy", "no-such-thing": "no_such_thing"})
    found = by_name(list(checkup._libraries()))
    assert found["numpy"].level == "ok"
    assert found["no-such-thing"].level == "problem"
    assert "pip install" in found["no-such-thing"].mend


def test_every_extra_of_a_user_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    config = configparser.ConfigParser(interpolation=None)
    config.read(Path(checkup.__file__).resolve().parents[2] / "setup.cfg")
    monkeypatch.setattr(checkup, "LIBRARIES", {})
    told = set(by_name(list(checkup._libraries())))
    for extra in ("torch", "batch", "dicom", "profile"):
        brought = config["options.extras_require"][extra]
        assert told & set(re.findall(r"^[\w-]+", brought, re.MULTILINE)), extra


def test_missing_system_library_names_its_package(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ctypes.util.find_library", lambda name: None)
    found = by_name(list(checkup._system_libraries()))
    assert found["libusb-1.0-0"].level == "problem"
    assert "apt-get install libusb-1.0-0" in found["libusb-1.0-0"].mend


def test_two_cv2_wheels_are_a_problem(monkeypatch: pytest.MonkeyPatch) -> None:
    wheels = [
        SimpleNamespace(metadata={"Name": name})
        for name in ("opencv-python", "opencv-contrib-python-headless", "numpy")
    ]
    monkeypatch.setattr(checkup, "distributions", lambda: wheels)
    (finding,) = checkup._cv2_wheels()
    assert finding.level == "problem"
    assert "opencv-python" in finding.detail and "pip uninstall" in finding.mend
    monkeypatch.setattr(checkup, "distributions", lambda: wheels[1:])
    assert not list(checkup._cv2_wheels())


def test_kernels_that_cannot_be_kept_are_told(monkeypatch: pytest.MonkeyPatch) -> None:
    others = ("_system_libraries", "_libraries", "_gpu", "_stages", "_disk")
    for name in others:
        monkeypatch.setattr(checkup, name, lambda: iter(()))
    assert by_name(checkup.doctor())["kernel cache"].level == "ok"
    monkeypatch.setattr("pipeline.kernels.folder.writable", lambda: None)
    told = by_name(checkup.doctor())["kernel cache"]
    assert told.level == "note" and "NUMBA_CACHE_DIR" in told.mend


def test_no_stages_is_a_problem(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pipeline.stage._entry_points", dict)
    assert any(finding.level == "problem" for finding in checkup._stages())


def test_stages_of_another_version_are_a_problem(monkeypatch: pytest.MonkeyPatch) -> None:
    """An editable installation registers those that there were when it was made."""
    names = [name for name in checkup.stage_names() if name != "teeth"]
    monkeypatch.setattr(checkup, "stage_names", lambda: names)
    found = by_name(list(checkup._stages()))["stage teeth"]
    assert found.level == "problem" and "Install dentalsplat again" in found.mend


def test_every_stage_of_the_project_can_be_imported() -> None:
    findings = list(checkup._stages())
    assert findings[-1].name == "stages" and findings[-1].level == "ok"
    assert not any(finding.level == "problem" for finding in findings)


def test_optional_pointmap_models_are_named_with_their_licence() -> None:
    told = {finding.name: finding for finding in checkup._stages()}
    assert (
        "licen" in told["init.method dust3r"].detail.lower()
        or "CC" in told["init.method dust3r"].detail
    )
    assert "github.com" in told["init.method vggt"].mend
