"""The stage `teeth`: what each photograph shows of the teeth."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pipeline.stage import Stage, StageContext
from stages.teeth.config import TeethConfig


class TeethStage(Stage):
    """Views -> teeth."""

    name = "teeth"
    version = 6
    summary = "read the teeth in each photograph: crowns, jaws, numbers; set aside what is no use"
    Config = TeethConfig
    requires = ("views",)
    provides = ("teeth",)
    prepares = True
    libraries = ("opencv-contrib-python-headless", "numpy", "scipy")
    methods = {  # noqa: RUF012
        "auto": "the reader, where the photographs are few and show teeth",
        "reader": "a small network trained by us, then the order of the teeth in their rows",
        "none": "read nothing",
    }

    def sources(self, config: Any, request: Mapping[str, Any]) -> Mapping[str, Path]:
        from stages.teeth.network import WEIGHTS

        return {} if config.method == "none" else {"reader.onnx": WEIGHTS}

    def run(self, context: StageContext) -> None:
        from pipeline.artifacts.teeth import Dentition, Teeth
        from stages.dentition.overlay import DOUBT_SHOWN, labelled_overlay
        from stages.dentition.working import resized_dentition, working_view
        from stages.teeth.choose import ChoiceOptions, choose
        from stages.teeth.reader import PhotographReader

        config: TeethConfig = context.config
        views = context.load("views").views
        working = [working_view(view) for view in views]
        reader = PhotographReader(working, context.threads)
        wanted = config.method != "none" and (
            config.method == "reader" or (len(views) <= config.most_views and reader.shows_teeth())
        )
        if not wanted:
            size = [(view.width, view.height) for view in views]
            empty = [Dentition(v.name, s, "none") for v, s in zip(views, size, strict=True)]
            context.save(Teeth(tuple(empty)))
            context.summarize(photographs_with_teeth=0)
            return
        readings = reader.read(context.progress)
        options = ChoiceOptions(
            config.least_crowns, config.least_extent, config.least_colour, config.same_view,
            config.least_score,
        )  # fmt: skip
        names = [view.source_name or view.name for view in views]
        images = [view.image for view in working]
        found = (
            choose(readings, images, names, options)
            if config.set_aside
            else [reading.dentition for reading in readings]
        )
        dentitions = [
            resized_dentition(dentition, (view.width, view.height))
            for dentition, view in zip(found, views, strict=True)
        ]
        pictures = {
            view.name: labelled_overlay(view.image, dentition)
            for view, dentition in zip(views, dentitions, strict=True)
        }
        teeth = Teeth(tuple(dentitions), pictures)
        if teeth.chosen:
            for name, dentition in zip(names, dentitions, strict=True):
                if dentition.set_aside:
                    context.warn(f"{name} is not used to place the teeth: {dentition.set_aside}.")
        context.save(teeth)
        crowns = [crown for view in teeth.chosen for crown in view.all_crowns]
        context.summarize(
            photographs_with_teeth=len(teeth.chosen),
            crowns=len(crowns),
            doubtful_crowns=sum(crown.doubt > DOUBT_SHOWN for crown in crowns),
        )
