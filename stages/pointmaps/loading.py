"""Import what the user has installed, say exactly what is missing, and keep it off the network."""

from __future__ import annotations

import argparse
import importlib
import importlib.util
import socket
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any

from pipeline.errors import RequestError
from pipeline.installed import require
from stages.pointmaps.interface import ModelCard


class NoNetworkError(OSError):
    """Something tried to reach the network while a model was being loaded or run."""


def is_installed(package: str) -> bool:
    """Can the top-level package be found? It is not imported: that may take seconds."""
    if package in sys.modules:
        return True
    try:
        return importlib.util.find_spec(package) is not None
    except (ImportError, ValueError):
        return False


def import_module(
    card: ModelCard, name: str, package: str | None, folder: Path | None
) -> ModuleType:
    """Import a module of the user's installed package.

    Args:
        card: of the model that it belongs to.
        name: dotted name within the package ("model", "utils.pose_enc").
        package: name of the top-level package, if not the usual one.
        folder: a checkout to import from.

    Raises:
        RequestError: not installed, or its own import fails; what to do about it.
    """
    top = package or card.package
    if folder is not None:
        if not folder.is_dir():
            raise RequestError(f"init.pointmap.package_folder: there is no folder {folder}.")
        if str(folder) not in sys.path:
            sys.path.insert(0, str(folder))
            importlib.invalidate_caches()
    if not is_installed(top):
        raise RequestError(
            f"{card.title} is not installed (no Python package '{top}'). Install it into this "
            f"environment: {card.install} (source: {card.repository}). Weights: {card.weights} "
            f"Licences: code {card.code_licence}; weights {card.weights_licence}. Or choose "
            "another init.method; colmap and dental need no model."
        )
    try:
        return importlib.import_module(f"{top}.{name}")
    except ImportError as error:
        raise RequestError(
            f"{card.title} is installed as '{top}', but importing {top}.{name} fails: {error}. "
            f"Install what it lacks ({card.install}), or check that this is the package from "
            f"{card.repository}."
        ) from error


def choose_device(name: str) -> Any:
    """A torch device; "auto" is CUDA if there is one.

    Raises:
        RequestError: no such device here, or no torch.
    """
    require("A pointmap model", "torch", "torch")
    import torch

    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        device = torch.device(name)
    except RuntimeError as error:
        raise RequestError(
            f"init.pointmap.device: there is no device '{name}'; choose auto, cpu, cuda or "
            "cuda:<number>."
        ) from error
    if device.type == "cuda" and not torch.cuda.is_available():
        raise RequestError(
            f"init.pointmap.device: {name} was asked for, but torch {torch.__version__} finds no "
            "CUDA device here. Use init.pointmap.device=cpu, or a build of torch with CUDA."
        )
    return device


def checkpoint_file(card: ModelCard, checkpoint: Path | None, folder_allowed: bool) -> Path | None:
    """Check the path of the weights.

    Raises:
        RequestError: there is nothing at that path.
    """
    if checkpoint is None:
        return None
    there = checkpoint.exists() if folder_allowed else checkpoint.is_file()
    if not there:
        raise RequestError(
            f"There are no weights of {card.title} at {checkpoint}. {card.weights} Then give their "
            "path as init.pointmap.checkpoint."
        )
    return checkpoint


def required_checkpoint(card: ModelCard, checkpoint: Path | None) -> Path:
    """The same for a model whose package can't find weights by itself."""
    path = checkpoint_file(card, checkpoint, folder_allowed=False)
    if path is None:
        raise RequestError(
            f"{card.title} needs the path of its weights (init.pointmap.checkpoint). "
            f"{card.weights} Licence of the weights: {card.weights_licence}."
        )
    return path


@contextmanager
def offline(card: ModelCard) -> Iterator[None]:
    """Load or run a model without the network: whatever it wants must be on this machine.

    Packages fall back on their caches when a connection fails; where there is no cache either, the
    user is told. Checkpoints of the DUSt3R family hold their command-line arguments, which torch
    is allowed to read here (and nothing else beside tensors).

    Raises:
        RequestError: loading failed; why, and how to get the weights.
    """
    import torch

    def refuse(*_: Any, **__: Any) -> Any:
        raise NoNetworkError("no network: models and weights are never downloaded")

    connect, resolve = socket.socket.connect, socket.getaddrinfo
    socket.socket.connect, socket.getaddrinfo = refuse, refuse  # type: ignore[method-assign]
    try:
        with torch.serialization.safe_globals([argparse.Namespace]):
            yield
    except RequestError:
        raise
    except torch.cuda.OutOfMemoryError as error:
        raise RequestError(
            f"The GPU's memory is too small for {card.title} and these photographs. Use fewer or "
            "smaller ones (init.pointmap.long_side), or init.pointmap.device=cpu."
        ) from error
    except Exception as error:
        reason = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
        raise RequestError(
            f"{card.title} could not be loaded or run: {reason} Nothing is downloaded here: "
            f"{card.weights} Check that the weights belong to this version of the package "
            f"({card.repository}); --debug shows where it failed."
        ) from error
    finally:
        socket.socket.connect, socket.getaddrinfo = connect, resolve  # type: ignore[method-assign]


def to_numpy(tensor: Any) -> Any:
    """A tensor (or array) as a float32 array in main memory."""
    import numpy as np

    if hasattr(tensor, "detach"):
        tensor = tensor.detach().float().cpu().numpy()
    return np.asarray(tensor, np.float32)
