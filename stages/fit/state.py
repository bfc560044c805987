"""The whole state of a fit, to a checkpoint and back."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from stages.fit.checkpoint import Arrays, load_checkpoint, save_checkpoint
from stages.fit.density import DensityStatistics

if TYPE_CHECKING:
    from stages.fit.trainer import Trainer


def save_state(trainer: Trainer, path: Path) -> None:
    """Write the whole state."""
    arrays: Arrays = {
        "packed": trainer.packed,
        "first": trainer.adam.first,
        "second": trainer.adam.second,
        "signed": trainer.statistics.signed,
        "absolute": trainer.statistics.absolute,
        "seen": trainer.statistics.seen,
        "poses": trainer.poses.poses,
        "pose_first": trainer.poses.first,
        "pose_second": trainer.poses.second,
        "pose_steps": trainer.poses.steps,
        "exposure": trainer.exposure.values,
        "exposure_moments": trainer.exposure.moments,
        "curve": np.array(trainer.curve, np.float64).reshape(-1, 4),
        **trainer.variation.arrays(),
        **(trainer.light.arrays() if trainer.light is not None else {}),
        **(trainer.held_surface.arrays() if trainer.held_surface is not None else {}),
        **(trainer.warp.arrays() if trainer.warp is not None else {}),
    }
    facts = {
        "fingerprint": trainer.fingerprint,
        "iteration": trainer.iteration,
        "adam_steps": trainer.adam.steps,
        "queue": trainer.queue,
        "random": trainer.random.bit_generator.state,
        "loss": trainer.loss,
        "psnr": trainer.psnr,
        "best_loss": trainer.best_loss,
        "focal": trainer.focal.state(),
        "background": trainer.background.state(),
        "progressive": trainer.progressive.state() if trainer.progressive is not None else None,
    }
    save_checkpoint(path, arrays, facts)


def restore_state(trainer: Trainer, path: Path) -> bool:
    """Take up a saved state; False where there is none of this very fit."""
    loaded = load_checkpoint(path)
    if loaded is None or loaded[1].get("fingerprint") != trainer.fingerprint:
        return False
    arrays, facts = loaded
    trainer.packed = arrays["packed"]
    trainer.adam.first, trainer.adam.second = arrays["first"], arrays["second"]
    trainer.adam.steps = facts["adam_steps"]
    trainer.statistics = DensityStatistics(arrays["signed"], arrays["absolute"], arrays["seen"])
    trainer.poses.poses = arrays["poses"]
    trainer.poses.first, trainer.poses.second = arrays["pose_first"], arrays["pose_second"]
    trainer.poses.steps = arrays["pose_steps"]
    trainer.exposure.values = arrays["exposure"]
    trainer.exposure.moments = arrays["exposure_moments"]
    trainer.variation.restore(arrays)
    if trainer.light is not None:
        trainer.light.restore(arrays, facts["adam_steps"])
    if trainer.held_surface is not None:
        trainer.held_surface.restore(arrays)
    if trainer.warp is not None:
        trainer.warp.restore(arrays)
    trainer.focal.restore(facts["focal"])
    trainer.background.restore(facts["background"])
    if trainer.progressive is not None:
        trainer.progressive.restore(facts["progressive"])
    trainer.best_loss = facts["best_loss"]
    trainer.curve = [(int(i), loss, psnr, int(n)) for i, loss, psnr, n in arrays["curve"].tolist()]
    state: Any = facts["random"]
    trainer.random.bit_generator.state = state
    trainer.queue, trainer.iteration = facts["queue"], facts["iteration"]
    trainer.loss, trainer.psnr = facts["loss"], facts["psnr"]
    return True
