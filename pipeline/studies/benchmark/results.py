"""What a benchmark leaves: the shape of ``results.json`` and of ``cells/*.json``.

``results.json``, all of it plain JSON::

    format        1
    title         the suite's
    note          a plain sentence: whose figures stand beside ours, and that the data differ
    suite         the suite as read: scenes, methods, tables (the model `suite.Suite`)
    versions      {"dentalsplat": "0.1.0", "python": ..., "<library>": ...}
    machine       {"processor", "cores", "jobs", "threads"}: cells at a time, threads of each
    cells         [cell, ...] (below), in the order in which they were planned
    tables        [table, ...] (below), in the suite's order
    problems      [text, ...]: what is a fault of ours or of the suite; empty if all went well

A cell is one method on some photographs of one scene; ``DIR/cells/<id>.json`` holds the same::

    id            "scan_video_a-video24-6_views-paper-seed0", with "-known_cameras" if so
    scene, method, preset, protocol, views, seed, known_cameras
    photographs   names of the input files;  held_out  names of the unseen ones that are scored
    workspace     folder of the run, relative to DIR
    status        "done"; "failed": the data could not be reconstructed, which is a result;
                  "fault": a fault of ours; "refused": the request or the suite is wrong
    reason        one paragraph, where status is not "done"
    keys          {stage: key}: what this cell was computed from
    stages        [{"name", "key", "folder" (relative to DIR), "action", "wall_seconds",
                  "cpu_seconds", "peak_memory_mb", "threads", "summary", "warnings"}, ...]
    seconds, cpu_seconds    sums over the stages from the photographs to the scene, as their
                  manifests have them (so a stage that another method had already paid for counts in
                  full); without `evaluate`
    scoring_seconds   the same of `evaluate`
    peak_memory_mb    of the stage that needed most
    registered, total     input views with a camera, and all
    gaussians     how many
    figures       {"input": {...}, "registered": {...}, "refined": {...}}: means over the views of
                  psnr, ssim, lpips (null: no weights), flip, coverage, psnr_mask, ssim_mask, ...;
                  "input" are the training views; the other two are the held-out views with test
                  poses registered, and registered and then refined; absent where not measured
    poses, geometry   as in metrics.json; absent where there is no ground truth
    metrics       metrics.json of this cell, relative to DIR

(A cell that is not done has the entries up to `keys`, and `stages` of what did run.)

A table is one table of the suite with its grids, which are ready to print::

    name, title, form ("views", "photos", "ablations"), protocol, known_cameras
    grids         [{"title", "caption", "columns": [text, ...], "rows": [[text, ...], ...],
                  "footnotes": [text, ...]}, ...]
    conclusions   [sentence, ...]: where the method under test wins and where it does not
    figures       [{"method", "views", "scoring", "figure", "mean", "std", "n", "failed"}, ...]: the
                  numbers behind the grids, over scenes and seeds; std is null where n is 1; scoring
                  is "input", "registered", "refined", "cost", "poses" or "geometry"
"""

from __future__ import annotations

import platform
import sys
from pathlib import Path
from typing import Any

from pipeline.installed import library_version
from pipeline.measure import usable_cores

FORMAT = 1

#: Status of a cell that need not run again as long as nothing that it depends on changes.
FINISHED = ("done", "failed")


def versions_in_use(libraries: set[str]) -> dict[str, str]:
    """Versions of Python, of dentalsplat and of the libraries that stages name."""
    found = {"python": platform.python_version()}
    for name in ("dentalsplat", *sorted(libraries)):
        found[name] = library_version(name)
    return found


def machine(jobs: int, threads: int) -> dict[str, Any]:
    """What the seconds were measured on."""
    processor = platform.processor() or platform.machine()
    if sys.platform == "linux":
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                processor = line.partition(":")[2].strip()
                break
    return {
        "processor": processor,
        "cores": usable_cores(),
        "jobs": jobs,
        "threads": threads,
    }
