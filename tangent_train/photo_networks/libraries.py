"""Load photo networks of torchvision, segmentation-models-pytorch, ONNX files and own configs.

`LOADERS` has the function of each library. The first argument is the one that it needs.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Any

from torchvision import models
from torchvision.models import WeightsEnum

from datamodules.core.inputs import Normalization
from datamodules.core.label_map import UNKNOWN_NAME
from models.mask_rcnn import MASK_RCNNS
from models.onnx_network import OnnxNetwork
from models.pretrained import fetch_tensors, load_tensors, tensors_for
from tangent_train.checkpoints.loaded import completed_settings
from tangent_train.config.build import build_from_config
from tangent_train.config.from_file import build_from_file
from tangent_train.errors import SettingError, check_choice, first_line
from tangent_train.files import read_json
from tangent_train.imports import offline
from tangent_train.kinds import DepthKind
from tangent_train.photo_networks import huggingface
from tangent_train.photo_networks.network import (
    USUAL_SIZE,
    PhotoNetwork,
    class_names_in,
    saved_folder,
    tensors_in,
)

_AUXILIARY = "aux_classifier.", "classification_head."
"""Prefixes of the tensors of heads that are not used."""

_NO_CLASS = "N/A"
"""Name of labels of COCO that are not used."""

_DETECTION_SIZE = (800, 800)
"""Rows and columns of the images of Mask R-CNN: the shorter side in its training."""

_LEFT_OUT = {"activation", "aux_params"}
"""Settings that are not used: the activation after the scores, and a classification head."""


def load_torchvision(
    model: Any,
    weights: Any = None,
    classes: Path | None = None,
    normalization: Any = None,
    threshold: float | None = None,
) -> PhotoNetwork:
    """Load a network of ``torchvision.models.segmentation``, or Mask R-CNN.

    Args:
        model: Name of the network.
        weights: Name of published weights, or a file with a state dict. By default a file has the
            classes and the normalization of the default weights.
        classes: JSON file of the class names; None for the names of the weights. Of Mask R-CNN,
            the first name is that of the background.
        normalization: See `Normalization.of`; None for that of the weights.
        threshold: Score that an object of Mask R-CNN must exceed; None for 0.5.

    Raises:
        DataError: The weights cannot be fetched or read, or do not fit.
        SettingError: There is no such model, or no such weights.
    """
    check_choice("model", model, (*models.list_models(models.segmentation), *MASK_RCNNS))
    published = models.get_model_weights(model)
    is_file = weights is not None and Path(weights).is_file()
    if not is_file:
        check_choice("weights", weights, (*published.__members__, "a file"))
    chosen: WeightsEnum = published["DEFAULT" if is_file else weights]
    names = tuple(chosen.meta["categories"]) if classes is None else class_names_in(classes)
    if model in MASK_RCNNS:
        file = Path(weights) if is_file else None
        return _mask_rcnn(model, chosen, file, names, normalization, threshold or 0.5)
    preset: Any = chosen.transforms()
    settings = {
        "_target_": f"torchvision.models.segmentation.{model}",
        "num_classes": len(names),
        "weights": None,
        "weights_backbone": None,
    }
    if "aux_loss" in inspect.signature(models.get_model_builder(model)).parameters:
        settings["aux_loss"] = False
    network = build_from_config(settings, "network")
    tensors = tensors_for(network, Path(weights)) if is_file else fetch_tensors(str(chosen))
    _load_used(network, tensors, weights)
    return PhotoNetwork(
        module=network,
        settings=settings,
        score_names=names,
        normalization=Normalization.of(normalization or Normalization(preset.mean, preset.std), 3),
        image_size=(preset.resize_size[0], preset.resize_size[0]),
        score_kind="logits",
    )


def _mask_rcnn(
    model: str, chosen: WeightsEnum, file: Path | None, names: Any, colors: Any, threshold: float
) -> PhotoNetwork:
    """Load Mask R-CNN, which normalizes images itself; `file` None loads the published weights."""
    labels = [k for k, name in enumerate(names) if k and name != _NO_CLASS]
    colors = Normalization.of(colors or "imagenet", 3)
    settings = {
        "_target_": "models.MaskRCNN",
        "model": model,
        "num_labels": len(names),
        "labels": labels,
        "threshold": threshold,
        "image_mean": list(colors.mean),
        "image_std": list(colors.std),
    }
    module: Any = build_from_config(settings, "network")
    inner = module.network
    tensors = fetch_tensors(str(chosen)) if file is None else tensors_for(inner, file)
    load_tensors(inner, tensors, file or chosen)
    classes = tuple(names[k] for k in labels)
    return PhotoNetwork(
        module=module,
        settings=settings,
        score_names=(*classes, UNKNOWN_NAME),
        normalization=Normalization.of("unit", 3),
        image_size=_DETECTION_SIZE,
        score_kind="probabilities",
        things=classes,
        unknown=(UNKNOWN_NAME,),
    )


def load_smp(model: Any, classes: Path | None = None, normalization: Any = None) -> PhotoNetwork:
    """Load a network that segmentation-models-pytorch saved with ``save_pretrained``.

    Args:
        model: A folder, or a name on the hub.
        classes: JSON file of the class names.
        normalization: See `Normalization.of`; None for that of the encoder's published weights.

    Raises:
        DataError: A file is missing, or cannot be fetched or used.
        SettingError: The normalization is unknown.
    """
    folder = saved_folder(model)
    path = folder / "config.json"
    config = read_json(path, "the config of a model")
    settings = {
        "_target_": f"segmentation_models_pytorch.{config.get('_model_class')}",
        **{name: value for name, value in config.items() if not name.startswith("_")},
        "encoder_weights": None,
        **dict.fromkeys(_LEFT_OUT & config.keys()),
    }
    network = build_from_file(settings, "network", path)
    _load_used(network, tensors_in(folder), folder)
    return PhotoNetwork(
        module=network,
        settings=settings,
        score_names=class_names_in(classes),
        normalization=Normalization.of(normalization or _of_encoder(config), 3),
        score_kind="logits",
    )


def _of_encoder(config: dict[str, Any]) -> Normalization:
    """Return the normalization of the encoder's published weights."""
    from segmentation_models_pytorch import encoders  # type: ignore[import-untyped]

    name, weights = config.get("encoder_name"), config.get("encoder_weights") or "imagenet"
    try:
        with offline():  # the encoder's name is from a file
            given = encoders.get_preprocessing_params(name, weights)
        check_choice("input_space", given["input_space"], ("RGB",))
    except Exception as error:  # unknown name, or a file that was not fetched
        found = f"none, and no default for {name} ({first_line(error)})"
        expected = "imagenet, unit, symmetric, or {mean: […], std: […]} of RGB from 0 to 1"
        raise SettingError("normalization", found=found, expected=expected) from error
    largest = given["input_range"][1]
    mean, std = ([value / largest for value in given[key]] for key in ("mean", "std"))
    return Normalization(mean, std)


def _load_used(network: Any, tensors: dict[str, Any], source: object) -> None:
    used = {name: t for name, t in tensors.items() if not name.startswith(_AUXILIARY)}
    load_tensors(network, used, source)


def load_onnx(
    file: Any,
    classes: Path | None = None,
    normalization: Any = None,
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
        SettingError: The normalization is missing.
    """
    network = OnnxNetwork(file)
    size = network.fixed_size or USUAL_SIZE
    names, normalization = class_names_in(classes, depth), Normalization.of(normalization, 3)
    return PhotoNetwork(network, None, names, normalization, size, depth_kind=depth)


def load_config(
    weights: Any,
    network: Any,
    classes: Path | None = None,
    normalization: Any = None,
    depth: DepthKind | None = None,
) -> PhotoNetwork:
    """Load a network that is described by a config of ``configs/network``.

    Args:
        weights: File of the network's state dict.
        network: Section ``network`` of a config.
        classes: JSON file of the class names.
        normalization: See `Normalization.of`.
        depth: Kind of depth; None for a network that predicts classes.

    Raises:
        DataError: A file cannot be used.
        SettingError: The normalization is missing.
    """
    names, normalization = class_names_in(classes, depth), Normalization.of(normalization, 3)
    settings = completed_settings(network, 3, len(names) or 1, restored=True)
    module = build_from_config(settings, "network")
    load_tensors(module, tensors_for(module, Path(weights)), weights)
    kinds: Any = {"score_kind": None if depth else "logits", "depth_kind": depth}
    return PhotoNetwork(module, settings, names, normalization, **kinds)


LOADERS: dict[str | None, Callable[..., PhotoNetwork]] = {
    "torchvision": load_torchvision,
    "huggingface": huggingface.load,
    "smp": load_smp,
    "onnx": load_onnx,
    None: load_config,
}
"""Function that loads a network of each library; None is a config of ``configs/network``."""
