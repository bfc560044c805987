"""Every setting is listed with what it may be, and a typo names those nearest to it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Literal

import pytest
from pydantic import BaseModel, Field

from pipeline.config import load_config
from pipeline.errors import RequestError, did_you_mean, nearest
from pipeline.front.settings import in_words, settings
from pipeline.stage import usable_stages


class Inner(BaseModel):
    depth: float = Field(description="how deep")


class Model(BaseModel):
    words: Literal["auto"] | int = "auto"
    share: float | None = Field(None, gt=0, le=1)
    colour: tuple[float, float, float] = (0, 0, 0)
    names: tuple[Annotated[str, Field(min_length=2)], ...] = ()
    widths: dict[int, Annotated[float, Field(gt=2)]] = {}
    inner: Inner | None = None


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("words", "auto | whole number"),
        ("share", "number > 0, ≤ 1 | null"),
        ("colour", "list of 3: number"),
        ("names", "list: text at least 2 of them"),
        ("widths", "map of whole number to number > 2"),
        ("inner", "a section | null"),
    ],
)
def test_types_in_words(name: str, text: str) -> None:
    field = Model.model_fields[name]
    assert in_words(field.annotation, field.metadata) == text


def test_every_setting_has_a_meaning_and_a_default_that_is_json() -> None:
    found = settings()
    assert len({setting.name for setting in found}) == len(found) > 200
    assert not [setting.name for setting in found if not setting.meaning]
    json.dumps([setting.default for setting in found])


def test_names_are_those_that_set_takes() -> None:
    skip = ("init.dental.labels.", "run.stages")
    plain = load_config()
    for setting in settings():
        if not setting.required and not setting.name.startswith(skip):
            assert load_config(None, {setting.name: setting.default}) == plain, setting.name


def test_settings_of_one_stage() -> None:
    names = [setting.name for setting in settings("sap")]
    assert "sap.quantile" in names and all(name.startswith("sap.") for name in names)
    assert [setting.name for setting in settings("run")][1] == "run.seed"
    with pytest.raises(RequestError, match="Did you mean 'align'"):
        settings("algin")


def test_one_setting_and_those_below_a_name() -> None:
    assert [setting.name for setting in settings("fit.iterations")] == ["fit.iterations"]
    dense = [setting.name for setting in settings("init.dense")]
    assert len(dense) > 2 and all(name.startswith("init.dense.") for name in dense)
    for wrong in ("fit.iteratons", "iterations", "fit.iteration"):
        with pytest.raises(RequestError, match=r"no settings of.*Did you mean fit.iterations, "):
            settings(wrong)


def test_a_typo_names_the_nearest_five_and_not_ninety() -> None:
    with pytest.raises(RequestError) as caught:
        load_config(None, ["fit.iteratons=3"])
    message = str(caught.value)
    assert "Did you mean fit.iterations, " in message and "'pipeline settings fit'" in message
    assert message.count("fit.") == 6
    with pytest.raises(RequestError, match=r"Did you mean init.dense.planes, "):
        load_config(None, ["init.dense.plane=3"])
    with pytest.raises(RequestError, match=r"neither a stage.*Did you mean fit.iterations, "):
        load_config(None, ["iterations=3"])


def test_no_names_no_question() -> None:
    assert did_you_mean("x", []) == ""
    assert did_you_mean("a.b", ["a.c"]) == " Did you mean a.c?"


def test_settings_of_toy_stages(toys: Path) -> None:
    assert set(usable_stages()) > {"scale"}
    with pytest.raises(RequestError, match=r"Did you mean scale.factor"):
        load_config(toys / "toy.yaml", ["scale.factr=3"])


def test_capitals_do_not_hide_the_nearest_name() -> None:
    assert nearest("1_FRONTAL.JPG", ["0_right.jpg", "1_frontal.jpg"]) == (
        " Did you mean '1_frontal.jpg'?"
    )
    assert nearest("b.JPG", ["b.jpg", "B.JPG", "c.JPG"]) == " Did you mean 'B.JPG'?"
    assert nearest("xyz", ["front", "right"]) == nearest("a", []) == ""
