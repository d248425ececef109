"""What is measured on a GPU; at toy size on a CPU."""

from __future__ import annotations

from typing import Any

__all__ = ["segformer"]


def segformer(quick: bool) -> dict[str, Any]:
    """The config of SegFormer-B0, or of a smaller one."""
    config: dict[str, Any] = {"model_type": "segformer"}
    if quick:
        config |= {"hidden_sizes": [8, 8, 16, 16], "num_attention_heads": [1, 1, 2, 2]}
        config |= {"depths": [1, 1, 1, 1], "decoder_hidden_size": 16}
    return config
