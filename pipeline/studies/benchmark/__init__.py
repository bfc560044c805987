"""Benchmarks: scenes x methods x view counts x seeds through the store, into the paper's tables.

    import pipeline
    results = pipeline.benchmark("smoke", out="runs/smoke")

`suite` reads what is to be measured, `splits` chooses the photographs, `cells` runs, `tables` and
`writing` tell. `results` documents what comes out.
"""

from __future__ import annotations
