"""The store by itself: commits, replacements that a kill cut in two, leftovers."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.artifacts.metrics import Metrics
from pipeline.errors import RequestError
from pipeline.files import (
    canonical_json,
    content_hash,
    folder_listing,
    read_json,
    temporary_beside,
    write_json,
)
from pipeline.store import Result, Store
from pipeline.store import store as store_module
from pipeline.studies.jobs import results_in

KEY = "a" * 64
FIGURES: dict[str, Any] = {"key_material": {}, "summary": {}, "warnings": []}


def put(store: Store, value: int, key: str = KEY) -> Result:
    folder = store.begin("fit", key)
    (folder / "metrics").mkdir()
    Metrics({"value": value}).save(folder / "metrics")
    return store.commit("fit", key, dict(FIGURES), ["metrics"])


def value_of(store: Store) -> int:
    result = store.find("fit", KEY)
    assert result is not None
    value: int = store.load(result, "metrics").figures["value"]
    return value


def test_commit_is_found_and_loaded(tmp_path: Path) -> None:
    store = Store(tmp_path)
    assert store.find("fit", KEY) is None
    put(store, 1)
    assert value_of(store) == 1
    assert not list(tmp_path.glob("fit/*.partial"))


def test_replacement_has_the_new_bytes(tmp_path: Path) -> None:
    store = Store(tmp_path)
    put(store, 1)
    assert value_of(store) == 1
    put(store, 2)
    assert value_of(store) == 2
    assert [path.name for path in (tmp_path / "fit").iterdir()] == [KEY[:12]]


def test_the_same_bytes_replace_only_the_manifest(tmp_path: Path) -> None:
    store = Store(tmp_path)
    file = put(store, 1).folder / "metrics" / "metrics.json"
    before = file.stat().st_mtime_ns
    put(store, 1)
    assert file.stat().st_mtime_ns == before


def test_kill_between_the_renames_of_a_replacement_loses_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = Store(tmp_path)
    put(store, 1)
    rename = Path.rename

    def killed(path: Path, target: Path) -> Path:
        if path.name.endswith(".partial"):
            raise KeyboardInterrupt
        return rename(path, target)

    monkeypatch.setattr(Path, "rename", killed)
    with pytest.raises(KeyboardInterrupt):
        put(store, 2)
    monkeypatch.undo()
    with store.lock("fit", print):
        assert value_of(store) == 1


def test_clean_removes_leftovers_of_every_kind(tmp_path: Path) -> None:
    store = Store(tmp_path)
    with store.lock("fit", print):
        store.use(put(store, 1))
        put(store, 2, key="b" * 64)
        (store.begin("fit", "c" * 64) / "scratch" / "checkpoint").write_text("half")
        (tmp_path / "fit" / ("d" * 12)).mkdir()  # a result that lost its manifest
    for name in ("for the doctor", f"{'b' * 12}_copy"):
        shutil.copytree(store.folder("fit", "b" * 64), tmp_path / "fit" / name)
    removed, _ = store.clean(keep=0)
    assert sorted(removed) == [f"fit/{'b' * 12}", f"fit/{'c' * 12}.partial", f"fit/{'d' * 12}"]
    assert (tmp_path / "fit" / "for the doctor").is_dir(), "what a user puts there stays"
    assert value_of(store) == 1


def test_content_hash_tells_names_and_bytes(tmp_path: Path) -> None:
    hashes = set()
    for index, (name, text) in enumerate([("a", "1"), ("b", "1"), ("a", "2"), ("sub/a", "1")]):
        folder = tmp_path / str(index)
        (folder / name).parent.mkdir(parents=True)
        (folder / name).write_text(text)
        hashes.add(content_hash(folder_listing(folder)))
    assert len(hashes) == 4


def test_unreadable_json_is_none(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_bytes(b'{"a": ')
    assert read_json(tmp_path / "a.json") is None
    assert read_json(tmp_path / "nothing.json") is None
    write_json(tmp_path / "a.json", {"a": 1})
    assert read_json(tmp_path / "a.json") == {"a": 1}
    assert [path.name for path in tmp_path.iterdir()] == ["a.json"]


VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False)
    | st.text(),
    lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner),
    max_leaves=10,
)  # fmt: skip


@given(st.dictionaries(st.text(), VALUES))
def test_canonical_json_does_not_depend_on_the_order_of_keys(tree: dict[str, Any]) -> None:
    backwards = dict(reversed(list(tree.items())))
    assert canonical_json(tree) == canonical_json(backwards)


def test_what_a_kill_left_half_written_is_removed(tmp_path: Path) -> None:
    """Killed while it wrote the report, the pointer of a stage and a manifest."""
    killed = (
        "import os, pathlib, sys\n"
        "from pipeline.files import write_atomic\n"
        "pathlib.Path.replace = lambda *_: os._exit(9)\n"
        "write_atomic(pathlib.Path(sys.argv[1]), 'half')\n"
    )
    places = [tmp_path / "report.html", tmp_path / "fit" / "current.json",
              tmp_path / "fit" / KEY[:12] / "manifest.json"]  # fmt: skip
    put(Store(tmp_path), 1)
    for place in places:
        subprocess.run([sys.executable, "-c", killed, str(place)], check=False, cwd=Path.cwd())
    assert len(list(tmp_path.rglob("*.tmp"))) == 3
    own = temporary_beside(tmp_path / "report.html")
    elsewhere = own.with_name(own.name.replace(".tmp", "-of-another-machine.tmp"))
    foreign = tmp_path / "fit" / ".notes.tmp"
    for kept in (own, elsewhere, foreign):
        kept.write_text(str(os.getpid()))
    Store(tmp_path).create()
    assert sorted(tmp_path.rglob("*.tmp")) == sorted((own, elsewhere, foreign))
    assert value_of(Store(tmp_path)) == 1


def test_half_a_checkpoint_is_none(tmp_path: Path) -> None:
    store = Store(tmp_path)
    scratch = store.begin("fit", "c" * 64) / "scratch"
    (scratch / "fit.npz.tmp").write_text("half")
    assert not store.has_checkpoint("fit", "c" * 64)
    (scratch / "fit.npz").write_text("whole")
    assert store.has_checkpoint("fit", "c" * 64)


def test_a_run_that_is_killed_while_it_commits_can_go_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = Store(tmp_path)
    (store.begin("fit", KEY) / "scratch" / "fit.npz").write_text("whole")

    def killed(*_: Any) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(store_module, "write_sealed", killed)
        with pytest.raises(KeyboardInterrupt):
            put(store, 1)
    store.discard_outputs("fit", KEY)
    assert store.has_checkpoint("fit", KEY)
    with monkeypatch.context() as patch:
        patch.setattr(store_module, "remove", killed)
        with pytest.raises(KeyboardInterrupt):
            put_beside_scratch(store, 2)
    with store.lock("fit", print):
        assert value_of(store) == 2
        assert not (tmp_path / "fit" / KEY[:12] / "scratch").exists()


def test_nothing_else_is_put_among_results(run: Any, toys: Path) -> None:
    """What lies there goes with them, and `results` is passed on."""
    run()
    home = toys / "w"
    result = Store(home).current("publish")
    assert result is not None
    before = sorted(home.rglob("*"))
    for place in ("results", "results/more", "count", result.folder / "exports"):
        with pytest.raises(RequestError, match=r"results of the workspace .*/w, .* -o"):
            Store(home / place).create()
        with pytest.raises(RequestError, match="another folder"), results_in(home / place):
            pass
    assert sorted(home.rglob("*")) == before
    for place in ("dicom", "more", "register/old"):
        with results_in(home / place):
            assert (home / place).is_dir()
    Store(home / "more").create()
    (home / "circle").symlink_to("circle")
    with (
        pytest.raises(RequestError, match="circle can't be written to"),
        results_in(home / "circle"),
    ):
        pass
    assert set(run().values()) == {"cached"}


def put_beside_scratch(store: Store, value: int) -> Result:
    """As `put`, into the folder as it is."""
    folder = store.root / "fit" / f"{KEY[:12]}.partial"
    (folder / "metrics").mkdir()
    Metrics({"value": value}).save(folder / "metrics")
    return store.commit("fit", KEY, dict(FIGURES), ["metrics"])
