"""The overbite where the lower edges are covered: how good is the estimate?

    python benchmarks/overbite.py [--mouths 100] [--first 0] [--heights 0.09]

Grows permanent dentitions with all sorts of bites, gums and rows, whose crowns are taller or lower
than the textbook's by a factor of their own (`--heights`: its standard deviation, in addition to
that of each tooth), and measures them in three photographs 40 degrees apart, each from 6 degrees
below to 12 above the occlusal plane, with true outlines, cameras and depth.
The estimate's error stands beside the spread of the true values, which is the error of naming the
mean of them all. Reverse bites are left out: there is no estimate of them.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # data_samples and tests

from data_samples.mouths import random_mouth
from pipeline.artifacts.space.scale import Scale
from stages.export.measuring.landmarks import read_landmarks
from stages.export.measuring.measures import measure_mouth
from tests.stages.measured_mouth import photographed, truth

BITES, SHARES = ("normal", "deep", "overjet", "edge"), (0.62, 0.18, 0.12, 0.08)
MM = Scale("mm", "length", 0.0)
UP = np.array([0.0, 1.0, 0.0])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--mouths", type=int, default=100)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--heights", type=float, default=0.09)
    args = parser.parse_args()
    rows, measured, neither = [], [], 0
    for seed in range(args.first, args.first + args.mouths):
        rng = np.random.default_rng(seed)
        mouth = random_mouth(
            rng, dentition="permanent", bite=str(rng.choice(BITES, p=SHARES)),
            missing=(18, 28, 38, 48), braces_upper=False, braces_lower=False,
            crown_height=float(np.exp(args.heights * rng.normal())),
        )  # fmt: skip
        angles = tuple((yaw, float(rng.uniform(-6, 12))) for yaw in (-42.0, 3.0, 40.0))
        reading = read_landmarks(*photographed(mouth, angles))
        entry = next(e for e in measure_mouth(reading, UP, MM) if e["name"] == "overbite")
        true = truth(mouth)["overbite"]
        if entry["value"] is None:
            neither += 1
        elif entry["estimated"]:
            rows.append((true, entry["value"], entry["uncertainty"]))
        else:
            measured.append((true, entry["value"], entry["uncertainty"]))
    for name, found in (("measured", measured), ("estimated", rows)):
        true, value, off = np.array(found).reshape(-1, 3).T
        print(f"{name}: {len(true)}; within the uncertainty: {(abs(value - true) <= off).sum()}")
        if len(true) < 2:
            continue
        print(
            f"  error {np.sqrt(np.mean((value - true) ** 2)):.2f} mm RMS, "
            f"{np.mean(value - true):+.2f} on average; said: {np.median(off):.2f} (19 of 20); "
            f"true: {np.mean(true):.2f} +- {np.std(true):.2f}; r = "
            f"{np.corrcoef(true, value)[0, 1]:.2f}"
        )
    print(f"neither: {neither}")


if __name__ == "__main__":
    main()
