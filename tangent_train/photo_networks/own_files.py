"""Load networks from users' files: ONNX, or a config with a state dict."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from datamodules.core.inputs import Normalization
from models.onnx_network import OnnxNetwork
from models.pretrained import load_tensors, tensors_for
from tangent_train.checkpoints.kinds import DepthKind, ScoreKind
from tangent_train.checkpoints.loaded import completed_settings
from tangent_train.config.build import build_from_config
from tangent_train.errors import SettingError
from tangent_train.photo_networks.network import USUAL_SIZE, PhotoNetwork, class_names_in


def load_onnx(
    *,
    file: Path | None,
    classes: Path | None,
    normalization: Any,
    depth: DepthKind | None = None,
) -> PhotoNetwork:
    """Load a network from an ONNX file, see `OnnxNetwork`.

    Args:
        file: ONNX file.
        classes: JSON file of the class names.
        normalization: See `Normalization.of`.
        depth: Kind of depth; None for a network that predicts classes.

    Raises:
        DataError: A file cannot be used.
        SettingError: A setting is missing.
    """
    if file is None:
        raise SettingError("file", found="none", expected="an ONNX file")
    network = OnnxNetwork(file)
    return PhotoNetwork(
        module=network,
        settings=None,
        score_names=class_names_in(classes, depth),
        normalization=Normalization.of(normalization, 3),
        image_size=network.fixed_size or USUAL_SIZE,
        depth_kind=depth,
    )


def load_config(
    settings: dict[str, Any],
    *,
    weights: str | Path | None,
    classes: Path | None,
    normalization: Any,
    depth: DepthKind | None = None,
) -> PhotoNetwork:
    """Load a network that is described by a config of ``configs/network``.

    Args:
        settings: Section ``network`` of a config.
        weights: File of the network's state dict.
        classes: JSON file of the class names.
        normalization: See `Normalization.of`.
        depth: Kind of depth; None for a network that predicts classes.

    Raises:
        DataError: A file cannot be used.
        SettingError: A setting is missing.
    """
    if weights is None:
        raise SettingError("weights", found="none", expected="a file with the network's tensors")
    names = class_names_in(classes, depth)
    whole = completed_settings(settings, 3, len(names) or 1, restored=True)
    network = build_from_config(whole, "network")
    load_tensors(network, tensors_for(network, Path(weights)))
    normalized = Normalization.of(normalization, 3)
    kind: ScoreKind | None = None if depth else "logits"
    return PhotoNetwork(network, whole, names, normalized, score_kind=kind, depth_kind=depth)
