"""Commands with a depth network that takes all views of a panorama in one call."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import save_file
from torch import Tensor, nn

from models import DepthAnything3
from tangent_train.checkpoints.loaded import load_network
from tangent_train.errors import SettingError
from tangent_train.inference.export import export_network
from tangent_train.io.pixel_files import read_depth_m, write_pixels
from tangent_train.photo_networks import PhotoNetwork, import_network
from tests.cli.tiny_runs import Predict, Run, results
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


@pytest.mark.filterwarnings("ignore::FutureWarning", "ignore::DeprecationWarning")
def test_depth_anything_3_is_imported_predicts_is_evaluated_and_exported(
    tmp_path: Path, run: Run, predict: Predict
) -> None:
    """The small network of the package, with random weights."""
    pytest.importorskip("depth_anything_3")
    torch.manual_seed(0)
    tensors = DepthAnything3("da3-small").state_dict()
    save_file({name: tensor.clone() for name, tensor in tensors.items()}, "da3.safetensors")
    given = "network=depth_anything_3", "network.preset=da3-small", "weights=da3.safetensors"
    described = "depth=relative_z", "normalization=imagenet", "image_size=56"
    run("import", *given, *described, "output=da3.ckpt")
    write_pixels(tmp_path / "in" / "hall.png", sphere(64))
    entry = predict(checkpoint="da3.ckpt", write="[depth]")["hall"]["depth"]
    assert (entry["known"], entry["unit"]) == (1, "relative")
    assert entry["median"] == pytest.approx(1, rel=0.1)
    assert 0 <= entry["rotation_error_deg"] <= 180
    data = "data=folder", "task=depth", "data.root=rooms", "data.inputs=[rgb]"
    write_data_set(tmp_path / "rooms", each=1, height=64, depth=True)
    how = "task.head.alignment=median", "+representation.erp_height=64", "hydra.run.dir=scores"
    run("evaluate", "checkpoint=da3.ckpt", *data, *how)
    scores = results(tmp_path / "scores")
    assert scores["protocol"]["alignment"] == "median in distance"
    assert 0 < scores["scores"]["absrel"] < 10
    run("export", "checkpoint=da3.ckpt", "output=net.safetensors")
    again = load_network(tmp_path / "net.safetensors").module.state_dict()
    assert all(torch.equal(again[name], tensor) for name, tensor in tensors.items())
    with pytest.raises((SettingError, SystemExit), match="without their cameras"):
        run("export", "checkpoint=da3.ckpt", "output=net.onnx")
