"""Train the tooth reader.

    python tools/reader/train.py --data teeth_labelled --mouths FOLDER ... --out reader.pt

A card (`--device cuda`) makes 10 steps of 64 a second if 15 processes make examples for it
(`--workers`); it adds in any order, so that weights differ a little from run to run. Two cores take
about 10 s a step; there the same seed, data, versions and kind of processor give the same weights.
"""

from __future__ import annotations

import argparse
import copy
import time
from pathlib import Path

import cv2
import numpy as np
import torch
from augment import Example, example
from load import load
from network import (
    BORDER,
    CENTRE,
    INSIDE,
    JAW,
    MEANINGS,
    POSITION,
    PRIMARY,
    SHAPES,
    SIDE,
    TOOTH,
    VIEWS,
    Reader,
)  # fmt: skip
from samples import UNNUMBERED, Sample, read_generated, read_labelled
from torch import Tensor
from torch.nn import functional as F  # noqa: N812

#: Primary teeth are rarer among the photographs than among children: each counts as so many.
PRIMARY_WEIGHT = 3.0
#: How often a photograph is drawn: one whose teeth have numbers, and one of those from the side,
#: which are rare and show what tells a molar from a premolar.
NUMBERED, NUMBERED_SIDE = 2.0, 5.0
#: How much oftener one that shows primary teeth.
WITH_PRIMARY = 2.0
#: How often a generated photograph from the side is drawn.
GENERATED_SIDE = 1.5
#: Share of certainty that no place gets: what one sees of a last molar may belong to its neighbour.
SMOOTHING = 0.08
#: Steps from one look at the losses to the next.
TOLD = 5
#: Crowns of fewer pixels of the answer teach no numbers.
LEAST_PIXELS = 12
#: Views from the side.
SIDES = {VIEWS.index("right"), VIEWS.index("left")}


def how_often(sample: Sample) -> float:
    """How often a labelled photograph is drawn."""
    teeth = sample.teeth[sample.teeth > 0]
    numbered = teeth != UNNUMBERED
    if numbered.sum() <= numbered.size / 2:
        return 1.0
    weight = NUMBERED_SIDE if sample.view in SIDES else NUMBERED
    return weight * (WITH_PRIMARY if (teeth[numbered] > 50).any() else 1.0)


class Stream(torch.utils.data.IterableDataset):
    """Endless random examples: real photographs, those with numbers more often; generated ones."""

    def __init__(
        self, real: list[Sample], generated: list[Sample], share: float, seed: int
    ) -> None:
        self.real, self.generated, self.share, self.seed = real, generated, share, seed
        weights = [how_often(sample) for sample in real]
        self.weights = np.array(weights) / sum(weights)
        made = [GENERATED_SIDE if sample.view in SIDES else 1.0 for sample in generated]
        self.made_weights = np.array(made) / max(sum(made), 1.0)

    def __iter__(self):
        worker = torch.utils.data.get_worker_info()
        rng = np.random.default_rng([self.seed, 0 if worker is None else worker.id])
        while True:
            if self.generated and rng.random() < self.share:
                sample = self.generated[rng.choice(len(self.generated), p=self.made_weights)]
            else:
                sample = self.real[rng.choice(len(self.real), p=self.weights)]
            yield example(sample, rng)


def collate(examples: list[Example]) -> dict[str, Tensor]:
    """Examples side by side; the images in half precision, which halves what processes pass on."""
    fields = (
        "image", "tooth", "inside", "border", "centre", "crowns", "number", "valid", "view", "bite",
    )  # fmt: skip
    batch = {
        name: torch.from_numpy(np.stack([np.asarray(getattr(e, name)) for e in examples]))
        for name in fields
    }
    return batch | {"image": batch["image"].half()}


def crown_means(answer: Tensor, batch: dict[str, Tensor]) -> tuple[Tensor, Tensor]:
    """What is said of each crown that has a number, as the reader pools it.

    Returns:
        [n, 11] means of the logits over the crowns, and their [n] FDI numbers.
    """
    count = len(answer)
    device = answer.device
    on_crown = batch["crowns"] > 0
    place = batch["crowns"].long() + 256 * torch.arange(count, device=device)[:, None, None]
    place = place[on_crown]
    weight = batch["inside"][on_crown] + 1e-3
    logits = answer[:, SHAPES : SHAPES + MEANINGS].permute(0, 2, 3, 1)[on_crown]
    logits = torch.cat([logits, torch.ones_like(logits[:, :1])], 1) * weight[:, None]
    sums = torch.zeros(256 * count, MEANINGS + 1, device=device).index_add(0, place, logits)
    pixels = torch.bincount(place, minlength=256 * count)
    number = torch.zeros(256 * count, dtype=torch.long, device=device)
    number[place] = batch["number"][on_crown].long()
    chosen = (pixels >= LEAST_PIXELS) & (number > 0) & (number != UNNUMBERED)
    return sums[chosen, :MEANINGS] / sums[chosen, MEANINGS:], number[chosen]


def losses(answer: Tensor, kind: Tensor, batch: dict[str, Tensor]) -> dict[str, Tensor]:
    """The parts of the loss, weighted."""
    tooth, valid = batch["tooth"], batch["valid"]
    logit = answer[:, TOOTH]
    entropy = F.binary_cross_entropy_with_logits(logit, tooth, reduction="none")
    share = torch.sigmoid(logit) * valid
    dice = 1 - (2 * (share * tooth).sum((1, 2)) + 1) / (share.sum((1, 2)) + tooth.sum((1, 2)) + 1)
    inside = (torch.sigmoid(answer[:, INSIDE]) - batch["inside"]).abs() * valid * (0.3 + tooth)
    border = F.binary_cross_entropy_with_logits(
        answer[:, BORDER], batch["border"], reduction="none",
        pos_weight=torch.tensor(4.0, device=answer.device),
    )  # fmt: skip
    on_tooth = (batch["number"] > 0).float()
    centre = (answer[:, CENTRE] - batch["centre"]).abs().sum(1) * on_tooth
    result = {
        "tooth": (entropy * valid).mean() + 0.5 * dice.mean(),
        "inside": 2 * inside.mean(),
        "border": 0.5 * (border * valid).mean(),
        "centre": 0.2 * centre.sum() / on_tooth.sum().clamp(min=1),
    }
    means, number = crown_means(answer, batch)
    if len(number):
        quadrant = number // 10

        def binary(channel: int, truth: Tensor, weight: float = 1.0) -> Tensor:
            return F.binary_cross_entropy_with_logits(
                means[:, channel - SHAPES], truth.float(),
                pos_weight=torch.tensor(weight, device=means.device),
            )  # fmt: skip

        left = (quadrant == 2) | (quadrant == 3) | (quadrant == 6) | (quadrant == 7)
        lower = (quadrant == 3) | (quadrant == 4) | (quadrant >= 7)
        places = means[:, POSITION.start - SHAPES : POSITION.stop - SHAPES]
        result |= {
            "jaw": 0.3 * binary(JAW, lower),
            "side": 0.3 * binary(SIDE, left),
            "primary": 0.3 * binary(PRIMARY, quadrant >= 5, PRIMARY_WEIGHT),
            "position": 0.6
            * F.cross_entropy(places, (number % 10 - 1).clamp(0, 7), label_smoothing=SMOOTHING),
        }
    if (batch["view"] >= 0).any():
        views = torch.where(batch["view"] >= 0, batch["view"], -100)
        result["view"] = 0.1 * F.cross_entropy(kind[:, : len(VIEWS)], views, ignore_index=-100)
    known = batch["bite"] >= 0
    if known.any():
        result["bite"] = 0.05 * F.binary_cross_entropy_with_logits(
            kind[known, len(VIEWS)], batch["bite"][known].float()
        )
    return result


@torch.no_grad()
def validate(net: Reader, batch: dict[str, Tensor]) -> str:
    """Figures on photographs that were not learned from."""
    images = batch["image"].float()
    parts = [net(images[k : k + 16]) for k in range(0, len(images), 16)]
    answer, kind = torch.cat([p[0] for p in parts]), torch.cat([p[1] for p in parts])
    found = (answer[:, TOOTH] > 0) & (batch["valid"] > 0)
    truth = batch["tooth"] > 0.5
    iou = (found & truth).sum((1, 2)) / (found | truth).sum((1, 2)).clamp(min=1)
    means, number = crown_means(answer.float(), batch)
    quadrant = number // 10
    lower = (quadrant == 3) | (quadrant == 4) | (quadrant >= 7)
    left = (quadrant == 2) | (quadrant == 3) | (quadrant == 6) | (quadrant == 7)
    places = means[:, POSITION.start - SHAPES : POSITION.stop - SHAPES].argmax(1) + 1
    back = number % 10 >= 4

    def right(guess: Tensor, truth: Tensor) -> float:
        return float((guess == truth).float().mean())

    view = kind[:, : len(VIEWS)].argmax(1) == batch["view"]
    return (
        f"IoU {iou.median():.3f}/{iou.quantile(0.1):.3f} "
        f"jaw {right(means[:, JAW - SHAPES] > 0, lower):.3f} "
        f"side {right(means[:, SIDE - SHAPES] > 0, left):.3f} "
        f"primary {right(means[:, PRIMARY - SHAPES] > 0, quadrant >= 5):.3f} "
        f"place {right(places, number % 10):.3f} "
        f"(back {right(places[back], number[back] % 10):.3f}) "
        f"view {view[batch['view'] >= 0].float().mean():.3f}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, required=True, help="folder of teeth_labelled")
    parser.add_argument("--labels", type=Path, help="further tooth numbers (as fdi.json)")
    parser.add_argument("--unlabelled", type=Path, help="folder that unlabelled.py wrote")
    parser.add_argument("--mouths", type=Path, nargs="*", help="folders of generated mouths")
    parser.add_argument("--share", type=float, default=0.4, help="share of generated mouths")
    parser.add_argument("--out", type=Path, default=Path("reader.pt"))
    parser.add_argument("--start", type=Path, help="weights to go on from")
    parser.add_argument("--steps", type=int, default=5500)
    parser.add_argument("--batch", type=int, default=64)
    parser.add_argument("--rate", type=float, default=4e-3)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--device", type=torch.device, default=torch.device("cpu"))
    parser.add_argument("--workers", type=int, default=1, help="processes that make examples")
    arguments = parser.parse_args()

    # Before OpenCV starts threads: processes that are forked from it then would wait for them.
    cv2.setNumThreads(1)
    torch.manual_seed(arguments.seed)
    torch.set_num_threads(arguments.threads)
    device = arguments.device
    real = read_labelled(arguments.data, "train", VIEWS, arguments.labels, arguments.unlabelled)
    held_out = read_labelled(arguments.data, "valid", VIEWS)
    generated = [s for folder in arguments.mouths or [] for s in read_generated(folder, VIEWS)]
    print(f"{len(real)} photographs, {len(generated)} generated, {len(held_out)} to check")
    check = collate([example(sample, None) for sample in held_out])
    loader = iter(
        torch.utils.data.DataLoader(
            Stream(real, generated, arguments.share, arguments.seed), arguments.batch,
            collate_fn=collate, num_workers=arguments.workers, prefetch_factor=6,
            pin_memory=device.type == "cuda",
        )
    )  # fmt: skip
    check = {name: part.to(device) for name, part in check.items()}
    net = load(arguments.start).train() if arguments.start else Reader()
    net = net.to(device, memory_format=torch.channels_last)
    net.tissue.requires_grad_(False)  # `train_tissue.py` teaches it
    print(f"{sum(p.numel() for p in net.parameters()) / 1e6:.2f} million weights", flush=True)
    average = copy.deepcopy(net).eval()
    learning = [part for part in net.parameters() if part.requires_grad]
    optimiser = torch.optim.AdamW(learning, arguments.rate, weight_decay=0.02)
    schedule = torch.optim.lr_scheduler.OneCycleLR(
        optimiser, arguments.rate, total_steps=arguments.steps, pct_start=0.1
    )
    started, told = time.time(), {}
    for step in range(1, arguments.steps + 1):
        batch = {name: part.to(device, non_blocking=True) for name, part in next(loader).items()}
        image = batch["image"].float().contiguous(memory_format=torch.channels_last)
        with torch.autocast(device.type, dtype=torch.bfloat16):
            answer, kind = net(image)
        parts = losses(answer.float(), kind.float(), batch)
        total = sum(parts.values())
        optimiser.zero_grad()
        total.backward()
        torch.nn.utils.clip_grad_norm_(learning, 2.0)
        optimiser.step()
        schedule.step()
        # A mean of the last steps' weights reads better than the last step's.
        decay = min(0.998, step / (step + 10))
        for mean, now in zip(average.state_dict().values(), net.state_dict().values(), strict=True):
            if mean.dtype.is_floating_point:
                mean.lerp_(now, 1 - decay)
            else:
                mean.copy_(now)
        if step % TOLD == 0:
            for name, part in parts.items():
                told[name] = 0.9 * told.get(name, part.item()) + 0.1 * part.item()
        if step % 500 == 0 or step == arguments.steps or step == 20:
            shown = " ".join(f"{name} {value:.3f}" for name, value in told.items())
            print(
                f"{step} {time.time() - started:.0f}s {shown} | {validate(average, check)}",
                flush=True,
            )
            torch.save(average.state_dict(), arguments.out)


if __name__ == "__main__":
    main()
