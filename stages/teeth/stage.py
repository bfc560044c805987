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
    version = 20
    summary = "read the teeth in each photograph: crowns, jaws, numbers; set aside what is no use"
    Config = TeethConfig
    requires = ("views",)
    provides = ("teeth",)
    prepares = True
    libraries = ("opencv-contrib-python-headless", "numpy", "scipy")
    methods = {  # noqa: RUF012
        "auto": "the reader, on a dozen photographs (teeth.most_views), where some show teeth",
        "reader": "a small network trained by us, then the order of the teeth in their rows",
        "none": "read nothing",
    }

    def sources(self, config: Any, request: Mapping[str, Any]) -> Mapping[str, Path]:
        from stages.teeth.network import WEIGHTS

        return {} if config.method == "none" else {"reader.onnx": WEIGHTS}

    def run(self, context: StageContext) -> None:
        from dataclasses import replace

        from pipeline.artifacts.teeth import UNREAD, Dentition, Teeth
        from stages.dentition.overlay import DOUBT_SHOWN, labelled_overlay
        from stages.dentition.working import resized_dentition, working_view
        from stages.teeth.choose import choose
        from stages.teeth.grey import has_colour, tinted
        from stages.teeth.reader import PhotographReader, evenly

        config: TeethConfig = context.config
        views = context.load("views").views
        found = [Dentition(view.name, (view.width, view.height), UNREAD) for view in views]
        every = list(range(len(views) if config.method != "none" else 0))
        first, spare = every, set[int]()
        if config.method == "auto":  # neighbours in a film show the same teeth
            first = evenly(every, config.most_views)
            spare = {*evenly([k for k in every if k not in first], config.most_views)}
        asked = sorted({*first, *spare})
        working = [working_view(views[k]) for k in asked]
        grey = not any(has_colour(view.image) for view in working)
        if grey:  # with others in colour, one that has none is an X-ray
            working = [replace(view, image=tinted(view.image)) for view in working]
        reader = PhotographReader(working, context.threads)
        places = list(range(len(asked)))
        if config.method == "auto":
            places = reader.worth_reading([k for k in places if asked[k] in spare])
        if not places:
            context.save(Teeth(tuple(found)))
            context.summarize(photographs_with_teeth=0)
            return
        readings = reader.read(context.progress, places)
        read = [asked[place] for place in places]
        names = [views[k].source_name or views[k].name for k in read]
        images = [working[place].image for place in places]
        chosen = (
            choose(readings, images, names)
            if config.set_aside
            else [reading.dentition for reading in readings]
        )
        for k, dentition in zip(read, chosen, strict=True):
            found[k] = resized_dentition(dentition, (views[k].width, views[k].height))
        dentitions = [found[k] for k in read]
        pictures = {views[k].name: labelled_overlay(views[k].image, found[k]) for k in read}
        teeth = Teeth(tuple(found), pictures)
        if any(dentition.all_crowns for dentition in dentitions):
            for name, dentition in zip(names, dentitions, strict=True):
                if dentition.set_aside:
                    context.warn(f"{name} is not used to place the teeth: {dentition.set_aside}.")
        if grey and teeth.chosen:
            context.warn(
                "The photographs have no colour: they are read as black-and-white ones. Nothing "
                "tells black-and-white photographs of two patients apart, and X-rays make no "
                "scene: make sure that these are photographs of one patient."
            )
        context.save(teeth)
        crowns = [crown for view in teeth.chosen for crown in view.all_crowns]
        context.summarize(
            photographs_with_teeth=len(teeth.chosen),
            crowns=len(crowns),
            doubtful_crowns=sum(crown.doubt > DOUBT_SHOWN for crown in crowns),
        )
