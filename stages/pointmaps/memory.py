"""Will it fit? Memory is estimated before a model is loaded, not found out hours later."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pipeline.errors import RequestError
from stages.pointmaps.interface import ModelCard

#: Bytes of one pair's answer per pixel: a point and its confidence in float32.
_BYTES_PER_PIXEL = 16
_GB = 1e9


def needed_gb(card: ModelCard, model_pixels: Sequence[int], multi_view: bool) -> float:
    """Memory of the device: weights, and the images that are in the model at once.

    Args:
        card: of the model.
        model_pixels: pixels of each prepared image.
        multi_view: all of them are in it at once; else the two largest.
    """
    sizes = sorted(model_pixels, reverse=True)
    at_once = sizes if multi_view else sizes[:2]
    return card.weights_gb + card.gb_per_image * sum(at_once) / card.pixels


def answer_gb(pairs: Sequence[tuple[int, int]], view_pixels: Sequence[int]) -> float:
    """Memory of the pointmaps themselves, which stay in main memory."""
    return sum(view_pixels[i] + view_pixels[j] for i, j in pairs) * _BYTES_PER_PIXEL / _GB


def free_gb(device: Any) -> float | None:
    """Free memory of a torch device; None where it can't be found out."""
    if device.type == "cuda":
        import torch

        return float(torch.cuda.mem_get_info(device)[0]) / _GB
    return free_main_gb()


def free_main_gb() -> float | None:
    """Free main memory (Linux), within the limit of the control group; None if unknown."""
    found = []
    try:
        for line in Path("/proc/meminfo").read_text().splitlines():
            if line.startswith("MemAvailable:"):
                found.append(int(line.split()[1]) * 1024 / _GB)
    except OSError:
        pass
    try:
        group = Path("/sys/fs/cgroup")
        limit = (group / "memory.max").read_text().strip()
        if limit != "max":
            used = int((group / "memory.current").read_text())
            found.append(max(0, int(limit) - used) / _GB)
    except (OSError, ValueError):
        pass
    return min(found) if found else None


def check_memory(
    card: ModelCard,
    device: Any,
    model_gb: float,
    maps_gb: float,
    limit_gb: float | None,
    multi_view: bool,
) -> None:
    """Refuse a run that can't fit.

    Args:
        model_gb: from `needed_gb`, on the device.
        maps_gb: from `answer_gb`, in main memory.
        limit_gb: what the user allows; None: what is free.

    Raises:
        RequestError: what is needed, what there is, and what to reduce.
    """
    on_cpu = device.type == "cpu"
    needed = model_gb + (maps_gb if on_cpu else 0)
    available = free_gb(device) if limit_gb is None else limit_gb
    if available is not None and needed > available:
        fewer = (
            "fewer views"
            if multi_view
            else "smaller images (init.pointmap.long_side)"
            + (
                ", fewer pairs (init.pointmap.graph=window or star, init.pointmap.symmetric=false)"
                if on_cpu
                else ""
            )
        )
        other = "a GPU" if on_cpu else "init.pointmap.device=cpu"
        raise RequestError(
            f"{card.title} needs about {needed:.1f} GB of memory for these photographs, but "
            f"{available:.1f} GB are free on {device}. Use {fewer}, free memory, or {other}; "
            "init.pointmap.max_memory_gb overrides this estimate."
        )
    if not on_cpu and limit_gb is None:
        main = free_main_gb()
        if main is not None and maps_gb > main:
            raise RequestError(
                f"The pointmaps of these photographs take {maps_gb:.1f} GB, but {main:.1f} GB of "
                "main memory are free. Ask for fewer pairs (graph: window or star, symmetric: "
                "false) or fewer views."
            )
