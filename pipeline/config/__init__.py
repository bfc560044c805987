"""Settings: what presets and overrides come to, and what is wrong with them."""

from pipeline.config.resolving import (
    DEFAULT_PRESET,
    Config,
    RunConfig,
    anchored,
    flattened,
    load_config,
    parse_override,
    presets,
    read_yaml,
    result_fields,
    yaml_value,
)
from pipeline.config.validating import model_in, validate

__all__ = [
    "DEFAULT_PRESET", "Config", "RunConfig", "anchored", "flattened", "load_config", "model_in",
    "parse_override", "presets", "read_yaml", "result_fields", "validate", "yaml_value",
]  # fmt: skip
