"""A process that makes a page twice draws what is slow once."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.pages import remembered as pages


def test_once_for_the_same_arguments(monkeypatch: pytest.MonkeyPatch) -> None:
    drawn = []

    def draw(values: object, title: str = "") -> object:
        drawn.append(title)
        return object()

    slow = pages.remembered(draw)
    values = np.arange(3)
    monkeypatch.setattr(pages, "_kept", None)
    assert slow(values) is not slow(values)  # nothing is kept unless it was asked for
    pages.remember()
    first = slow(values, title="a")
    assert slow(values.copy(), title="a") is first
    assert slow(values + 1, title="a") is not first
    assert slow(values, title="b") is not first
    assert drawn == ["", "", "a", "a", "b"]
