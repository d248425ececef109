"""Load networks of segmentation-models-pytorch, from the Hugging Face hub or a folder."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from datamodules.core.inputs import Normalization
from models.pretrained import load_tensors
from tangent_train.config.from_file import build_from_file
from tangent_train.errors import DataError, SettingError, first_line
from tangent_train.imports import offline
from tangent_train.photo_networks.network import PhotoNetwork, class_names_in
from tangent_train.photo_networks.saved import json_in, saved_folder, tensors_in

_CLASS = "_model_class"
_LEFT_OUT = {"activation", "aux_params"}
"""Settings that are not used: the activation after the scores, and a classification head."""

_HEAD_OF_IMAGES = "classification_head."
_NORMALIZATION = "imagenet, unit, symmetric, or {mean: […], std: […]} of RGB from 0 to 1"


def load(*, model: str | None, classes: Path | None, normalization: Any) -> PhotoNetwork:
    """Load a network that segmentation-models-pytorch saved with ``save_pretrained``.

    Args:
        model: A folder, or a name on the hub.
        classes: JSON file of the class names.
        normalization: See `Normalization.of`; None for that of the encoder's published weights.

    Raises:
        DataError: A file is missing, or cannot be fetched or used.
        SettingError: A setting is missing, or segmentation-models-pytorch is not installed.
    """
    folder = saved_folder(model)
    path = folder / "config.json"
    config = json_in(folder, path.name)
    settings = {
        "_target_": f"segmentation_models_pytorch.{config.get(_CLASS)}",
        **{name: value for name, value in config.items() if not name.startswith("_")},
        "encoder_weights": None,
        **dict.fromkeys(_LEFT_OUT & config.keys()),
    }
    if config.get("in_channels", 3) != 3:
        raise DataError(
            path,
            found=f"in_channels: {config['in_channels']}",
            expected="3: photo networks only get RGB images",
        )
    network = build_from_file(settings, "network", path)
    given = None if normalization is None else Normalization.of(normalization, 3)
    tensors = tensors_in(folder)
    tensors = {name: t for name, t in tensors.items() if not name.startswith(_HEAD_OF_IMAGES)}
    load_tensors(network, tensors)
    return PhotoNetwork(
        module=network,
        settings=settings,
        score_names=class_names_in(classes),
        normalization=given or _of_encoder(config),
        score_kind="logits",
    )


def _of_encoder(config: dict[str, Any]) -> Normalization:
    """Return the normalization of the encoder's published weights."""
    from segmentation_models_pytorch import encoders  # type: ignore[import-untyped]

    name, weights = config.get("encoder_name"), config.get("encoder_weights") or "imagenet"
    try:
        with offline():  # the encoder's name is from a file
            given = encoders.get_preprocessing_params(name, weights)
    except Exception as error:  # unknown name, or a file that was not fetched
        found = f"none, and no default for {name} ({first_line(error)})"
        raise SettingError("normalization", found=found, expected=_NORMALIZATION) from error
    if given["input_space"] != "RGB":
        found = f"none, and {name} takes {given['input_space']}"
        raise SettingError("normalization", found=found, expected=_NORMALIZATION)
    _, largest = given["input_range"]
    mean, std = ([value / largest for value in given[key]] for key in ("mean", "std"))
    return Normalization(mean, std)
