"""Segmentation networks of transformers, made from plain settings."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from models.unet import check_sides
from tangent_train.errors import SettingError
from tangent_train.registry import registered

_Value = bool | int | float | str | None
_Values = _Value | Sequence[_Value | Sequence[_Value | Sequence[_Value]]]
_Section = Mapping[str, _Values | Mapping[str, _Values]]

_NO_ARCHITECTURE = re.compile(
    "_.*|architectures|auto_map|.*_implementation|.*quantization.*|(torch_)?dtype|name_or_path|"
    "trust_remote_code|use_kernels|use_pretrained_backbone|backbone_kwargs|return_dict|"
    "id2label|label2id|num_labels|output_(attentions|hidden_states)|transformers_version"
)
"""Settings that name code, files or labels, or what a network returns."""

_MASK2FORMER = (384, 384)
"""Rows and columns of Mask2Former's masks before they are added, for images of any size
(``Mask2FormerImageProcessor.post_process_semantic_segmentation``)."""


def architecture(config: Mapping[str, Any]) -> dict[str, Any]:
    """The settings of transformers that describe a network, and those of the networks inside it.

    Nothing is left that would fetch or run something: no code of a model's author, no kernels, and
    no backbones by name, except those of timm, which are made without their weights.

    Args:
        config: Content of a ``config.json``, or ``PreTrainedConfig.to_dict``.
    """
    by_name = config.get("model_type") == "timm_backbone"
    return {
        name: _plain(value)
        for name, value in config.items()
        if not _NO_ARCHITECTURE.fullmatch(name) and (by_name or name != "backbone")
    }


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return architecture(value)
    return [_plain(one) for one in value] if isinstance(value, list | tuple) else value


def _patch_size(config: Any) -> int:
    """Side in pixels of the patches of which a network reads whole ones only; 1 without any."""
    inside = getattr(config, "backbone_config", None) or config
    size = getattr(inside, "patch_size", 1)
    return int(size if isinstance(size, int) else max(size))


@registered
class HuggingFaceNetwork(nn.Module):
    """Any network of transformers for semantic or universal segmentation, with random weights.

    Args:
        config: Its `architecture`, with ``model_type``.
        num_classes: Scores K of a pixel.
        bgr: Whether it takes images with blue first, as MobileViT does.
        task: Tokens of "the task is semantic", which OneFormer takes besides images.

    Attributes:
        network: The network as transformers makes it.
        is_universal: True if it gives masks with classes.

    Raises:
        SettingError: There is no such network, or transformers is missing.
    """

    def __init__(
        self,
        config: Mapping[str, _Values | _Section],
        num_classes: int,
        bgr: bool = False,
        task: Sequence[int] | None = None,
    ) -> None:
        super().__init__()
        try:
            from transformers import (
                MODEL_FOR_SEMANTIC_SEGMENTATION_MAPPING,
                MODEL_FOR_UNIVERSAL_SEGMENTATION_MAPPING,
                AutoConfig,
                AutoModelForSemanticSegmentation,
                AutoModelForUniversalSegmentation,
            )
        except ImportError as error:
            raise SettingError(
                "network",
                found=f"a network of transformers ({error})",
                expected="the package transformers, to make it",
                remedy="Run: pip install 'tangent-train[huggingface]'",
            ) from error
        kind = config.get("model_type")
        semantic = {made.model_type for made in MODEL_FOR_SEMANTIC_SEGMENTATION_MAPPING}
        universal = {made.model_type for made in MODEL_FOR_UNIVERSAL_SEGMENTATION_MAPPING}
        if kind not in semantic | universal:
            raise SettingError(
                "network.config.model_type",
                found=kind,
                expected="a network for semantic segmentation "
                f"({', '.join(sorted(semantic | universal))})",
            )
        made = AutoConfig.for_model(**architecture(config), num_labels=num_classes)
        self.is_universal = kind not in semantic
        auto: Any = AutoModelForSemanticSegmentation
        if self.is_universal:
            auto = AutoModelForUniversalSegmentation
        self.network: Any = auto.from_config(made, trust_remote_code=False)
        self._bgr = bgr
        self._patch = _patch_size(made)
        tokens = None if task is None else torch.tensor([list(task)])
        self._task: Tensor | None
        self.register_buffer("_task", tokens, persistent=False)

    def forward(
        self, images: Float[Tensor, "batch channels height width"]
    ) -> Float[Tensor, "batch classes height width"]:
        """Scores of every pixel of the images.

        Of networks for universal segmentation, which give masks with classes, their logarithms: the
        softmax of these is again the share of every class, and sums of classes are those of shares.

        Raises:
            SettingError: The images are not divisible into the network's patches.
        """
        if self._bgr:
            images = torch.cat([images[:, :3].flip(1), images[:, 3:]], dim=1)
        size = (images.shape[-2], images.shape[-1])
        check_sides(images, self._patch, type(self.network).__name__)
        task = {} if self._task is None else {"task_inputs": self._task.expand(len(images), -1)}
        returned = self.network(pixel_values=images, **task)
        masks = returned.get("masks_queries_logits", returned.get("pred_masks"))
        if masks is None:
            return functional.interpolate(returned["logits"], size, mode="bilinear")
        classes = returned.get("class_queries_logits", returned.get("logits"))
        enlarged = {"mask2former": _MASK2FORMER, "eomt": size, "eomt_dinov3": size}
        if before := enlarged.get(self.network.config.model_type):
            masks = functional.interpolate(masks, before, mode="bilinear")
        # Without the last class, "no object".
        of_masks = classes.float().softmax(-1)[..., :-1]
        scores = torch.einsum("bqc,bqhw->bchw", of_masks, masks.float().sigmoid())
        scores = functional.interpolate(scores, size, mode="bilinear")
        return scores.clamp_min(torch.finfo(scores.dtype).tiny).log()
