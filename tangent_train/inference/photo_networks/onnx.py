"""Networks in ONNX files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from datamodules.core.inputs import Normalization
from models.onnx_network import OnnxNetwork
from tangent_train.errors import SettingError
from tangent_train.inference.photo_networks.network import USUAL_SIZE, PhotoNetwork, class_names_in


def load(*, file: Path | None, classes: Path | None, normalization: Any, **_: Any) -> PhotoNetwork:
    """The network of an ONNX file, see `OnnxNetwork`.

    Args:
        file: The file.
        classes: JSON file of the class names.
        normalization: See `Normalization.of`.

    Raises:
        DataError: A file cannot be used.
        SettingError: A setting is missing.
    """
    if file is None:
        raise SettingError("file", found="none", expected="an ONNX file")
    network = OnnxNetwork(file)
    return PhotoNetwork(
        network=network,
        settings=None,
        score_names=class_names_in(classes),
        normalization=Normalization.of(normalization, 3),
        image_size=network.image_size or USUAL_SIZE,
        fixed_size=network.image_size is not None,
    )
