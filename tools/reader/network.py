"""The tooth reader's network, in torch: a small residual U-Net with several heads.

It sees a photograph brought to `WIDTH` x `HEIGHT` and answers at half that size. What ships is the
same network with its normalisation folded in, written by `export.py` and run by OpenCV.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812

WIDTH, HEIGHT = 448, 320
#: The answer's channels, in order. Positions run from the central incisor (1) to the third molar.
#: Shape first, then what tooth it is. The border is where two crowns touch. Last, whether it is
#: tooth or gum, and not lip, cheek, or what holds them.
TOOTH, INSIDE, CENTRE, BORDER, JAW, SIDE, PRIMARY, POSITION, ON_JAWS = (
    0, 1, slice(2, 4), 4, 5, 6, 7, slice(8, 16), 16,
)  # fmt: skip
SHAPES, MEANINGS = 5, 11
CHANNELS = SHAPES + MEANINGS + 1
#: What kind of photograph it is, and (last) whether the jaws are apart.
VIEWS = ("front", "right", "left", "upper", "lower", "other")
#: Pixels of the answer in which offsets to the crown's centre are counted.
CENTRE_UNIT = 16.0


class Residual(nn.Module):
    """Two 3x3 convolutions, and the input added."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.first = convolution(width, width)
        self.second = nn.Sequential(
            nn.Conv2d(width, width, 3, 1, 1, bias=False), nn.BatchNorm2d(width)
        )

    def forward(self, x: Tensor) -> Tensor:
        return F.relu(x + self.second(self.first(x)))


def convolution(before: int, after: int, stride: int = 1, size: int = 3) -> nn.Sequential:
    """Convolution, normalisation, ReLU."""
    return nn.Sequential(
        nn.Conv2d(before, after, size, stride, size // 2, bias=False),
        nn.BatchNorm2d(after),
        nn.ReLU(inplace=True),
    )


class Wide(nn.Module):
    """One wide convolution per channel, a mix of the channels, and the input added: it sees far."""

    def __init__(self, width: int, size: int) -> None:
        super().__init__()
        self.spread = nn.Sequential(
            nn.Conv2d(width, width, size, 1, size // 2, groups=width, bias=False),
            nn.BatchNorm2d(width),
        )
        self.mix = convolution(width, 2 * width, size=1)
        self.join = nn.Sequential(nn.Conv2d(2 * width, width, 1, bias=False), nn.BatchNorm2d(width))

    def forward(self, x: Tensor) -> Tensor:
        return F.relu(x + self.join(self.mix(self.spread(x))))


class Tissue(nn.Module):
    """Is it tooth or gum? Read off what the reader has found, from near and far around.

    It is learned last (`train_tissue.py`), and changes nothing of the rest.
    """

    def __init__(self, eighth: int, quarter: int, half: int, width: int = 32) -> None:
        super().__init__()
        self.far = nn.Sequential(convolution(eighth, width, size=1), Wide(width, 9), Wide(width, 9))
        self.near = nn.Conv2d(quarter, width, 1)
        self.join = Residual(width)
        self.here = nn.Conv2d(half, width, 1)
        self.last = nn.Sequential(Residual(width), nn.Conv2d(width, 1, 1))

    def forward(self, eighth: Tensor, quarter: Tensor, half: Tensor) -> Tensor:
        y = self.join(doubled(self.far(eighth)) + self.near(quarter))
        return self.last(doubled(y) + self.here(half))


class Reader(nn.Module):
    """[N, 3, HEIGHT, WIDTH] normalised RGB -> ([N, 17, HEIGHT/2, WIDTH/2], [N, 7]).

    Which tooth it is, is told at an eighth and a quarter of the size, with more channels and a
    wider view than the outlines need.
    """

    def __init__(self, widths: tuple[int, ...] = (24, 48, 96, 160, 224), meaning: int = 64) -> None:
        super().__init__()
        a, b, c, d, e = widths
        self.stem = nn.Sequential(convolution(3, a, 2, 5), convolution(a, a))
        self.down = nn.ModuleList(
            [
                nn.Sequential(convolution(a, b, 2), Residual(b)),
                nn.Sequential(convolution(b, c, 2), Residual(c)),
                nn.Sequential(convolution(c, d, 2), Residual(d), Residual(d)),
                nn.Sequential(convolution(d, e, 2), Residual(e), nn.Dropout2d(0.1)),
            ]
        )
        self.context = nn.Conv2d(e, e, 1)
        self.narrow = nn.ModuleList(
            [nn.Conv2d(x, y, 1) for x, y in ((e, d), (d, c), (c, b), (b, a))]
        )
        self.up = nn.ModuleList([Residual(width) for width in (d, c, b, a)])
        self.shape = nn.Sequential(convolution(a, 32), nn.Conv2d(32, SHAPES, 1))
        self.far = nn.Sequential(
            convolution(c, meaning, size=1), Wide(meaning, 9), Wide(meaning, 9)
        )
        self.near = nn.Conv2d(b, meaning, 1)
        self.meaning = nn.Sequential(Residual(meaning), nn.Conv2d(meaning, MEANINGS, 1))
        self.kind = nn.Conv2d(e, len(VIEWS) + 1, 1)
        self.tissue = Tissue(c, b, a)

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        levels = [self.stem(x)]
        for down in self.down:
            levels.append(down(levels[-1]))
        y = levels.pop()
        whole = F.adaptive_avg_pool2d(y, 1)
        kind = self.kind(whole).flatten(1)
        y = y + F.relu(self.context(whole))
        grown = []
        for narrow, up in zip(self.narrow, self.up, strict=True):
            y = up(doubled(narrow(y)) + levels.pop())
            grown.append(y)
        meaning = self.meaning(doubled(self.far(grown[1])) + self.near(grown[2]))
        tissue = self.tissue(grown[1], grown[2], y)
        return torch.cat([self.shape(y), doubled(meaning), tissue], 1), kind


def doubled(x: Tensor) -> Tensor:
    """Twice as large, bilinear."""
    return F.interpolate(x, scale_factor=2, mode="bilinear", align_corners=False)
