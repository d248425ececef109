"""Networks in files are numbers and computations: no programs, no other files."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import onnx
import pytest
import torch
from torch import nn

from tangent_train.checkpoints.trained import load_trained
from tangent_train.errors import DataError
from tests.security.watch import watched


def test_networks_are_one_file(run: Path, tmp_path: Path) -> None:
    model = onnx.load(run.parent / "net.onnx")
    tensor = model.graph.initializer[0]
    onnx.external_data_helper.set_external_data(tensor, "/etc/hostname")
    tensor.ClearField("raw_data")
    (tmp_path / "x.onnx").write_bytes(model.SerializeToString())
    with pytest.raises(DataError, match=r"x\.onnx: found tensors in other files"):
        load_trained(tmp_path / "x.onnx")


class Saving(nn.Module):
    """Writes a file when it is used."""

    def __init__(self, path: str) -> None:
        super().__init__()
        self.path = path

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        torch.save(images, self.path)
        return images


@pytest.mark.parametrize("order", ["program", "program first", "program last"])
def test_programs_of_torchscript_are_refused(
    order: str, content: dict[str, Any], forbidden: Path
) -> None:
    """Also in a file that holds two archives, of which two readers may find two."""
    path = forbidden.parent / "x.pt"
    torch_script: Any = torch.jit
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        torch_script.save(torch_script.script(Saving(str(forbidden / "x"))), str(path))
    program = path.read_bytes()
    torch.save(content, path)
    honest = path.read_bytes()
    parts = {"program": [program], "program first": [program, honest]}
    path.write_bytes(b"".join(parts.get(order, [honest, program])))
    refused = pytest.raises(DataError, match=r"x\.pt: found a damaged file")
    with watched(forbidden) as happened, refused:
        load_trained(path)
    assert not happened
    assert not (forbidden / "x").exists()
