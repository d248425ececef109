"""Segmentation networks of transformers, from the hub or a folder."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torch import Tensor

from datamodules.core.inputs import Normalization
from models.huggingface import HuggingFaceNetwork, architecture
from tangent_train.errors import DataError, SettingError
from tangent_train.inference.photo_networks.network import PhotoNetwork, class_names_in
from tangent_train.inference.photo_networks.saved import json_in, saved_folder, tensors_in
from tangent_train.inference.quiet import quiet
from tangent_train.offline import offline
from tangent_train.registry import SettingsFile, is_text, make

_TASK = "the task is semantic"
_VOCABULARIES = ("tokenizer.json", "vocab.json")
_BYTE = 255
_LISTED = 4
"""Wrong tensors in a message."""


def load(*, model: str | None, classes: Path | None, normalization: Any, **_: Any) -> PhotoNetwork:
    """A network of transformers for semantic or universal segmentation.

    No code of its author is run, and weights are read from safetensors only.

    Args:
        model: Its name on the hub, or a folder written by ``save_pretrained``.
        classes: JSON file of the class names; None for those of its config.
        normalization: See `Normalization.of`; None for that of its image processor.

    Raises:
        DataError: A file is missing, cannot be fetched or used.
        SettingError: A setting is impossible, or transformers is missing.
    """
    folder = saved_folder(model)
    with offline():
        return _from_folder(folder, classes, normalization)


def _from_folder(folder: Path, classes: Path | None, normalization: Any) -> PhotoNetwork:
    config = json_in(folder, "config.json")
    names = _names(config, folder / "config.json")
    processor = _processor(folder)
    settings = {
        "_target_": "models.HuggingFaceNetwork",
        "config": architecture(config | {"use_auxiliary_head": False}),
        "num_classes": len(names),
        "bgr": bool(processor.get("do_flip_channel_order")),
    }
    if config.get("model_type") == "oneformer":
        settings["task"] = _task(folder, config)
    network = make(settings, "network", SettingsFile(folder / "config.json"))
    tensors, remarks = tensors_in(folder)
    _load_tensors(network, tensors, folder)
    settings["config"] = architecture(network.network.config.to_dict())
    given = None if normalization is None else Normalization.of(normalization, 3)
    return PhotoNetwork(
        network=network,
        settings=settings,
        score_names=names if classes is None else class_names_in(classes),
        normalization=given or _normalization(processor, folder),
        image_size=_image_size(processor, folder),
        remarks=remarks,
    )


def _names(config: Mapping[str, Any], path: Path) -> list[str]:
    """Names of the scores, in their order."""
    by_place = config.get("id2label")
    places = by_place if isinstance(by_place, Mapping) else {}
    names = [str(places.get(str(place), "")).strip() for place in range(len(places))]
    if not names or not all(name and is_text(name) for name in names):
        raise DataError(
            path,
            found=f"id2label: {by_place}",
            expected='the name of every score, {"0": "wall", "1": "floor"}',
        )
    return names


def _processor(folder: Path) -> dict[str, Any]:
    """Settings of the image processor; it is not made, for that may fetch files."""
    own, shared = "preprocessor_config.json", "processor_config.json"
    if (folder / shared).is_file():
        inside = json_in(folder, shared).get("image_processor")
        if isinstance(inside, dict):
            return inside
    if not (folder / own).is_file():
        raise DataError(
            folder,
            found=f"no {own}",
            expected="the image processor of the network: its normalization and image size",
            remedy="Copy that file from the model that this one was fine-tuned from.",
        )
    return json_in(folder, own)


def _normalization(processor: Mapping[str, Any], folder: Path) -> Normalization:
    """Of images from 0 to 1, what the image processor does with those from 0 to 255."""
    mean, std = (0, 0, 0), (1, 1, 1)
    try:
        scale = _BYTE * (processor.get("rescale_factor", 1 / _BYTE))
        if not processor.get("do_rescale", True):
            scale = _BYTE
        if processor.get("do_normalize", False):  # MobileViT's has a mean, and no such setting
            mean, std = processor["image_mean"], processor["image_std"]
        return Normalization.of(
            {"mean": [value / scale for value in mean], "std": [value / scale for value in std]}, 3
        )
    except (ArithmeticError, KeyError, TypeError, SettingError) as error:
        raise DataError(
            folder / "preprocessor_config.json",
            found=f"no normalization in {dict(processor)} ({error})",
            expected="rescale_factor, image_mean and image_std of three channels",
        ) from error


def _image_size(processor: Mapping[str, Any], folder: Path) -> tuple[int, int]:
    """Rows and columns of the images that the image processor makes."""
    given = processor.get("size")
    if processor.get("do_center_crop") and processor.get("crop_size"):
        given = processor["crop_size"]
    sides = given if isinstance(given, Mapping) else {"shortest_edge": given}
    shortest = sides.get("shortest_edge", sides.get("longest_edge"))
    rows, columns = sides.get("height", shortest), sides.get("width", shortest)
    if not (isinstance(rows, int) and isinstance(columns, int) and min(rows, columns) > 0):
        raise DataError(
            folder / "preprocessor_config.json",
            found=f"size: {given}",
            expected="height and width, or shortest_edge, in pixels",
        )
    return rows, columns


def _task(folder: Path, config: Mapping[str, Any]) -> list[int]:
    """The tokens that ask OneFormer for classes (``OneFormerProcessor``)."""
    from transformers import AutoTokenizer

    expected = "the tokenizer of OneFormer, which takes its task as text"
    if not any((folder / name).is_file() for name in _VOCABULARIES):
        raise DataError(folder, found=f"no {' or '.join(_VOCABULARIES)}", expected=expected)
    length = config.get("task_seq_len", 77)
    try:
        tokenizer = AutoTokenizer.from_pretrained(
            folder, local_files_only=True, trust_remote_code=False
        )
        text = tokenizer(_TASK, padding="max_length", max_length=length, truncation=True)
    except Exception as error:  # whatever a tokenizer raises about its files
        raise DataError(
            folder,
            found=f"an unusable tokenizer ({str(error).partition(chr(10))[0]})",
            expected=expected,
        ) from error
    masked = zip(text["input_ids"], text["attention_mask"], strict=True)
    return [token * mask for token, mask in masked]


def _load_tensors(network: HuggingFaceNetwork, tensors: dict[str, Tensor], folder: Path) -> None:
    """Load weights through transformers, which knows their names in its older versions."""
    inner = network.network
    with quiet():
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
            expected=f"those of {type(inner).__name__} as config.json describes it, for the "
            "classes in its id2label",
        )
    inner.load_state_dict(loaded.state_dict())
