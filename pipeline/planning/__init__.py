"""Which stages a request means, what each would compute from, and why a cached result is stale."""

from pipeline.planning.chain import Chain, Input, Providers, resolve_chain, stage_inputs
from pipeline.planning.keys import key_material, library_version
from pipeline.planning.plan import PlannedStage, changed_sources, plan_chain, plan_stage

__all__ = [
    "Chain", "Input", "PlannedStage", "Providers", "changed_sources", "key_material",
    "library_version", "plan_chain", "plan_stage", "resolve_chain", "stage_inputs",
]  # fmt: skip
