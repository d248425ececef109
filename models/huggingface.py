"""Networks for segmentation and depth from transformers, built from plain settings."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from inspect import signature
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from models.segments import Segments, front_segments
from models.unet import check_size
from tangent_train.errors import SettingError, of_extra

SEGMENTATION = "SEMANTIC_SEGMENTATION", "UNIVERSAL_SEGMENTATION"
"""Tasks of networks that return classes, in the names of transformers' mappings."""

DEPTH = "DEPTH_ESTIMATION"
"""Task of networks that return depth."""

_ONE_SIZE = "beit", "data2vec-vision", "eomt"
"""Networks with a learned position of each patch, which are not interpolated."""

_MASK2FORMER = (384, 384)
"""Rows and columns to which Mask2Former's masks are resized before they are added
(``Mask2FormerImageProcessor.post_process_semantic_segmentation``)."""


def architecture(config: Mapping[str, Any], kind: Any = None) -> dict[str, Any]:
    """Return the settings of transformers that describe a network and networks inside it.

    Only arguments declared by the class of the settings are kept. Code of a model's author,
    kernels, quantizers, alternative names (``attribute_map``), labels and backbones on the hub are
    dropped. Backbones from timm are built by name without weights.

    Args:
        config: Content of a ``config.json``, or ``PreTrainedConfig.to_dict``.
        kind: Class of the settings; None or `AutoConfig` to choose it by ``model_type``.

    Raises:
        SettingError: transformers lacks the class, or is missing.
    """
    with of_extra("huggingface", "network"):
        import transformers

    if kind in (None, transformers.AutoConfig):
        name, expected = str(config.get("model_type")), "a kind of network that transformers has"
        if name not in transformers.CONFIG_MAPPING:
            raise SettingError("network.config.model_type", found=name, expected=expected)
        kind = transformers.CONFIG_MAPPING[name]
    # Settings that all networks share are about labels, results, and how a file was written.
    of_all = signature(transformers.PreTrainedConfig).parameters.keys()
    declared = signature(kind).parameters.keys() - of_all
    names = {name.removeprefix("_") for name in declared}
    names |= {alias for alias, name in kind.attribute_map.items() if name in declared}

    def plain(value: Any, inner_kind: Any = None) -> Any:
        if isinstance(value, list | tuple):
            return [plain(one) for one in value]
        if not isinstance(value, Mapping):
            return value
        if inner_kind is not None or "model_type" in value:
            return architecture(value, inner_kind)
        return {name: plain(inner) for name, inner in value.items()}

    known = {n: plain(value, kind.sub_configs.get(n)) for n, value in config.items() if n in names}
    return {"model_type": kind.model_type, **known}


def _names(settings: Mapping[str, Any], prefix: str = "") -> set[str]:
    """Return the names of settings and of settings inside them."""
    inner = (_names(v, f"{prefix}{n}.") for n, v in settings.items() if isinstance(v, Mapping))
    return {f"{prefix}{name}" for name in settings}.union(*inner)


def _patch_size(config: Any) -> int:
    """Return the side in pixels of the patches that a network reads whole; 1 without patches."""
    inside = getattr(config, "backbone_config", None) or config
    size = getattr(inside, "patch_size", 1)
    return int(size if isinstance(size, int) else max(size))


class _TransformersNetwork(nn.Module):
    """A network from transformers with random weights, built from plain settings.

    Args:
        config: `architecture` of the network, with ``model_type``.
        tasks: Names of its possible tasks in the names of transformers' mappings and classes.
        bgr: True if the network takes BGR images.
        **labels: Further settings of the network.

    Attributes:
        network: The network of transformers.

    Raises:
        SettingError: transformers lacks the network or is missing.
    """

    def __init__(
        self, config: Mapping[str, Any], tasks: Sequence[str], bgr: bool, **labels: Any
    ) -> None:
        super().__init__()
        known = architecture(config)
        unknown = _names(config) - _names(known)
        if unknown:
            raise SettingError(
                f"network.config.{min(unknown)}",
                found="a value",
                expected=f"settings that transformers declares for {known['model_type']}",
            )
        import transformers as hf

        kind = known["model_type"]
        fitting = [task for task in tasks if kind in network_types(task)]
        if not fitting:
            names = sorted({name for task in tasks for name in network_types(task)})
            words = " or ".join(task.lower().replace("_", " ") for task in tasks)
            raise SettingError(
                "network.config.model_type",
                found=kind,
                expected=f"a network for {words} ({', '.join(names)})",
            )
        made = hf.AutoConfig.for_model(**known, **labels)
        auto: Any = getattr(hf, f"AutoModelFor{fitting[0].title().replace('_', '')}")
        self.network: Any = auto.from_config(made, trust_remote_code=False)
        self._bgr = bgr
        self.size_multiple = _patch_size(made)
        if kind in _ONE_SIZE:
            self.fixed_size = (made.image_size, made.image_size)

    def _prepared(self, images: Tensor) -> Tensor:
        """Return images with the network's order of channels.

        Raises:
            SettingError: The images cannot be divided into the network's patches.
        """
        if self._bgr:
            images = torch.cat([images[:, :3].flip(1), images[:, 3:]], dim=1)
        check_size(images.shape[-2:], self.network, self.size_multiple, None)
        return images


def image_processor_class(config: Any) -> Any:
    """Return the usual image processor of the networks of a config of transformers."""
    from transformers import IMAGE_PROCESSOR_MAPPING

    kinds: Any = IMAGE_PROCESSOR_MAPPING[type(config)]
    return kinds.get("torchvision") or kinds["pil"]


def network_types(task: str) -> set[str]:
    """Return the ``model_type`` of all networks that transformers has for a task.

    Args:
        task: Name of the task in the name of the mapping, e.g. ``DEPTH_ESTIMATION``.
    """
    import transformers

    return {made.model_type for made in getattr(transformers, f"MODEL_FOR_{task}_MAPPING")}


class HuggingFaceNetwork(_TransformersNetwork):
    """Network from transformers for semantic or universal segmentation, with random weights.

    Args:
        config: `architecture` of the network, with ``model_type``.
        num_classes: Number of scores K of a pixel.
        bgr: True if the network takes BGR images, e.g. MobileViT.
        task: Tokens of "the task is semantic", or "panoptic" for objects, an input of OneFormer.
        things: Indices of the classes of which a universal network also returns objects.

    Attributes:
        network: The network of transformers.

    Raises:
        SettingError: transformers lacks the network or is missing.
    """

    def __init__(
        self,
        config: Mapping[str, Any],
        num_classes: int,
        bgr: bool = False,
        task: Sequence[int] | None = None,
        things: Sequence[int] = (),
    ) -> None:
        super().__init__(config, SEGMENTATION, bgr, num_labels=num_classes)
        self._stuff = set(range(num_classes)) - set(things) if things else None
        tokens = None if task is None else torch.tensor([list(task)])
        self._task: Tensor | None
        self.register_buffer("_task", tokens, persistent=False)

    def forward(self, images: Float[Tensor, "batch channels height width"]) -> Any:
        """Return scores ``(batch, classes, height, width)`` of the images.

        With objects, scores and a list of `Segments` are a dict, ``out`` and ``segments``.

        Networks for universal segmentation return masks with classes. Scores are the logarithms of
        the share of each class, so that a softmax returns shares, also for sums of classes.

        Raises:
            SettingError: The images cannot be divided into the network's patches.
        """
        images = self._prepared(images)
        size = (images.shape[-2], images.shape[-1])
        task = {} if self._task is None else {"task_inputs": self._task.expand(len(images), -1)}
        returned = self.network(pixel_values=images, **task)
        segments = [] if self._stuff is None else self._segments(returned, size)
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
        scores = scores.clamp_min(torch.finfo(scores.dtype).tiny).log()
        return {"out": scores, "segments": segments} if self._stuff is not None else scores

    def _segments(self, returned: Any, size: tuple[int, int]) -> list[Segments]:
        """Return the library's panoptic segmentation of each image."""
        made = self.network.config
        named: dict[str, Any] = {"label_ids_to_fuse": self._stuff}
        if made.model_type.startswith("eomt"):
            sides = {"shortest_edge": size[0], "longest_edge": size[1]}
            named, returned["patch_offsets"] = {"stuff_classes": self._stuff, "size": sides}, None
        process = image_processor_class(made)().post_process_panoptic_segmentation
        found = process(returned, target_sizes=[size] * len(returned[0]), **named)
        return [_segments_of(each["segmentation"], each["segments_info"]) for each in found]


def _segments_of(numbers: Tensor, infos: Sequence[Mapping[str, Any]]) -> Segments:
    """Return the library's segments of one image as objects."""
    given = [torch.tensor([info[key] for info in infos]) for key in ("id", "label_id", "score")]
    ids, classes, scores = (values.to(numbers.device) for values in given)
    return front_segments(numbers == ids[:, None, None], classes.long(), scores)


_BILINEAR = ("depth_pro", "tipsv2_dpt")
"""Networks whose depth is resized bilinearly, others bicubically, as in the library: see
``post_process_depth_estimation`` of their image processors."""


class HuggingFaceDepthNetwork(_TransformersNetwork):
    """Network from transformers for depth of photos, with random weights.

    Args:
        config: `architecture` of the network, with ``model_type``.
        bgr: True if the network takes BGR images.
        padded: True if images are mirrored at their borders and then reduced to their size, as the
            image processor of ZoeDepth does.

    Attributes:
        network: The network of transformers.

    Raises:
        SettingError: transformers lacks the network or is missing.
    """

    def __init__(self, config: Mapping[str, Any], bgr: bool = False, padded: bool = False) -> None:
        super().__init__(config, (DEPTH,), bgr)
        self._padded = padded
        self._resizing = "bilinear" if config["model_type"] in _BILINEAR else "bicubic"
        made = self.network.config
        self._voting = len(getattr(made, "bin_configurations", ())) > 1
        ratios = getattr(made, "scaled_images_ratios", None)
        if ratios is not None:  # Depth Pro
            self.fixed_size = (round(made.patch_size / min(ratios)),) * 2

    def forward(
        self, images: Float[Tensor, "batch channels height width"]
    ) -> Float[Tensor, "batch 1 height width"]:
        """Return the network's depth of every pixel, after the library's post-processing.

        Raises:
            SettingError: The images cannot be divided into the network's patches.
        """
        images = self._prepared(images)
        size = height, width = images.shape[-2], images.shape[-1]
        # Reflected pixels at each border (``ZoeDepthImageProcessor._pad_images``).
        down, right = (int(3 * math.sqrt(n / 2)) if self._padded else 0 for n in size)
        if self._padded:
            borders = (right, right, down, down)
            images = functional.pad(images, borders, mode="reflect")
            images = functional.interpolate(images, size, mode="bilinear", align_corners=True)
        # ZoeDepth's networks for two kinds of scenes choose one for all images of a call.
        parts = torch.split(images, 1) if self._voting else [images]
        depth = torch.cat([self.network(pixel_values=part)["predicted_depth"] for part in parts])
        depth = depth[:, None]
        whole = height + 2 * down, width + 2 * right
        if depth.shape[-2:] != whole:
            depth = functional.interpolate(depth, whole, mode=self._resizing)
        return depth[..., down : down + height, right : right + width]
