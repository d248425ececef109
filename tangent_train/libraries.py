"""What settings in files may name of other libraries, and with which settings.

Each is made of numbers and words only: whatever would read, fetch or run something (weights,
addresses, files, plugins) is not among them.
"""

from __future__ import annotations

import inspect
from importlib import import_module
from typing import TYPE_CHECKING, Any, Literal

from tangent_train.registry import SIMPLE, Local, Weights

if TYPE_CHECKING:
    from collections.abc import Mapping

__all__ = ["find"]

_BY_SIGNATURE = {
    "torch.nn": "Conv2d",
    "torch.optim": "ASGD Adadelta Adagrad Adam AdamW Adamax NAdam RAdam RMSprop Rprop SGD",
    "torch.optim.lr_scheduler": (
        "ConstantLR CosineAnnealingLR CosineAnnealingWarmRestarts CyclicLR ExponentialLR LinearLR "
        "MultiStepLR OneCycleLR PolynomialLR StepLR"
    ),
    "segmentation_models_pytorch": (
        "DPT DeepLabV3 DeepLabV3Plus FPN Linknet MAnet PAN PSPNet Segformer UPerNet Unet "
        "UnetPlusPlus"
    ),
}
"""Classes all of whose named settings may be given, as numbers, words or lists of these."""

_TORCHVISION = ("torchvision.models", "torchvision.models.segmentation")
_OF_TORCHVISION = {
    "aux_logits": bool,
    "aux_loss": bool | None,
    "dropout": float,
    "image_size": int,
    "init_weights": bool,
    "num_classes": int,
    "progress": bool,
    "stochastic_depth_prob": float,
    "transform_input": bool,
    "width_mult": float,
}
_OF_TIMM = {
    "drop_path_rate": float | None,
    "drop_rate": float,
    "dynamic_img_size": bool,
    "features_only": bool,
    "global_pool": str,
    "img_size": int | list[int],
    "in_chans": int,
    "model_name": str,
    "num_classes": int,
    "out_indices": list[int],
    "patch_size": int,
    "pretrained": Weights,
}
_Share = int | float | None
_OF_TRAINER = {
    "accelerator": Literal["auto", "cpu", "cuda", "gpu", "mps"],
    "accumulate_grad_batches": int,
    "barebones": bool,
    "benchmark": bool | None,
    "check_val_every_n_epoch": int | None,
    "default_root_dir": Local,
    "detect_anomaly": bool,
    "deterministic": bool | Literal["warn"] | None,
    "devices": int | Literal["auto"],
    "enable_checkpointing": bool | None,
    "enable_model_summary": bool | None,
    "enable_progress_bar": bool | None,
    "fast_dev_run": bool | int,
    "gradient_clip_algorithm": Literal["norm", "value"] | None,
    "gradient_clip_val": float | None,
    "inference_mode": bool,
    "limit_predict_batches": _Share,
    "limit_test_batches": _Share,
    "limit_train_batches": _Share,
    "limit_val_batches": _Share,
    "log_every_n_steps": int | None,
    "max_epochs": int | None,
    "max_steps": int,
    "max_time": Local,
    "min_epochs": int | None,
    "min_steps": int | None,
    "num_nodes": int,
    "num_sanity_val_steps": int | None,
    "overfit_batches": int | float,
    "precision": int
    | Literal["16-mixed", "16-true", "32", "32-true", "64", "64-true", "bf16-mixed", "bf16-true"]
    | None,
    "profiler": Local,
    "reload_dataloaders_every_n_epochs": int,
    "strategy": Literal[
        "auto", "ddp", "ddp_find_unused_parameters_false", "ddp_find_unused_parameters_true"
    ],
    "sync_batchnorm": bool,
    "val_check_interval": _Share,
}


def find(module: str, name: str) -> tuple[Any, Mapping[str, Any]] | None:
    """A class or function and the kinds of its settings, see `registry.registered`.

    Args:
        module: Its full name.
        name: In the module.

    Returns:
        None where files may not name it.

    Raises:
        ModuleNotFoundError: Its package is not installed.
    """
    if name in _BY_SIGNATURE.get(module, "").split():
        return _by_signature(getattr(import_module(module), name))
    if module in _TORCHVISION:
        return _of_torchvision(module, name)
    if (module, name) == ("timm", "create_model"):
        return import_module(module).create_model, _OF_TIMM
    if (module, name) == ("lightning", "Trainer"):
        return import_module(module).Trainer, _OF_TRAINER
    return None


def _by_signature(made: Any) -> tuple[Any, Mapping[str, Any]]:
    named = inspect.signature(made).parameters.values()
    kinds = dict.fromkeys((p.name for p in named if p.kind is not p.VAR_KEYWORD), SIMPLE)
    return made, kinds | {name: Weights for name in kinds if name.endswith("weights")}


def _of_torchvision(module: str, name: str) -> tuple[Any, Mapping[str, Any]] | None:
    from torchvision.models import get_model_builder, list_models

    maker = getattr(import_module(module), name, None)
    if name not in list_models() or get_model_builder(name) is not maker:
        return None
    named = inspect.signature(maker).parameters
    return maker, _OF_TORCHVISION | {n: Weights for n in named if n.startswith("weights")}
