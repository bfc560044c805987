"""Teach the trained reader what is tooth or gum, and what is lip, cheek, or what holds them.

    python tools/reader/train_tissue.py --data teeth_labelled --tissue tissue.json \\
        --mouths FOLDER ... --start stages/teeth/reader.onnx --out reader.pt

Nothing else of the reader changes: all other weights are held. A step of 16 takes about 1.2 s on
two cores, where memory is not given back in between (`MALLOC_MMAP_THRESHOLD_` and
`MALLOC_TRIM_THRESHOLD_` of some GB), else three times that.
"""

from __future__ import annotations

import argparse
import copy
import time
from pathlib import Path

import cv2
import numpy as np
import torch
from augment import example
from load import load
from network import ON_JAWS, VIEWS, Reader
from samples import UNTOLD, Sample, read_generated, read_labelled
from torch import Tensor
from torch.nn import functional as F  # noqa: N812

#: Steps from one line to the next.
TOLD = 50
SIDES = {VIEWS.index("right"), VIEWS.index("left")}
#: How often a photograph from the side is drawn: there lips and cheeks are in the way.
SIDE = 2.0


class Stream(torch.utils.data.IterableDataset):
    """Endless random examples: drawn ones and generated ones."""

    def __init__(self, drawn: list[Sample], made: list[Sample], share: float, seed: int) -> None:
        self.sorts = (drawn, made)
        self.share, self.seed = (share if made else 0.0), seed

    def __iter__(self):
        worker = torch.utils.data.get_worker_info()
        rng = np.random.default_rng([self.seed, 0 if worker is None else worker.id])
        weights = [
            np.array([SIDE if sample.view in SIDES else 1.0 for sample in sort])
            for sort in self.sorts
        ]
        while True:
            sort = int(rng.random() < self.share)
            weight = weights[sort]
            sample = self.sorts[sort][rng.choice(len(weight), p=weight / weight.sum())]
            one = example(sample, rng)
            yield one.image, one.tissue, one.valid


def loss(logit: Tensor, tissue: Tensor, valid: Tensor) -> Tensor:
    """Cross entropy of [N, h, w] where something is said."""
    told = (tissue != UNTOLD).float() * valid
    entropy = F.binary_cross_entropy_with_logits(logit, (tissue == 1).float(), reduction="none")
    return (entropy * told).sum() / told.sum().clamp(min=1)


@torch.no_grad()
def validate(net: Reader, samples: list[Sample]) -> str:
    """Overlap and errors on photographs that were not learned from."""
    ious = []
    for sample in samples:
        one = example(sample, None)
        answer, _ = net(torch.from_numpy(one.image)[None])
        found = answer[0, ON_JAWS].numpy() > 0
        told = (one.tissue != UNTOLD) & (one.valid > 0)
        truth = (one.tissue == 1) & told
        ious.append((found & truth).sum() / max(1, ((found & told) | truth).sum()))
    return f"IoU {np.median(ious):.3f}, 10th percentile {np.quantile(ious, 0.1):.3f}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, required=True, help="folder of teeth_labelled")
    parser.add_argument("--tissue", type=Path, required=True, help="outlines of teeth and gum")
    parser.add_argument("--mouths", type=Path, nargs="*", help="folders of generated mouths")
    parser.add_argument("--share", type=float, default=0.4, help="share of generated mouths")
    parser.add_argument(
        "--start", type=Path, required=True, help="the trained reader, .pt or .onnx"
    )
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--steps", type=int, default=1000)
    parser.add_argument("--batch", type=int, default=16)
    parser.add_argument("--rate", type=float, default=6e-3)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--threads", type=int, default=2)
    arguments = parser.parse_args()

    cv2.setNumThreads(1)  # before OpenCV starts threads that forked processes would wait for
    torch.manual_seed(arguments.seed)
    torch.set_num_threads(arguments.threads)

    def drawn(split: str) -> list[Sample]:
        every = read_labelled(arguments.data, split, VIEWS, tissue=arguments.tissue)
        return [sample for sample in every if (sample.tissue != UNTOLD).any()]

    real, held_out = drawn("train"), drawn("valid")
    made = [s for folder in arguments.mouths or [] for s in read_generated(folder, VIEWS)]
    made = [sample for sample in made if (sample.tissue != UNTOLD).any()]
    print(f"{len(real)} photographs, {len(made)} generated, {len(held_out)} to check", flush=True)
    loader = iter(
        torch.utils.data.DataLoader(
            Stream(real, made, arguments.share, arguments.seed), arguments.batch, num_workers=1,
            prefetch_factor=4,
        )
    )  # fmt: skip
    net = load(arguments.start).to(memory_format=torch.channels_last).requires_grad_(False)
    net.tissue.train().requires_grad_(True)
    average = copy.deepcopy(net).eval()
    optimiser = torch.optim.AdamW(net.tissue.parameters(), arguments.rate, weight_decay=0.02)
    schedule = torch.optim.lr_scheduler.OneCycleLR(
        optimiser, arguments.rate, total_steps=arguments.steps, pct_start=0.1
    )
    started, told = time.time(), 0.0
    for step in range(1, arguments.steps + 1):
        image, tissue, valid = next(loader)
        with torch.autocast("cpu", dtype=torch.bfloat16):
            answer, _ = net(image.contiguous(memory_format=torch.channels_last))
        total = loss(answer[:, ON_JAWS].float(), tissue, valid)
        optimiser.zero_grad()
        total.backward()
        optimiser.step()
        schedule.step()
        decay = min(0.99, step / (step + 10))
        for mean, now in zip(
            average.tissue.state_dict().values(), net.tissue.state_dict().values(), strict=True
        ):
            if mean.dtype.is_floating_point:
                mean.lerp_(now, 1 - decay)
            else:
                mean.copy_(now)
        told = 0.95 * told + 0.05 * total.item() if step > 1 else total.item()
        if step % TOLD == 0 or step == arguments.steps:
            print(
                f"{step} {time.time() - started:.0f}s loss {told:.3f} | "
                f"{validate(average, held_out)}", flush=True,
            )  # fmt: skip
            torch.save(average.state_dict(), arguments.out)


if __name__ == "__main__":
    main()
