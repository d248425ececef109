"""Masks of panoramas from a network: pixels of some of its classes do not count."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeGuard

import numpy as np

from datamodules.core.label_map import PIXEL_CLASSES
from datamodules.folder.class_masks import ignored_labels
from tangent_train.checkpoints.loaded import load_network
from tangent_train.errors import SettingError
from tangent_train.heads import head_of
from tangent_train.inference.engine import Predictor
from tangent_train.inference.views import ViewSelector

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from tangent_train.config.settings import PredictSettings
    from tangent_train.inference.images import InputImage

_SUFFIXES = (".ckpt", ".onnx", ".safetensors")


def is_network(mask: object) -> TypeGuard[Path]:
    """Return True if a mask is the file of a network."""
    return isinstance(mask, Path) and mask.suffix.lower() in _SUFFIXES


class MaskNetwork:
    """Returns where a panorama does not show some classes, in the views of the network.

    Args:
        file: The network.
        settings: Settings of the prediction.

    Raises:
        DataError: The network cannot be read.
        SettingError: It does not predict these classes from RGB images.
    """

    def __init__(self, file: Path, settings: PredictSettings) -> None:
        loaded = replace(load_network(file, settings.trust), things=())
        loaded.check_predicts(PIXEL_CLASSES, f"mask={file} masks classes.")
        if "depth" in loaded.inputs:
            found = f"{file}, a network that takes depth"
            raise SettingError("mask", found=found, expected="a network for RGB images")
        self._labels = ignored_labels(loaded.class_names[1:], settings.mask_classes)
        views, on_device = ViewSelector(loaded, fill=settings.fill), settings.device
        self._predictor = Predictor(
            loaded, head_of(loaded), views, on_device, settings.view_batch_size
        )

    def __call__(self, image: InputImage) -> NDArray[np.bool_]:
        """Return ``(H, W)``, False where the classes are."""
        labels: Any = self._predictor.predict(image).pixels().cpu().numpy()
        return np.isin(labels, self._labels, invert=True)
