"""The tooth reader's network: what it answers about each pixel of a photograph.

Trained by `tools/reader/train.py`; what it learned from and how well it does says
`docs/tooth_reader.md`. It runs in OpenCV, on the processor, with the same answer on any number of
threads.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float32]
Transform = npt.NDArray[np.float64]  # [2, 3] of points whose pixel centres are at .5

WEIGHTS = Path(__file__).with_name("reader.onnx")
#: Size of what the network sees; it answers at half of it.
WIDTH, HEIGHT = 448, 320
#: Kinds of photographs, as the network knows them.
KINDS = ("front", "right", "left", "upper", "lower", "other")
#: Brightness 0..1 is brought to about zero mean and unit spread.
_MEAN, _SPREAD = 0.45, 0.25
#: Channels of the answer.
_TOOTH, _INSIDE, _CENTRE, _BORDER = 0, 1, slice(2, 4), 4
#: Unit of the way to a crown's centre, pixels of the answer.
_CENTRE_UNIT = np.float32(16)
_JAW, _SIDE, _PRIMARY, _POSITION, _ON_JAWS = 5, 6, 7, slice(8, 16), 16


@dataclass(frozen=True)
class Answer:
    """What the network says of a photograph, in its own frame at half its size (h, w).

    Attributes:
        tooth: [h, w] logit of being tooth.
        inside: [h, w] 0..1, distance to the crown's own border over that of its middle.
        centre: [2, h, w] x and y from each pixel to the middle of its crown, in pixels of the maps.
        border: [h, w] 0..1: two crowns touch here.
        lower, left, primary: [h, w] logits: of the lower jaw, the patient's left, a primary tooth.
        position: [8, h, w] log probability of the place in the quadrant, from the midline.
        on_jaws: [h, w] logit of being tooth or gum; lips, cheeks, and what holds them are not.
        kind: [6] log probability of `KINDS`.
        apart: logit of the jaws being apart.
        answer_from_image: [2, 3] from pixels of the photograph to those of the maps.
    """

    tooth: Array
    inside: Array
    centre: Array
    border: Array
    lower: Array
    left: Array
    primary: Array
    position: Array
    on_jaws: Array
    kind: Array
    apart: float
    answer_from_image: Transform


_of_thread = threading.local()


def _network() -> Any:
    """The network of this thread: one can't be asked by two."""
    if not hasattr(_of_thread, "network"):
        _of_thread.network = cv2.dnn.readNetFromONNX(str(WEIGHTS))
    return _of_thread.network


def fitted(shape: tuple[int, int]) -> Transform:
    """[2, 3] transform that fits a photograph (height, width) into the input's middle."""
    height, width = shape
    scale = min(WIDTH / width, HEIGHT / height)
    return np.array(
        [[scale, 0, (WIDTH - scale * width) / 2], [0, scale, (HEIGHT - scale * height) / 2]]
    )


def look(image: Array, valid: npt.NDArray[np.bool_], transform: Transform, flip: bool) -> Answer:
    """Ask the network about a photograph.

    Args:
        image: [H, W, 3] float32 sRGB in 0..1.
        valid: [H, W] bool: outside, nothing is seen.
        transform: [2, 3] from its pixels to the network's input.
        flip: ask about the mirrored picture too, and take the mean.
    """
    scale = float(np.sqrt(abs(np.linalg.det(transform[:, :2]))))
    if scale < 0.7:
        image = np.asarray(cv2.blur(image, (max(1, round(1 / scale)),) * 2), np.float32)
    whole = transform.copy()  # OpenCV counts pixel centres as whole numbers
    whole[:, 2] += whole[:, :2] @ [0.5, 0.5] - 0.5
    size = (WIDTH, HEIGHT)
    seen = cv2.warpAffine(valid.astype(np.uint8), whole, size, flags=cv2.INTER_NEAREST)
    warped = cv2.warpAffine(image, whole, size, flags=cv2.INTER_LINEAR)
    normal = (np.clip(warped, 0, 1) - _MEAN) / _SPREAD * seen[..., None]
    picture = np.ascontiguousarray(normal.transpose(2, 0, 1)[None], np.float32)
    maps, kind = _forward(picture)
    if flip:
        other, other_kind = _forward(np.ascontiguousarray(picture[..., ::-1]))
        other = other[..., ::-1].copy()
        other[_SIDE] *= -1
        other[_CENTRE][0] *= -1
        half = np.float32(0.5)
        maps = half * (maps + other)
        kind = half * (kind + other_kind[[0, 2, 1, 3, 4, 5, 6]])
    answer_from_image = transform * 0.5
    unseen = seen[::2, ::2] == 0
    maps[_TOOTH, unseen] = maps[_ON_JAWS, unseen] = -20
    return Answer(
        tooth=maps[_TOOTH],
        inside=_sigmoid(maps[_INSIDE]),
        centre=maps[_CENTRE] * _CENTRE_UNIT,
        border=_sigmoid(maps[_BORDER]),
        lower=maps[_JAW],
        left=maps[_SIDE],
        primary=maps[_PRIMARY],
        position=_log_softmax(maps[_POSITION]),
        on_jaws=maps[_ON_JAWS],
        kind=_log_softmax(kind[: len(KINDS)]),
        apart=float(kind[len(KINDS)]),
        answer_from_image=answer_from_image,
    )


def _forward(picture: Array) -> tuple[Array, Array]:
    """[17, h, w] and [7] for one picture [1, 3, HEIGHT, WIDTH]."""
    network = _network()
    network.setInput(picture)
    maps, kind = network.forward(["answer", "kind"])
    return np.array(maps[0], np.float32), np.asarray(kind[0], np.float32)


def _sigmoid(x: Array) -> Array:
    return np.asarray(1 / (1 + np.exp(-np.clip(x, -30, 30))), np.float32)


def _log_softmax(x: Array) -> Array:
    high = x.max(axis=0)
    return np.asarray(x - high - np.log(np.exp(x - high).sum(axis=0)), np.float32)
