"""Numbers on the GPU beside float64 on the CPU; time and memory of the renderers."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, nullcontext
from functools import partial
from typing import Any

import torch
from torch import Tensor

from benchmarks.labels import NUM_CLASSES, random_scores
from benchmarks.measuring import DEVICE, Goal, Row, Table, Way, attempted, measure, peak_mib
from models import UNet
from tangent_train.geometry import TangentGrid, equirect_shape
from tangent_train.rendering import (
    TangentRepresentation,
    equirect_to_tangent,
    tangent_to_equirect,
    tangent_to_labels,
)
from tangent_train.tasks import SegmentationTask

_LEAST = 1e-12
"""Written for 0, of which there is no multiple."""


def correct(quick: bool) -> Iterator[Table]:
    """Errors in float32 and bf16, then the renderers at level 10."""
    torch.backends.cudnn.allow_tf32 = torch.backends.cuda.matmul.allow_tf32 = False
    exact = _numbers(torch.device("cpu"), torch.float64, nullcontext())
    half: Any = partial(torch.autocast, DEVICE.type, torch.bfloat16)
    for name, context, bound in (("float32", nullcontext, 1e-4), ("bf16", half, None)):
        found = _numbers(DEVICE, torch.float32, context())
        rows = [
            Row(key, [max(_LEAST, float((found[key] - true).norm() / true.norm()))], True)
            for key, true in exact.items()
        ]
        table = Table(f"correct: {name}, norm of the difference over the norm", rows, "")
        table.goals = [Goal(row.name, row.median, bound) for row in rows if bound]
        yield table
    yield from _renderers(6 if quick else 10)


def _numbers(
    device: torch.device, dtype: torch.dtype, context: AbstractContextManager[Any]
) -> dict[str, Tensor]:
    """What the renderers, a network and two training steps give for the same random numbers."""
    torch.manual_seed(0)
    grid, shape = TangentGrid(1, 6), equirect_shape(6)
    given = torch.randn(3, *shape, dtype=torch.float64), torch.randn(5, *shape, dtype=torch.float64)
    panorama, weights = (tensor.to(device, dtype) for tensor in given)
    labels = torch.randint(0, 6, (grid.num_images, grid.dim, grid.dim)).to(device, torch.uint8)
    network, optimizer = UNet(3, 5, [8, 16, 16]).double(), partial(torch.optim.SGD, lr=0.1)
    names = ("unknown", *"abcde")
    task = SegmentationTask(network, TangentRepresentation(1, 6), names, optimizer)
    images = equirect_to_tangent(panorama, grid)
    found = {"equirect_to_tangent": images}
    with context:
        scores = task.to(device, dtype).eval()(images).to(dtype).detach().requires_grad_()
    found["scores of a UNet"] = scores
    for blend in ("nearest", "feather"):
        rendered = tangent_to_equirect(scores, grid, shape, blend)
        (gradient,) = torch.autograd.grad((rendered * weights).sum(), scores)
        found |= {f"tangent_to_equirect, {blend}": rendered, f"its gradient, {blend}": gradient}
    descent = task.train().optimization(lambda: 2)
    for step in (1, 2):
        descent.zero_grad()
        with context:
            loss = task.loss_sum((images,), labels) / task.loss_norm(labels)
        torch.autograd.backward(loss)
        gradients = [p.grad.flatten() for p in task.parameters() if p.grad is not None]
        found[f"gradient of training step {step}"] = torch.cat(gradients)
        descent.step()
    found["weights after two steps"] = torch.cat([p.flatten() for p in task.parameters()])
    return {name: tensor.detach().double().cpu() for name, tensor in found.items()}


def _renderers(level: int) -> Iterator[Table]:
    """Of float32 scores, beside reading them once."""
    grid, shape = TangentGrid(1, level), equirect_shape(level)
    scores, panorama = random_scores(grid).to(DEVICE), torch.randn(3, *shape, device=DEVICE)
    calls: dict[str, Callable[[], Any]] = {
        "tangent_to_labels": partial(tangent_to_labels, scores, grid, shape),
        "tangent_to_equirect": partial(tangent_to_equirect, scores, grid, shape),
        "equirect_to_tangent, RGB": partial(equirect_to_tangent, panorama, grid),
        "tangent_to_labels, feather": partial(tangent_to_labels, scores, grid, shape, "feather"),
    }
    rows = measure([Way("reading the scores once", scores.sum)], 5)
    memory = [Row("the scores", [scores.nbytes / 2**20])]
    for name, call in calls.items():
        with attempted(name):
            rows += measure([Way(name, call, ours=True)], 3 if "feather" in name else 5)
            memory.append(Row(name, [memory[0].median + peak_mib(call)], ours=True))
    table = Table(f"correct: time of rendering, level {level}, {NUM_CLASSES} classes", rows)
    both = ("tangent_to_labels", "tangent_to_equirect")
    table.goals = [Goal(f"{n}, of reading the scores", table.ratio(n), 2) for n in both]
    yield table
    table = Table("correct: memory with the scores", memory, "MiB")
    table.goals = [Goal(f"{name}, of the scores'", table.ratio(name), 1.3) for name in both]
    yield table
