"""Settings of networks from transformers that would fetch or run something."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

CANARY = "tangent_canary"
"""Name of a module, package and repository that only attacks name."""


def undeclared_settings(forbidden: Path) -> Iterator[dict[str, Any]]:
    """Settings for a config of transformers that no network declares."""
    quantizer = {"quant_method": "awq", "bits": 4}
    yield {"quantization_config": quantizer}
    for alias in ("x", "hidden_size", "model_type", "attribute_map"):
        yield {"attribute_map": {alias: "quantization_config"}, "x": quantizer}
    yield {"attribute_map": {"x": "_attn_implementation"}, "x": f"{CANARY}/kernel"}
    yield {"attn_implementation": f"{CANARY}/kernel"}
    yield {"_attn_implementation_internal": f"{CANARY}/kernel", "use_kernels": True}
    yield {"auto_map": {"AutoConfig": f"{CANARY}.Config"}, "trust_remote_code": True}
    yield {"sub_configs_defaults": {"x": {"model_type": "timm_backbone", "backbone": "gpt2"}}}
    yield {"backbone": "gpt2", "use_timm_backbone": False, "use_pretrained_backbone": True}
    yield {"name_or_path": str(forbidden), "_name_or_path": str(forbidden)}
    yield {"per_layer_config": {"0": {"quantization_config": quantizer}}}
    yield {"architectures": [CANARY], "transformers_weights": str(forbidden / "x")}
