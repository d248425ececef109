"""Networks of transformers that find what a text names."""

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

TEXT_CLASSES = {"clipseg": "CLIPSegForImageSegmentation", "sam3": "Sam3Model"}
"""Class of transformers of each kind of network that takes text."""


class PromptedNetwork(nn.Module):
    """CLIPSeg (Lüddecke and Ecker, CVPR 2022) or SAM 3 (Meta, 2025) with texts as classes.

    The score of a class is the largest logit of its prompts' masks; the last score is the logit of
    the threshold: "none of the classes". SAM 3 also returns objects. Prompts are embedded by
    `set_prompts`, not in `forward`.

    Args:
        config: `architecture` of the network, with ``model_type``.
        tokenizer_bytes: Size of the tokenizer's description.
        class_of_prompt: ``(P,)`` index of the class of each prompt.
        threshold: Probability that a class must exceed.

    Attributes:
        network: The network of transformers.
        tokenizer: Description of the tokenizer (``tokenizer.json``), as UTF-8, with its padding.
        embeddings: ``(P, D)``, or for SAM 3 ``(P, N, D)`` of N tokens.
        is_token: ``(P, N)`` False for padding.
    """

    tokenizer: Tensor
    embeddings: Tensor
    is_token: Tensor

    def __init__(
        self,
        config: Mapping[str, Any],
        tokenizer_bytes: int,
        class_of_prompt: Sequence[int] = (),
        threshold: float = 0.5,
    ) -> None:
        super().__init__()
        import transformers as hf

        made = hf.AutoConfig.for_model(**architecture(config))
        self.network: Any = getattr(hf, TEXT_CLASSES[made.model_type])(made)
        self._class_of_prompt, self._threshold = list(class_of_prompt), threshold
        self._is_sam = made.model_type == "sam3"
        side = made.vision_config.image_size
        self.fixed_size = (side, side)
        tokens = len(self._class_of_prompt), made.text_config.max_position_embeddings
        size = made.detr_encoder_config.hidden_size if self._is_sam else made.projection_dim
        shape = (*tokens, size) if self._is_sam else (tokens[0], size)
        self.register_buffer("tokenizer", torch.zeros(tokenizer_bytes, dtype=torch.uint8))
        self.register_buffer("embeddings", torch.zeros(shape))
        self.register_buffer("is_token", torch.ones(tokens, dtype=torch.bool))

    @torch.no_grad()
    def set_prompts(
        self, prompts: Mapping[str, Sequence[str]] | None, threshold: float | None = None
    ) -> dict[str, Any]:
        """Replace the prompts or the threshold; return the changed arguments of the class.

        Args:
            prompts: Texts of each class by its name; None to keep them.
            threshold: Probability that a class must exceed; None to keep it.
        """
        self._threshold = threshold or self._threshold
        if prompts is not None:
            from tokenizers import Tokenizer

            tokenizer = Tokenizer.from_str(self.tokenizer.numpy(force=True).tobytes().decode())
            length = self.is_token.shape[1]
            tokenizer.enable_truncation(length)
            tokenizer.enable_padding(**{**(tokenizer.padding or {}), "length": length})
            tokens = tokenizer.encode_batch([text for of in prompts.values() for text in of])
            device = self.tokenizer.device
            ids = torch.tensor([of.ids for of in tokens], device=device)
            mask = torch.tensor([of.attention_mask for of in tokens], device=device)
            of_text = self.network if self._is_sam else self.network.clip
            returned = of_text.get_text_features(ids, attention_mask=mask)
            self.embeddings, self.is_token = returned.pooler_output, mask > 0
            self._class_of_prompt = [k for k, of in enumerate(prompts.values()) for _ in of]
        return {"class_of_prompt": self._class_of_prompt, "threshold": self._threshold}

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
