"""Load segmentation networks of torchvision."""

from __future__ import annotations

import inspect
from pathlib import Path
from typing import Any

from torchvision import models
from torchvision.models import WeightsEnum

from datamodules.core.inputs import Normalization
from models.pretrained import fetch_tensors, load_tensors, tensors_for
from tangent_train.config.build import build_from_config
from tangent_train.errors import SettingError
from tangent_train.photo_networks.network import PhotoNetwork, class_names_in

_AUXILIARY = "aux_classifier."


def load(
    *, model: str | None, weights: str | None, classes: Path | None, normalization: Any
) -> PhotoNetwork:
    """Load a network of ``torchvision.models.segmentation``.

    Args:
        model: Name of the network.
        weights: Name of published weights, or a file with a state dict. By default a file has the
            classes and the normalization of the default weights.
        classes: JSON file of the class names; None for the names of the weights.
        normalization: See `Normalization.of`; None for that of the weights.

    Raises:
        DataError: The weights cannot be fetched or read, or do not fit.
        SettingError: There is no such model, or no such weights.
    """
    known = models.list_models(models.segmentation)
    if model not in known:
        raise SettingError("model", found=model or "none", expected=", ".join(known))
    published = models.get_model_weights(model)
    is_file = weights is not None and Path(weights).is_file()
    if weights is None or not (is_file or weights in published.__members__):
        known = ", ".join(published.__members__)
        raise SettingError("weights", found=weights or "none", expected=f"{known}, or a file")
    chosen: WeightsEnum = published["DEFAULT" if is_file else weights]
    preset: Any = chosen.transforms()
    names = tuple(chosen.meta["categories"]) if classes is None else class_names_in(classes)
    settings = {
        "_target_": f"torchvision.models.segmentation.{model}",
        "num_classes": len(names),
        "weights": None,
        "weights_backbone": None,
    }
    if "aux_loss" in inspect.signature(models.get_model_builder(model)).parameters:
        settings["aux_loss"] = False
    network = build_from_config(settings, "network")
    file = Path(weights)
    tensors = tensors_for(network, file) if is_file else fetch_tensors(chosen)
    tensors = {name: t for name, t in tensors.items() if not name.startswith(_AUXILIARY)}
    load_tensors(network, tensors)
    default = Normalization(preset.mean, preset.std)
    return PhotoNetwork(
        module=network,
        settings=settings,
        score_names=names,
        normalization=default if normalization is None else Normalization.of(normalization, 3),
        image_size=(preset.resize_size[0], preset.resize_size[0]),
        score_kind="logits",
    )
