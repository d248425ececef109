"""Networks that a config describes, with weights from a file."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from datamodules.core.inputs import Normalization
from models.pretrained import load_tensors, tensors_for
from tangent_train.checkpoints.trained import completed_settings
from tangent_train.errors import SettingError
from tangent_train.inference.photo_networks.network import PhotoNetwork, class_names_in
from tangent_train.registry import build_from_config


def load(
    settings: Mapping[str, Any],
    weights: str | Path | None,
    classes: Path | None,
    normalization: Any,
) -> PhotoNetwork:
    """A network of ``configs/network``.

    Args:
        settings: Section of the network.
        weights: File of its state dict.
        classes: JSON file of the class names.
        normalization: See `Normalization.of`.

    Raises:
        DataError: A file cannot be used.
        SettingError: A setting is missing.
    """
    if weights is None:
        raise SettingError("weights", found="none", expected="a file with the network's tensors")
    names = class_names_in(classes)
    whole = completed_settings(settings, 3, len(names), restored=True)
    network = build_from_config(whole, "network")
    load_tensors(network, tensors_for(network, Path(weights)), weights)
    return PhotoNetwork(network, whole, names, Normalization.of(normalization, 3))
