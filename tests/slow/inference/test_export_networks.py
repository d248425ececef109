"""Every kind of network can be exported: the same scores in any size."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from tangent_train.checkpoints.trained import load_trained
from tangent_train.inference.export import SUFFIXES, export_network
from tests.tasks.odd_networks import assert_same, scores_of, some_images
from tests.tasks.small_networks import UNET, small_trained

NETWORKS: dict[str, dict[str, Any]] = {
    "unet, stride 32": {**UNET, "widths": [4, 4, 8, 8, 8, 8]},
    "hexunet": {"_target_": "models.HexUNet", "in_channels": 4, "num_classes": 4},
    "fcn, frozen statistics": {
        "_target_": "models.FCNResNet",
        "in_channels": 4,
        "num_classes": 4,
        "depth": 50,
        "frozen_statistics": True,
    },
    "deeplabv3": {
        "_target_": "models.widen_stem",
        "in_channels": 4,
        "network": {
            "_target_": "torchvision.models.segmentation.deeplabv3_mobilenet_v3_large",
            "num_classes": 4,
            "weights": None,
            "weights_backbone": None,
            "aux_loss": False,
        },
    },
    "context, of which every image is alone": {
        "_target_": "models.SphereContext",
        "in_channels": 4,
        "stage": "downs.1",
        "mixer": {"_target_": "models.SphereAttention", "_partial_": True, "heads": 2},
        "network": UNET,
    },
    "smp": {
        "_target_": "segmentation_models_pytorch.Unet",
        "encoder_name": "resnet18",
        "encoder_weights": None,
        "in_channels": 4,
        "classes": 4,
    },
}


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize("name", NETWORKS)
def test_files_compute_the_same(name: str, suffix: str, tmp_path: Path) -> None:
    trained = small_trained(NETWORKS[name], image_size=(64, 64))
    path = tmp_path / f"net{suffix}"
    assert export_network(trained, path).trained.fixed_size is None
    again, step = load_trained(path), trained.size_multiple
    for count, size in ((1, (64, 96)), (5, (32 + step, 64))):
        images = some_images(trained, count, size)
        assert_same(again.network(images).detach(), scores_of(trained, images))
