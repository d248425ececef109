"""Networks of transformers that find what a text names, with fixed texts."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from types import SimpleNamespace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from models.huggingface import architecture, image_processor_class
from models.segments import Segments, front_segments
from tangent_train.errors import check_choice

TEXT_CLASSES = {"clipseg": "CLIPSegForImageSegmentation", "sam3": "Sam3Model"}
"""Class of transformers of each kind of network that takes text."""

_TEXT_TOWER = {
    "clipseg": ("clip.text_model", "clip.text_projection"),
    "sam3": ("text_encoder", "text_projection"),
}
"""Parts that only embed text."""


class PromptedNetwork(nn.Module):
    """CLIPSeg (Lüddecke and Ecker, CVPR 2022) or SAM 3 (Meta, 2025) with the embeddings of prompts.

    The score of a class is the largest logit of its prompts' masks; the last score is the logit of
    the threshold: "none of the classes". SAM 3 also returns objects.

    Args:
        config: `architecture` of the network, with ``model_type``.
        class_of_prompt: ``(P,)`` index of the class of each prompt.
        num_tokens: Number of tokens of an embedding; 0 for a single vector (CLIPSeg).
        threshold: Probability that a class must exceed.

    Attributes:
        network: The network of transformers, without its text tower.
        embeddings: ``(P, D)``, or ``(P, num_tokens, D)``.
        is_token: ``(P, num_tokens)`` False for padding.

    Raises:
        SettingError: The network takes no text.
    """

    embeddings: Tensor
    is_token: Tensor

    def __init__(
        self,
        config: Mapping[str, Any],
        class_of_prompt: Sequence[int],
        num_tokens: int = 0,
        threshold: float = 0.5,
    ) -> None:
        super().__init__()
        self.network = without_text(text_network(config))
        made = self.network.config
        self._class_of_prompt, self._threshold = list(class_of_prompt), threshold
        self._is_sam = made.model_type == "sam3"
        size = made.detr_encoder_config.hidden_size if self._is_sam else made.projection_dim
        side = made.vision_config.image_size
        self.fixed_size = (side, side)
        count = len(self._class_of_prompt)
        shape = (count, num_tokens, size) if num_tokens else (count, size)
        self.register_buffer("embeddings", torch.zeros(shape))
        self.register_buffer("is_token", torch.ones(count, num_tokens, dtype=torch.bool))

    def forward(self, images: Float[Tensor, "batch channels height width"]) -> Any:
        """Return scores ``(batch, K + 1, height, width)``; of SAM 3 a dict with segments too."""
        logits, segments = (self._sam if self._is_sam else self._clipseg)(images)
        classes = range(max(self._class_of_prompt) + 1)
        of_class = [
            logits[:, [p for p, k in enumerate(self._class_of_prompt) if k == each]].amax(1)
            for each in classes
        ]
        least = math.log(self._threshold / (1 - self._threshold))
        scores = torch.stack([*of_class, torch.full_like(of_class[0], least)], dim=1)
        return {"out": scores, "segments": segments} if self._is_sam else scores

    def _clipseg(self, images: Tensor) -> tuple[Tensor, list[Segments]]:
        """Return the logits ``(B, P, h, w)`` of the decoder; the images are encoded once."""
        network, count = self.network, len(self.embeddings)
        states = network.clip.vision_model(images, output_hidden_states=True).hidden_states
        activations = [
            states[layer + 1].repeat_interleave(count, dim=0) for layer in network.extract_layers
        ]
        repeated = self.embeddings.repeat(len(images), 1)
        logits = network.decoder(activations, repeated).logits
        return logits.reshape(len(images), count, *images.shape[-2:]), []

    def _sam(self, images: Tensor) -> tuple[Tensor, list[Segments]]:
        """Return the logits ``(B, P, h, w)`` of the semantic head, and the objects of images."""
        size, batch = (images.shape[-2], images.shape[-1]), len(images)
        seen, logits, found = self.network.get_vision_features(images), [], []
        process = image_processor_class(self.network.config)().post_process_instance_segmentation
        for embedding, is_token in zip(self.embeddings, self.is_token, strict=True):
            text = SimpleNamespace(pooler_output=embedding.expand(batch, -1, -1))
            mask = is_token.expand(batch, -1)
            returned = self.network(vision_embeds=seen, text_embeds=text, attention_mask=mask)
            # As in the library, probabilities are resized.
            shares = functional.interpolate(returned.semantic_seg.sigmoid(), size, mode="bilinear")
            logits.append(shares[:, 0].logit(torch.finfo(shares.dtype).eps))
            found.append(process(returned, target_sizes=[size] * batch))
        segments = [self._segments([of[k] for of in found], size) for k in range(batch)]
        return torch.stack(logits, dim=1), segments

    def _segments(self, found: Sequence[Any], size: tuple[int, int]) -> Segments:
        """Return the objects of one image, see `front_segments`."""
        counts = torch.tensor([len(of["scores"]) for of in found])
        scores = torch.cat([of["scores"] for of in found])
        masks = torch.cat([of["masks"].reshape(-1, *size) for of in found]).bool()
        prompts = torch.tensor(self._class_of_prompt).repeat_interleave(counts).to(scores.device)
        return front_segments(masks, prompts, scores)


def text_network(config: Mapping[str, Any]) -> Any:
    """Return a network of transformers that takes text, with random weights.

    Raises:
        SettingError: There is no such network.
    """
    known = architecture(config)
    check_choice("network.config.model_type", known["model_type"], tuple(TEXT_CLASSES))
    import transformers as hf

    made = hf.AutoConfig.for_model(**known)
    return getattr(hf, TEXT_CLASSES[known["model_type"]])(made)


def without_text(network: Any) -> Any:
    """Remove the parts of a network that only embed text."""
    for name in _TEXT_TOWER[network.config.model_type]:
        parent, _, part = name.rpartition(".")
        delattr(network.get_submodule(parent), part)
    return network


def without_layers(config: Mapping[str, Any]) -> dict[str, Any]:
    """Return a config whose text tower, which is built and removed, has no layers."""
    return {**config, "text_config": {**config["text_config"], "num_hidden_layers": 0}}
