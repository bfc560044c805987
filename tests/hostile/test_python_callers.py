"""`import dentalsplat` with what is no path, no setting and no stage: one sentence is said."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from enum import Enum
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import dentalsplat
from pipeline.config.asked import each_override, each_stage

NO_PATH = "is to be a text or a pathlib.Path, not "
WRONG: list[tuple[Callable[..., Any], tuple[Any, ...], Mapping[str, Any], str]] = [
    (dentalsplat.run, (None,), {}, f"{NO_PATH}None"),
    (dentalsplat.run, (5,), {}, f"{NO_PATH}5"),
    (dentalsplat.run, (b"photos",), {}, f"{NO_PATH}b'photos'"),
    (dentalsplat.run, ("a\0b",), {}, NO_PATH),
    (dentalsplat.run, ([None],), {}, f"{NO_PATH}None"),
    (dentalsplat.run, (np.zeros((3, 2, 2)),), {}, f"{NO_PATH}array"),
    (dentalsplat.run, ("",), {}, "photograph or folder is empty"),
    (dentalsplat.run, ("p",), {"workspace": 5}, f"workspace {NO_PATH}5"),
    (dentalsplat.run, ("p",), {"workspace": ""}, "workspace is empty"),
    (dentalsplat.run, ("p",), {"preset": {}}, f"preset {NO_PATH}{{}}"),
    (dentalsplat.run, ("p",), {"preset": ""}, "preset is empty"),
    (dentalsplat.run, ("p",), {"overrides": None}, "this is None"),
    (dentalsplat.run, ("p",), {"overrides": 5}, "this is 5"),
    (dentalsplat.run, ("p",), {"overrides": [("a", 1)]}, "texts 'name=value'; this is [('a'"),
    (dentalsplat.run, ("p",), {"overrides": {"a": {1}}}, "'a': {1} is a value of a kind that no"),
    (dentalsplat.run, ("p",), {"overrides": {"a": [Enum]}}, "of a kind that no setting has"),
    (dentalsplat.run, ("p",), {"stages": 5}, "stages are names in a list, or in a text"),
    (dentalsplat.run, ("p",), {"stages": [None]}, "this is [None]"),
    (dentalsplat.run, ("p",), {"from_stage": 5}, "--from 5: the stages of this run are"),
    (dentalsplat.status, (), {"workspace": 5}, f"workspace {NO_PATH}5"),
    (dentalsplat.report, (None,), {}, f"workspace {NO_PATH}None"),
    (dentalsplat.clean, (None,), {}, f"workspace {NO_PATH}None"),
    (dentalsplat.clean, (".",), {"keep": -1}, "keep is a number of results, 0 or more"),
    (dentalsplat.compare, (None,), {}, f"workspace {NO_PATH}None"),
    (dentalsplat.compare, (".",), {"colmap": 5}, f"colmap {NO_PATH}5"),
    (dentalsplat.compare, (".",), {"mesh": ["m.ply"]}, f"mesh {NO_PATH}['m.ply']"),
    (dentalsplat.settings, (5,), {}, "this is 5"),
    (dentalsplat.benchmark, (None,), {}, f"suite {NO_PATH}None"),
    (dentalsplat.benchmark, ("smoke",), {"jobs": 0}, "1 at least; not 0"),
    (dentalsplat.benchmark, ("smoke",), {"overrides": 5}, "this is 5"),
    (dentalsplat.benchmark, ("smoke",), {"out": ""}, "out is empty"),
    (dentalsplat.batch, (5,), {}, f"cases {NO_PATH}5"),
    (dentalsplat.batch, (".",), {"jobs": "2"}, "1 at least; this is '2'"),
    (dentalsplat.batch, (".",), {"keep": "all"}, "keep is workspace or results; this is 'all'"),
    (dentalsplat.batch, (".",), {"memory": "4 GB"}, "memory is a number, 0 or more"),
    (dentalsplat.batch, (".",), {"minutes": -1}, "minutes is a number, 0 or more; this is -1"),
    (dentalsplat.batch, (".",), {"minutes": np.nan}, "this is nan"),
    (dentalsplat.batch, (".",), {"retry": 5}, "retry is 'failed', or names of cases; this is 5"),
]


@pytest.mark.parametrize(("call", "given", "more", "told"), WRONG)
def test_what_is_of_the_wrong_kind_is_refused_in_a_sentence(
    call: Callable[..., Any], given: tuple[Any, ...], more: Mapping[str, Any], told: str,
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    with pytest.raises(dentalsplat.RequestError) as refused:
        call(*given, **more)
    assert told in str(refused.value)
    assert "\n" not in str(refused.value)
    assert not list(tmp_path.iterdir())


def test_values_in_lists_may_be_of_libraries_too() -> None:
    given = {
        "a": [Path("x.jpg"), np.float32(0.5)],
        "b": np.array(["y.jpg"]),
        "c": {"d": np.int8(3)},
    }
    assert each_override(given) == ["a=[x.jpg, 0.5]", "b=[y.jpg]", "c={d: 3}"]
    assert each_override("fit.iterations=5") == ["fit.iterations=5"]
    assert each_stage("init, fit") == ("init", "fit")
    assert each_stage(None) is None
