"""Classes and functions of other libraries that settings in files may name, and their arguments.

Arguments are numbers, strings and lists of these; arguments that would read, download or run
something (weights, URLs, files, plugins) are excluded.
"""

from __future__ import annotations

import inspect
from importlib import import_module
from types import NoneType
from typing import Any

from tangent_train.config.build import Weights, import_named
from tangent_train.config.setting_rules import from_file

_SIMPLE: Any = int | float | bool | str | None | list[int | float | bool | str | None]

_BY_SIGNATURE = {
    "lightning": "Trainer",
    "torch.nn": "Conv2d",
    "torch.optim": "ASGD Adadelta Adagrad Adam AdamW Adamax NAdam RAdam RMSprop Rprop SGD",
    "torch.optim.lr_scheduler": "ConstantLR CosineAnnealingLR CosineAnnealingWarmRestarts CyclicLR "
    "ExponentialLR LinearLR MultiStepLR OneCycleLR PolynomialLR ReduceLROnPlateau StepLR",
    "segmentation_models_pytorch": "DPT DeepLabV3 DeepLabV3Plus FPN Linknet MAnet PAN PSPNet "
    "Segformer UPerNet Unet UnetPlusPlus",
}
"""Classes whose named arguments are allowed, except for weights and settings of this machine."""

_NETWORKS = (
    "aux_logits aux_loss drop_path_rate drop_rate dropout dynamic_img_size features_only "
    "global_pool image_size img_size in_chans init_weights model_name num_classes out_indices "
    "patch_size stochastic_depth_prob transform_input width_mult"
)
"""Allowed arguments of torchvision's and timm's functions that build networks."""


def find(module: str, name: str) -> tuple[Any, dict[str, Any]] | None:
    """Find a class or function, with the kinds of its arguments in a file.

    See `build_from_config`.

    Args:
        module: Full name of the module.
        name: Name in the module.

    Returns:
        Class or function, and kinds by argument; None if files may not name it.

    Raises:
        SettingError: The package is not installed.
    """
    is_listed = name in _BY_SIGNATURE.get(module, "").split()
    is_timm = (module, name) == ("timm", "create_model")
    if not (is_listed or is_timm or _is_torchvision_network(module, name)):
        return None
    target = import_named(f"{module}.{name}", "network")
    parameters = inspect.signature(target).parameters.values()
    named = [p.name for p in parameters if p.kind is not p.VAR_KEYWORD]
    kinds = dict.fromkeys(named if is_listed else _NETWORKS.split(), _SIMPLE)
    weights = [n for n in named if "weights" in n or n == "pretrained"]
    local = [n for n in named if module == "lightning" and not from_file(f"trainer.{n}")]
    return target, kinds | dict.fromkeys(local, NoneType) | dict.fromkeys(weights, Weights)


def _is_torchvision_network(module: str, name: str) -> bool:
    if module not in ("torchvision.models", "torchvision.models.segmentation"):
        return False
    from torchvision.models import get_model_builder, list_models

    builder = getattr(import_module(module), name, None)
    return name in list_models() and get_model_builder(name) is builder
