"""The stages views, teeth and init on the photographs of an item, for `triads.py`.

The stages run as they are, with two taps: readings of single photographs are kept in a folder, by
the photograph's content and the reader's code, and the fit that `init` rests on is kept whatever
becomes of it.
"""

from __future__ import annotations

import hashlib
import json
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any
from unittest.mock import patch

import numpy as np
import numpy.typing as npt
from triads_data import CASE, SERIES, Item, Photo

from pipeline.artifacts.teeth import Teeth
from pipeline.artifacts.views import View, Views
from pipeline.errors import PipelineError
from pipeline.stage import LocalContext, get_stage
from stages.teeth.read import Reading

if TYPE_CHECKING:
    from stages.init.dental.reconstruct import PlacedTeeth, Reconstruction
    from stages.init.dental.solution import ArchFit
    from stages.views.load import Loaded

Picture = npt.NDArray[np.uint8]
ROOT = Path(__file__).resolve().parent.parent
#: What a reading depends on: the reader's files without those that choose among readings.
READER = ("stages/teeth/*.onnx", "stages/teeth/*.py", "stages/dentition/crowns.py",
          "stages/dentition/tooth_rows.py", "stages/dentition/far_side.py")  # fmt: skip
NO_READER = ("choose.py", "stage.py", "config.py", "__init__.py")


@dataclass(frozen=True)
class Outcome:
    """What the pipeline made of an item.

    Attributes:
        accepted: a scene was made.
        message: why not.
        views: the photographs as they were given to `teeth`.
        read: as the stage `teeth` read them; None where it failed.
        teeth: with the numbers of all photographs together, as far as it came.
        placed: names of the views that are in the scene.
        fit: what `init` rests on, accepted or not; None: it never came to one.
        first_fit: of all photographs, before any was turned over or left out.
        fitted: names of the views in the order of the fit.
        pictures: of `init`.
        seconds: stage -> wall seconds; reading counts as it took when it was done.
        figures: stage -> its summary.
        warnings: of all stages.
    """

    accepted: bool
    message: str
    views: Views
    read: Teeth | None = None
    teeth: Teeth | None = None
    placed: tuple[str, ...] = ()
    fit: ArchFit | None = None
    first_fit: ArchFit | None = None
    fitted: tuple[str, ...] = ()
    pictures: dict[str, Picture] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)
    figures: dict[str, Any] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()


def prepared(loaded: Loaded, mirrored: bool) -> View:
    """The view of a photograph, or of its mirror image."""
    from stages.views.load import prepared_views

    view = prepared_views([loaded])[0]
    return view.mirrored() if mirrored else view


class Runner:
    """Runs items; readings of photographs are kept in a folder.

    Args:
        readings: where they are kept.
        threads: for all stages.
        init: settings of the stage `init`.
    """

    def __init__(self, readings: Path, threads: int, init: dict[str, Any]) -> None:
        self._readings = readings
        self._threads = threads
        self._init = init
        self._code = _digest_of_reader()
        self._reading_seconds = 0.0
        self._fits: list[ArchFit] = []
        self._placed: ArchFit | None = None
        self._photos: dict[tuple[Path, int], Loaded] = {}

    def views_of(self, item: Item) -> tuple[Views, float]:
        """The views of an item, and the seconds that the stage took.

        Photographs of a mix are read one by one, for many mixes share them.
        """
        if item.sort in (CASE, SERIES):
            sources = {photo.path.name: photo.path for photo in item.photos}
            with tempfile.TemporaryDirectory() as scratch:
                context, seconds = self._run("views", Path(scratch), {}, {}, sources)
                return context.result("views"), seconds
        from stages.views.sharpness import SIZES, best_size

        largest = [self._photo(photo, SIZES[0]) for photo in item.photos]
        size = best_size([loaded.picture for loaded in largest])
        views = []
        for number, photo in enumerate(item.photos):
            view = prepared(self._photo(photo, size), photo.mirrored)
            views.append(replace(view, name=f"{number:03d}", source_name=f"{photo.shown}.jpg"))
        return Views(tuple(views)), 0.0

    def _photo(self, photo: Photo, long_side: int) -> Loaded:
        key = photo.path, long_side
        if key not in self._photos:
            from stages.views.load import load_photos

            self._photos[key] = load_photos(
                {photo.path.name: photo.path}, {}, long_side,
                get_stage("views").Config().model_dump()["min_side"],
            )[0]  # fmt: skip
        return self._photos[key]

    def run(self, item: Item) -> Outcome:
        """Photographs in, a scene or a reason out."""
        try:
            views, seconds = self.views_of(item)
        except PipelineError as error:
            if item.sort not in (CASE, SERIES):
                raise  # its photographs are the cases': what can't be read there is no verdict
            return Outcome(False, str(error), Views(()))
        outcome = Outcome(False, "", views, seconds={"views": seconds})
        with tempfile.TemporaryDirectory() as scratch, self._taps():
            try:
                settings = {} if item.sort in (CASE, SERIES) else {"method": "reader"}
                return self._from_views(outcome, settings, Path(scratch))
            except PipelineError as error:
                return replace(outcome, message=str(error))
            except Exception as error:  # said, and the other items still run
                traceback.print_exc()
                return replace(outcome, message=f"FAULT: {type(error).__name__}: {error}")

    def _from_views(self, outcome: Outcome, reader: dict[str, Any], scratch: Path) -> Outcome:
        views = outcome.views
        self._reading_seconds = 0.0
        context, seconds = self._run("teeth", scratch / "teeth", reader, {"views": views}, {})
        read: Teeth = context.result("teeth")
        outcome = replace(
            outcome, read=read, teeth=read, figures={"teeth": context.figures},
            warnings=tuple(context.warnings),
            seconds={**outcome.seconds, "teeth": seconds + self._reading_seconds},
        )  # fmt: skip
        self._fits.clear()
        self._placed = None
        started = time.perf_counter()
        inputs = {"views": views, "teeth": read}
        try:
            context, _ = self._run("init", scratch / "init", self._init, inputs, {})
        except PipelineError as error:
            pictures = dict(getattr(error, "pictures", {}))
            numbered = getattr(error, "artifacts", {}).get("teeth", read)
            outcome = replace(outcome, message=str(error), pictures=pictures, teeth=numbered)
        else:
            folder = scratch / "init"
            outcome = replace(
                outcome, accepted=True,
                teeth=context.result("teeth") if (folder / "teeth").is_dir() else read,
                placed=tuple(camera.name for camera in context.result("cameras").cameras),
                pictures=dict(context.result("pictures").images)
                if (folder / "pictures").is_dir() else {},
                figures={**outcome.figures, "init": context.figures},
                warnings=(*outcome.warnings, *context.warnings),
            )  # fmt: skip
        return replace(
            outcome, fit=self._placed or (self._fits[0] if self._fits else None),
            first_fit=self._fits[0] if self._fits else None,
            fitted=tuple(view.name for view in views.views),
            seconds={**outcome.seconds, "init": time.perf_counter() - started},
        )  # fmt: skip

    def _run(
        self, name: str, folder: Path, settings: dict[str, Any], inputs: dict[str, Any],
        sources: dict[str, Path],
    ) -> tuple[LocalContext, float]:  # fmt: skip
        stage = get_stage(name)
        config = stage.Config.model_validate(settings)
        context = LocalContext(config, folder, inputs, sources, threads=self._threads)
        started = time.perf_counter()
        stage.run(context)
        return context, time.perf_counter() - started

    @contextmanager
    def _taps(self) -> Iterator[None]:
        from stages.init.dental import reconstruct
        from stages.teeth import reader

        fit_arch: Callable[..., ArchFit] = vars(reconstruct)["fit_arch"]
        with_surface = reconstruct.with_surface
        read_photograph: Callable[..., Reading] = vars(reader)["read_photograph"]

        def kept_fit(*args: Any, **kwargs: Any) -> ArchFit:
            self._fits.append(fit_arch(*args, **kwargs))
            return self._fits[-1]

        def kept_placed(teeth: PlacedTeeth, *args: Any) -> Reconstruction:
            self._placed = teeth.small.fit
            return with_surface(teeth, *args)

        def kept_reading(
            image: Any, valid: Any, name: str, quarters: int = 0, **rest: Any
        ) -> Reading:
            def read() -> Reading:
                return read_photograph(image, valid, name, quarters=quarters, **rest)

            made = self._reading(read, image, valid, quarters)
            return replace(made, dentition=replace(made.dentition, name=name))

        with ExitStack() as stack:
            stack.enter_context(patch.object(reconstruct, "fit_arch", kept_fit))
            stack.enter_context(patch.object(reconstruct, "with_surface", kept_placed))
            stack.enter_context(patch.object(reader, "read_photograph", kept_reading))
            yield

    def _reading(
        self, read: Callable[[], Reading], image: Any, valid: Any, quarters: int
    ) -> Reading:
        """A reading from the folder, or made and put there; the same either way."""
        content = hashlib.sha256(self._code + bytes([quarters]))
        content.update(np.ascontiguousarray(image).tobytes())
        content.update(np.packbits(valid).tobytes())
        folder = self._readings / content.hexdigest()[:20]
        if not (folder / "reading.json").exists():
            started = time.perf_counter()
            made = read()
            rest = {f.name: getattr(made, f.name) for f in fields(made) if f.name != "dentition"}
            entry = {"seconds": time.perf_counter() - started, "reading": rest}
            self._readings.mkdir(parents=True, exist_ok=True)
            new = Path(tempfile.mkdtemp(dir=self._readings))
            Teeth((made.dentition,)).save(new)
            (new / "reading.json").write_text(json.dumps(entry))
            with suppress(OSError):  # another process may have read it meanwhile
                new.rename(folder)
        else:
            self._reading_seconds += json.loads((folder / "reading.json").read_text())["seconds"]
        rest = json.loads((folder / "reading.json").read_text())["reading"]
        return Reading(dentition=Teeth.load(folder).views[0], **rest)


def _digest_of_reader() -> bytes:
    content = hashlib.sha256()
    for pattern in READER:
        for path in sorted(ROOT.glob(pattern)):
            if path.name not in NO_READER:
                content.update(path.read_bytes())
    return content.digest()
