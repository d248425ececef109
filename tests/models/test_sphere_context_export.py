"""Networks with context in other programs: every image alone, in any size."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest
import torch

from models import SphereContext
from tangent_train.checkpoints.trained import Scores, load_trained
from tangent_train.inference.export import SUFFIXES, Format, export_network
from tests.models.sphere_networks import awake
from tests.tasks.odd_networks import assert_same, scores_of, some_images
from tests.tasks.small_networks import small_trained

if TYPE_CHECKING:
    from pathlib import Path

CONTEXT: dict[str, Any] = {
    "_target_": "models.SphereContext",
    "in_channels": 4,
    "stage": "network.downs.1",
    "mixer": {"_target_": "models.SphereAttention", "_partial_": True, "heads": 2},
    "network": {
        "_target_": "models.AuxiliaryHead",
        "in_channels": 4,
        "num_classes": 5,
        "stage": "downs.1",
        "network": {
            "_target_": "models.UNet",
            "in_channels": 4,
            "num_classes": 5,
            "widths": [4, 8, 8],
        },
    },
}


@pytest.mark.parametrize("form", ["onnx", "safetensors"])
def test_files_compute_the_same_in_any_size(form: Format, tmp_path: Path) -> None:
    trained = small_trained(CONTEXT)
    assert isinstance(trained.network, Scores)
    context = trained.network.network
    assert isinstance(context, SphereContext)
    awake(context.mixer, 3.0)
    path = tmp_path / f"net{SUFFIXES[form]}"
    exported = export_network(trained, path, form)
    assert exported.trained.fixed_size is None
    again = load_trained(path).network
    for size in ((4, 8), (12, 12), (40, 24), (16, 100)):
        images = some_images(trained, 3, size)
        with torch.no_grad():
            assert_same(again(images), scores_of(trained, images))
            plain = context.network(images)
        assert torch.equal(plain, scores_of(trained, images)), "context of others only"
