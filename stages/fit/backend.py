"""Which rasterizer a fit uses: the processor's, or gsplat's on a card that first proves itself."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from pipeline.errors import RequestError
from stages.fit import trial

if TYPE_CHECKING:
    from stages.fit.trainer import Trainer

#: "auto" takes the card from so many steps times pixels on. An H100 took 8 s to start, and then
#: 200 steps of 1024 x 768 px, half of them at half size, in .9 s less than 16 cores of its machine
#: and 5.6 s less than 4: they are even at 1.4e9 and 2.2e8.
WORTHWHILE = 5e8


def expected_backend(config: Any) -> str:
    """What a fit with this `FitConfig` may run on here: ``"cpu"``, or gsplat on which card.

    A card that is out of order doesn't count, so that what the processor makes in its place is
    never taken for the card's. Which fits ``auto`` leaves to the processor beside a card their
    size says, the same every time.
    """
    if config.backend == "cpu" or _not_on_a_card(config) is not None:
        return "cpu"
    name = trial.card_in_order()
    if name is None and config.backend == "gsplat" and trial.has_card():
        name = trial.name_of_card()  # the fit will say what is wrong with it
    return name or "cpu"


def use_backend(trainer: Trainer) -> str | None:
    """Give a fit that is about to start its rasterizer.

    Returns:
        Why there is a card that is not used; None if all is as it was asked for.

    Raises:
        RequestError: gsplat was asked for and can't be used, or was to be used and no longer can.
    """
    s = trainer.settings
    if s.backend == "cpu" or (s.backend == "auto" and not _worthwhile(trainer)):
        return None
    why = _not_on_a_card(s)
    if why is None and not trial.has_card():
        if s.backend == "auto":
            return None
        why = "there is no gsplat (install dentalsplat[gpu]) or no card that torch can use"
    if why is None:
        why = trial.card_trouble()
        if why is None:
            trainer.rasterize = trial.rasterizer_of_card()
            return None
        if trial.forget_card() and s.backend == "auto":
            # the result would go by the card's name
            raise RequestError(
                f"The graphics card passed its trial before, and no longer does: {why}. Run the "
                "same command again, and the fit runs on the processor; nothing else is lost."
            )
    if s.backend == "gsplat":
        raise RequestError(
            f"fit.backend=gsplat can't be used: {why}. Take fit.backend=cpu, or auto, which uses a "
            "card only where it works."
        )
    return f"The fit ran on the processor although there is a card: {why}."


def _worthwhile(trainer: Trainer) -> bool:
    pixels = max(target[1].width * target[1].height for target in trainer.targets)
    return pixels * trainer.iterations >= WORTHWHILE


def _not_on_a_card(s: Any) -> str | None:
    """Why settings, or a config, can't be had on a card."""
    if s.optimize_focal:
        return "it gives no gradient by the focal length (fit.optimize_focal)"
    if s.progressive is True:
        return "views that are placed one by one are placed by the processor (fit.progressive)"
    return None
