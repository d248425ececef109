"""The kernel for GPUs, run by Triton's interpreter, and compiled for GPUs that are not here."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import torch

from tangent_train import rendering
from tangent_train.geometry import TangentGrid
from tangent_train.rendering import backward, tangent_to_labels

pytest.importorskip("triton")

INTERPRETED = """
import numpy as np
import torch

from tangent_train.geometry import TangentGrid
from tangent_train.rendering import tangent_to_labels
from tangent_train.rendering.gpu_labels import owner_labels, usable
from tangent_train.rendering.tables import owner_table

assert usable(torch.device("cpu"))
for shape in ((32, 64), (31, 57)):
    for grid, classes in ((TangentGrid(0, 5), 3), (TangentGrid(1, 5), 300), (TangentGrid(0, 3), 1)):
        arrays = owner_table(grid, shape, np.dtype(np.float32)).arrays
        size = (grid.num_images, classes, grid.dim, grid.dim)
        scores = torch.randn(size, generator=torch.Generator().manual_seed(0))
        scores[3], scores[4], scores[5], scores[6, 0] = torch.nan, -torch.inf, 1.0, torch.nan
        labels = torch.full(shape, 7, dtype=torch.uint8 if classes <= 256 else torch.uint16)
        owner_labels(scores, *map(torch.from_numpy, arrays), labels)
        exact = tangent_to_labels(scores.double(), grid, shape)
        assert (labels.long() == exact).double().mean() > 0.999, (shape, classes)
        of_no_number = np.isin(arrays[0][0], (3, 4, 5))
        assert not labels.numpy()[of_no_number].any()
        assert classes == 1 or labels.numpy().any()
"""

COMPILED = """
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource, compile

from tangent_train.rendering.gpu_labels import _owner_labels

for scores, faces, labels in (("fp32", "u8", "u8"), ("bf16", "i16", "u16"), ("fp16", "i32", "u8")):
    kinds = {"scores": f"*{scores}", "faces": f"*{faces}", "columns": "*fp32", "rows": "*fp32"}
    kinds |= {"labels": f"*{labels}", "num_pixels": "i32", "num_classes": "i32", "dim": "i32"}
    source = ASTSource(_owner_labels, kinds | {"block": "constexpr"}, {"block": 256})
    for capability in (80, 90):
        target = GPUTarget("cuda", capability, 32)
        made = compile(source, target=target, options={"enable_fp_fusion": False})
        assert len(made.asm["cubin"]) > 1000
"""


@pytest.mark.parametrize(
    ("code", "interpret"),
    [(INTERPRETED, "1"), pytest.param(COMPILED, "0", marks=pytest.mark.slow)],
    ids=["interpreted", "compiled"],
)
def test_the_kernel(
    code: str, interpret: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In a process of its own: Triton decides when it is imported."""
    monkeypatch.setenv("TRITON_INTERPRET", interpret)
    monkeypatch.setenv("TRITON_CACHE_DIR", str(tmp_path))
    done = subprocess.run(
        [sys.executable, "-W", "error::UserWarning", "-c", code],
        check=False,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr[-3000:]


class _OnGpu:
    """What is asked of scores before they are rendered."""

    device = torch.device("cuda")
    is_cuda = True

    def __init__(self, dtype: torch.dtype) -> None:
        self.dtype = dtype


@pytest.mark.parametrize(
    ("dtype", "blend", "triton", "fused"),
    [
        (torch.float32, "nearest", True, True),
        (torch.bfloat16, "nearest", True, True),
        (torch.float64, "nearest", True, False),
        (torch.float32, "feather", True, False),
        (torch.float32, "nearest", False, False),
    ],
)
def test_torch_renders_what_the_kernel_cannot(
    dtype: torch.dtype, blend: Any, triton: bool, fused: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(backward, "_has_triton", lambda _: triton)
    scores: Any = _OnGpu(dtype)
    render = backward._label_renderer(scores, TangentGrid(0, 5), blend)
    assert render == (backward._gpu_labels if fused else backward._torch_labels)


def test_without_triton_there_is_torch(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(sys.modules, "tangent_train.rendering.gpu_labels", raising=False)
    monkeypatch.delattr(rendering, "gpu_labels", raising=False)
    monkeypatch.setitem(sys.modules, "triton", None)
    assert not backward._has_triton(torch.device("cuda"))


def test_where_triton_does_not_work_there_is_torch() -> None:
    """As without a compiler or, here, without a GPU."""
    assert not backward._has_triton(torch.device("cpu"))


def test_the_kernel_gets_the_tables_of_the_grid(monkeypatch: pytest.MonkeyPatch) -> None:
    """With the kernel replaced by what NumPy makes of the same arguments."""
    from tangent_train.rendering import gpu_labels

    def nearest(
        scores: torch.Tensor,
        face: torch.Tensor,
        u: torch.Tensor,
        v: torch.Tensor,
        labels: torch.Tensor,
    ) -> None:
        row, column = (line.round().long().clamp(0, scores.shape[-1] - 1) for line in (v, u))
        labels[:] = scores[face.long(), :, row, column].argmax(-1)

    monkeypatch.setattr(gpu_labels, "owner_labels", nearest)
    grid, shape = TangentGrid(0, 6), (64, 128)
    generator = torch.Generator().manual_seed(0)
    scores = torch.rand((20, 4, 1, 1), generator=generator).expand(20, 4, grid.dim, grid.dim)
    labels = torch.empty(shape, dtype=torch.uint8)
    backward._gpu_labels(scores, grid, "nearest", labels)
    assert torch.equal(labels.long(), tangent_to_labels(scores, grid, shape))
