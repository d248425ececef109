"""Load networks of transformers for segmentation or depth, from the hub or a folder."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, get_args

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from datamodules.core.inputs import Normalization
from datamodules.core.label_map import UNKNOWN_NAME
from models.huggingface import (
    DEPTH,
    SEGMENTATION,
    architecture,
    image_processor_class,
    network_types,
)
from models.prompted import TEXT_CLASSES
from tangent_train.config.from_file import build_from_file
from tangent_train.errors import DataError, SettingError, check_choice, first_line, listed
from tangent_train.files import read_json
from tangent_train.imports import hide_output, offline
from tangent_train.kinds import DepthKind
from tangent_train.photo_networks.network import (
    USUAL_SIZE,
    PhotoNetwork,
    class_names_in,
    names_of,
    saved_folder,
    tensors_in,
)

_NAMES = 'id2label with the name of every score, {"0": "wall", "1": "floor"}'
_TASK = "the task is "
_LEFT_OUT = ("use_auxiliary_head", "use_fov_model")
"""Parts of networks that are not used: a head for training, and the field of view of Depth Pro,
which is known here."""

_PADDED = "zoedepth"
"""Network whose images are padded before they are resized, see `HuggingFaceDepthNetwork`."""

_METRIC: Sequence[DepthKind] = "metric_z", "metric_distance"
_RELATIVE: Sequence[DepthKind] = "relative_disparity", "relative_depth"
_FAMILIES: dict[str, Sequence[DepthKind]] = {
    "depth_pro": ("canonical_inverse",),
    "metric": _METRIC,  # Depth Anything: its depth_estimation_type
    "relative": _RELATIVE,
    "glpn": _METRIC,
    "tipsv2_dpt": _METRIC,
    "zoedepth": _METRIC,
    "chmv2": (),  # heights of trees in aerial images
    "prompt_depth_anything": (),  # continues the depth image of a sensor
}
"""Possible kinds of networks in transformers, the usual one first; none for other quantities."""

_DEPTH_NAMES = (
    "Set depth=, e.g. relative_disparity for MiDaS and its DPT (Intel/dpt-large), metric_z for "
    "networks trained on the meters of NYU or KITTI."
)

_VOCABULARIES = ("tokenizer.json", "vocab.json")
_SIDE = 32
"""Rows and columns of the images with which an image processor is tested."""

_NOT_OF_COLORS = ("do_resize", "do_center_crop", "do_pad", "do_split_image")
"""Settings of an image processor that move pixels; they are switched off in the test."""

_MOST_PIXELS = 2**26
"""Largest image size of an image processor that is tried."""

_ALL = "all"
"""Setting `things`: all classes have objects."""

_LISTED = 4
"""Largest number of wrong tensors in a message."""


def load(
    model: str | None,
    classes: Path | None = None,
    normalization: Any = None,
    depth: DepthKind | None = None,
    things: Sequence[str] = (),
    prompts: Mapping[str, Sequence[str]] | None = None,
    threshold: float | None = None,
) -> PhotoNetwork:
    """Load a network of transformers for semantic or universal segmentation, or for depth.

    Code from the model's author is not run, and weights are only read from safetensors files.

    Args:
        model: Name on the hub, or a folder written by ``save_pretrained``.
        classes: JSON file of the class names; None for the names in the model's config.
        normalization: See `Normalization.of`; None for that of the model's image processor.
        depth: Kind of depth; None for that of the model's config.
        things: Names of the classes of which a universal network also returns objects; or "all".
        prompts: See `prompted`.
        threshold: See `prompted`.

    Raises:
        DataError: A file is missing, or cannot be fetched or used.
        SettingError: There are no such classes, or no objects; the kind of depth is unknown; or
            transformers is not installed.
    """
    folder = saved_folder(model)
    path = folder / "config.json"
    config = read_json(path, "the config of a model")
    if prompts is not None:
        return prompted(folder, config, prompts, threshold, normalization)
    with offline():
        described = architecture(config | dict.fromkeys(_LEFT_OUT, False))
        processor = _processor(folder, described["model_type"])
        settings = {"config": described, "bgr": processor["do_flip_channel_order"]}
        kind: DepthKind | None = None
        names: tuple[str, ...] = ()
        if _predicts_depth(config, path, depth):
            kind = declared_kind(config, path, depth)
            padded = described["model_type"] == _PADDED and bool(processor.get("do_pad"))
            settings |= {"_target_": "models.HuggingFaceDepthNetwork", "padded": padded}
        else:
            labels = dict(config.get("id2label") or {})
            labels = {index: str(name).strip() for index, name in labels.items()}
            names = names_of(labels, path, _NAMES)
            settings |= {"_target_": "models.HuggingFaceNetwork", "num_classes": len(names)}
        given_names = names if classes is None else class_names_in(classes)
        if things:
            things = given_names if list(things) == [_ALL] else things
            settings["things"] = _indices(things, given_names, described["model_type"])
        if described["model_type"] == "oneformer":
            settings["task"] = _task(folder, config, "panoptic" if things else "semantic")
        network = build_from_file(settings, "network", path)
        _load_tensors(network, tensors_in(folder), folder)
    settings["config"] = architecture(network.network.config.to_dict())
    return PhotoNetwork(
        module=network,
        settings=settings,
        score_names=given_names,
        normalization=Normalization.of(normalization or processor["normalization"], 3),
        image_size=_image_size(processor, folder / "preprocessor_config.json"),
        score_kind="logits",
        depth_kind=kind,
        things=things,
    )


def prompted(
    folder: Path, config: Any, prompts: Mapping[str, Any], threshold: Any, normalization: Any
) -> PhotoNetwork:
    """Load a network that finds what a text names, with the texts as classes.

    Args:
        folder: Folder of the model with its tokenizer.
        config: Content of its config.
        prompts: Texts of each class by its name.
        threshold: Probability that a class must exceed; elsewhere pixels are unknown. None for 0.5.
        normalization: See `load`.
    """
    config = config.get("detector_config") or config  # SAM 3 is published with its tracker
    with offline():
        described = architecture(config)
        check_choice("model, with prompts=", described["model_type"], tuple(TEXT_CLASSES))
        processor = _processor(folder, described["model_type"])
        tokenizer = _tokenizer(folder, "a text")
        padding = {"pad_id": tokenizer.pad_token_id, "pad_token": tokenizer.pad_token}
        tokenizer.backend_tokenizer.enable_padding(**padding)
        encoded = tokenizer.backend_tokenizer.to_str().encode()
        settings: dict[str, Any] = {"_target_": "models.PromptedNetwork", "config": described}
        settings["tokenizer_bytes"] = len(encoded)
        network: Any = build_from_file(settings, "network", folder / "config.json").eval()
        _load_tensors(network, tensors_in(folder), folder)
        network.tokenizer = torch.frombuffer(bytearray(encoded), dtype=torch.uint8)
        settings |= network.set_prompts(prompts, threshold)
    return PhotoNetwork(
        module=network,
        settings=settings,
        score_names=(*prompts, UNKNOWN_NAME),
        normalization=Normalization.of(normalization or processor["normalization"], 3),
        image_size=network.fixed_size,
        score_kind="logits",
        things=tuple(prompts) if described["model_type"] == "sam3" else (),
        unknown=(UNKNOWN_NAME,),
    )


def _tokenizer(folder: Path, reason: str) -> Any:
    """Return the tokenizer of a model."""
    from transformers import AutoTokenizer

    if not any((folder / name).is_file() for name in _VOCABULARIES):  # else tokens are "unknown"
        expected = f"the tokenizer of the network, which takes {reason}"
        raise DataError(folder, found=f"no {' or '.join(_VOCABULARIES)}", expected=expected)
    return AutoTokenizer.from_pretrained(folder, local_files_only=True, trust_remote_code=False)


def _indices(things: Sequence[str], names: Sequence[str], model_type: str) -> list[int]:
    """Return the indices of classes that have objects."""
    is_universal = model_type in network_types(SEGMENTATION[1])
    if not (is_universal and set(things) <= set(names)):
        expected = f"among {listed(names)}" if is_universal else f"null, for {model_type}"
        raise SettingError("things", found=listed(things), expected=expected)
    return [names.index(name) for name in things]


def _predicts_depth(config: Mapping[str, Any], path: Path, depth: DepthKind | None) -> bool:
    """Return True for a depth network; if transformers has both, its architecture decides."""
    kind = config["model_type"]
    tasks = [task for task in (DEPTH, *SEGMENTATION) if kind in network_types(task)]
    if DEPTH not in tasks or len(tasks) == 1:
        return DEPTH in tasks
    names = ", ".join(map(str, config.get("architectures") or ()))
    if "DepthEstimation" in names or "Segmentation" in names:
        return "DepthEstimation" in names
    if depth is not None:
        return True
    raise DataError(
        path,
        found=f"architectures: {names or 'none'}",
        expected=f"a {kind} network …ForDepthEstimation or …ForSemanticSegmentation",
        remedy="Set depth=, e.g. metric_z, to import its depth. For its classes, name the second "
        "architecture in the file.",
    )


def _processor(folder: Path, model_type: str) -> dict[str, Any]:
    """Return settings of the image processor, with the defaults of its class.

    ``do_flip_channel_order`` and ``normalization`` (for images from 0 to 1) are measured. Settings
    with a text are left out, because some of them are names of files that would be fetched.

    Raises:
        DataError: There is no usable image processor.
    """
    path, shared = folder / "preprocessor_config.json", folder / "processor_config.json"
    expected = "the image processor of the network: its normalization and image size"
    content = read_json(shared, expected).get("image_processor") if shared.is_file() else None
    content = content or read_json(path, expected)
    kind = _processor_class(content, model_type)
    known = {
        name: value
        for name, value in content.items()
        if name in kind.valid_kwargs.__annotations__ and not isinstance(value, str)
    }
    reason, response = "its channels are not scaled", None
    try:
        with hide_output():
            processor = kind(**known)
            response = _response(processor)
    except Exception as error:  # processors raise many kinds about their settings
        reason = first_line(error)
    if response is None:
        raise DataError(
            path,
            found=f"no normalization in {content} ({reason})",
            expected=f"settings of {kind.__name__} that scale three channels",
        )
    order, black, gain = response
    numbers = {"mean": (-black / gain)[order], "std": (1 / gain)[order]}
    rounded = {n: [float(f"{value:.6g}") for value in values] for n, values in numbers.items()}
    settings: dict[str, Any] = processor.to_dict()
    measured = {"normalization": Normalization(**rounded), "do_flip_channel_order": bool(order[0])}
    return settings | measured


def _response(processor: Any) -> tuple[NDArray[np.intp], NDArray[Any], NDArray[Any]] | None:
    """Measure how an image processor normalizes colors.

    Returns:
        For each input channel of the network: index of the image's channel, value for black, and
        difference between full intensity and black. None if the processor does not scale three
        channels, in their order or reversed.
    """
    known = processor.valid_kwargs.__annotations__
    switched_off = {name: False for name in _NOT_OF_COLORS if name in known}
    colors = np.array([[0, 0, 0], [255, 0, 0], [0, 255, 0], [0, 0, 255], [51, 204, 102]], np.uint8)
    images = [np.tile(color, (_SIDE, _SIDE, 1)) for color in colors]
    pixels = np.asarray(processor(images, return_tensors="np", **switched_off)["pixel_values"])
    black, *primary, mixed = pixels[:, :, _SIDE // 2, _SIDE // 2].astype(np.float64)
    ranges = np.array(primary) - black  # (channel of the image, channel of the network)
    order = np.abs(ranges).argmax(axis=0)
    gain = ranges[order, np.arange(len(order))]
    error = np.abs(mixed - black - gain * colors[-1][order] / 255).max()
    in_order = order.tolist() in ([0, 1, 2], [2, 1, 0])
    is_scaled = np.isfinite(pixels).all() and gain.min() > 0 and error < 1e-3 * gain.max()
    return (order, black, gain) if in_order and is_scaled else None


def _processor_class(content: Mapping[str, Any], model_type: str) -> Any:
    """Return the class named in a file, also by its older name, or the network's default."""
    import transformers  # loads its classes on demand
    from transformers import AutoConfig
    from transformers.image_processing_utils import BaseImageProcessor

    older = str(content.get("feature_extractor_type", "")).replace("Feature", "Image")
    name = str(content.get("image_processor_type") or older.replace("Extractor", "Processor"))
    kind = getattr(transformers, name.removesuffix("Fast"), None)
    if not (isinstance(kind, type) and issubclass(kind, BaseImageProcessor)):
        kind = image_processor_class(AutoConfig.for_model(model_type))
    return kind


def _image_size(processor: Mapping[str, Any], path: Path) -> tuple[int, int]:
    """Return rows and columns of the images after the image processor of a file."""
    given = processor.get("size") if processor.get("do_resize") else None
    if processor.get("do_center_crop") and processor.get("crop_size"):
        given = processor["crop_size"]
    if given is None:
        return USUAL_SIZE
    side = given.get("shortest_edge", given.get("longest_edge"))
    size = given.get("height", side), given.get("width", side)
    if not all(isinstance(n, int) and n > 0 for n in size) or math.prod(size) > _MOST_PIXELS:
        expected = f"rows and columns of at most {_MOST_PIXELS} pixels"
        raise DataError(path, found=f"an image size of {size[0]} × {size[1]}", expected=expected)
    return size


def _task(folder: Path, config: Mapping[str, Any], task: str) -> list[int]:
    """Return the tokens that select one of OneFormer's tasks (``OneFormerProcessor``)."""
    tokenizer = _tokenizer(folder, "its task as text")
    length = config.get("task_seq_len", 77)
    text = tokenizer(_TASK + task, padding="max_length", max_length=length, truncation=True)
    masked = zip(text["input_ids"], text["attention_mask"], strict=True)
    return [token * mask for token, mask in masked]


def _load_tensors(network: Any, tensors: dict[str, Tensor], folder: Path) -> None:
    """Load weights with transformers, which maps tensor names of its older versions."""
    inner = network.network
    with hide_output():
        loaded, found = type(inner).from_pretrained(
            None,
            config=inner.config,
            state_dict=tensors,
            output_loading_info=True,
            ignore_mismatched_sizes=True,
        )
    wrong = [f"no {name}" for name in sorted(found["missing_keys"])]
    for name, given, needed in sorted(found["mismatched_keys"]):
        wrong.append(f"{name} of shape {tuple(given)} instead of {tuple(needed)}")
    if wrong:
        raise DataError(
            folder,
            found=f"other weights: {', '.join(wrong[:_LISTED])}",
            expected=f"weights of {type(inner).__name__} as described in config.json",
        )
    inner.load_state_dict(loaded.state_dict())


def declared_kind(config: Mapping[str, Any], path: Path, given: DepthKind | None) -> DepthKind:
    """Return the kind of depth of a network of transformers.

    Args:
        config: Content of its ``config.json``.
        path: That file, for messages.
        given: The user's setting ``depth``, which must not contradict the config.

    Raises:
        SettingError: The config does not determine the kind, or contradicts `given`; or the network
            returns something else, or needs another input.
    """
    name = str(config.get("model_type"))
    if name == "depth_anything":
        name = str(config.get("depth_estimation_type", "relative"))
    kinds = _FAMILIES.get(name, get_args(DepthKind))
    usual = given or (kinds[0] if name in _FAMILIES and kinds else None)
    if usual is None or usual not in kinds:
        expected = f"{' or '.join(kinds) or 'depth of photos'}, because {path} has {name}"
        raise SettingError("depth", found=given or "none", expected=expected, remedy=_DEPTH_NAMES)
    return usual
