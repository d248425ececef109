"""Commands with a depth network that takes all views of a panorama in one call."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from tangent_train.checkpoints.loaded import load_network
from tangent_train.errors import SettingError
from tangent_train.inference.export import export_network
from tangent_train.io.pixel_files import read_depth_m, write_pixels
from tangent_train.photo_networks import PhotoNetwork, import_network
from tests.cli.tiny_runs import Predict, Run
from tests.datamodules.folder.folder_format import write_data_set
from tests.inference.test_many_views import UNIT
from tests.inference.trained import sphere
from tests.running import Capture


class Bright(nn.Module):
    """Distance of a bright pixel is large; a network with a parameter, which needs cameras."""

    def __init__(self, size_multiple: int = 4) -> None:
        super().__init__()
        self.size_multiple = size_multiple
        self.nearest = nn.Parameter(torch.tensor(1.5))

    def forward(self, images: Tensor, world_from_camera: Tensor, camera_matrix: Tensor) -> Any:
        assert camera_matrix.shape == world_from_camera.shape == (len(images), 3, 3)
        distance = self.nearest + images[:, 0]
        own = world_from_camera.roll(1, dims=0)
        return {"out": distance, "confidence": distance, "world_from_camera": own}


SETTINGS = {"_target_": f"{__name__}.Bright", "size_multiple": 8}
GIVEN = f"trust={__name__}.Bright"


def test_imported_networks_predict_evaluate_and_are_exported(
    tmp_path: Path, run: Run, predict: Predict, capsys: Capture
) -> None:
    network = PhotoNetwork(Bright(8), SETTINGS, (), UNIT, (32, 32), depth_kind="metric_distance")
    path = tmp_path / "net.ckpt"
    loaded = import_network(network, path)
    assert loaded.size_multiple == 8
    write_pixels(tmp_path / "in" / "hall.png", sphere(64))
    entry = predict(checkpoint=path, write="[depth]", trust=f"[{__name__}.Bright]")["hall"]
    assert entry["depth"]["rotation_error_deg"] > 1
    assert "error of the network's own rotations, °" in capsys.readouterr().out
    depth = read_depth_m(tmp_path / "out" / "depth" / "hall.png", 1000)
    np.testing.assert_allclose(depth, 1.5 + sphere(64)[..., 0] / 255, atol=0.05)
    write_data_set(tmp_path / "rooms", each=1, height=64, depth=True)
    data = "data=folder", "task=depth", f"data.root={tmp_path / 'rooms'}", "data.inputs=[rgb]"
    run("evaluate", f"checkpoint={path}", *data, GIVEN, "hydra.run.dir=scores")
    record = json.loads((tmp_path / "scores" / "results.json").read_text())
    assert 0 < record["scores"]["absrel"] < 10
    run("export", f"checkpoint={path}", f"output={tmp_path / 'net.safetensors'}", GIVEN)
    again = load_network(tmp_path / "net.safetensors", [f"{__name__}.Bright"])
    assert again.network.takes_cameras
    with pytest.raises(SettingError, match="without their cameras"):
        export_network(loaded, tmp_path / "net.onnx")
