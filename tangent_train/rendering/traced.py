"""Rendering inside of `torch.compile`: one operation, which the compiler does not look into.

Tables of positions are built by NumPy and compiled kernels when the operation runs, not when a
graph is traced.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from typing import Any

import numpy as np
import torch
from torch import Tensor

from tangent_train import rendering
from tangent_train.errors import SettingError
from tangent_train.geometry import PinholeGrid


def is_traced() -> bool:
    """Return True in a function that `torch.compile` traces.

    Raises:
        SettingError: `torch.jit.trace` traces the function.
    """
    if torch.compiler.is_compiling():
        return True
    if torch._C._get_tracing_state() is not None:
        expected = "torch.compile: positions in panoramas are not operations of torch"
        raise SettingError("rendering", found="torch.jit.trace", expected=expected)
    return False


def traced(
    name: str, pixels: Any, grid: PinholeGrid, numbers: Iterable[Any] | None, *options: str
) -> Any:
    """Add the call of a function of `tangent_train.rendering` to the traced graph.

    Args:
        name: Name of the function.
        pixels: Its first argument.
        grid: Its second argument.
        numbers: Its third argument.
        options: Its other arguments.
    """
    rotation = None if grid.rotation is None else torch.as_tensor(grid.rotation)
    chosen = None if numbers is None else [int(number) for number in numbers]
    kinds = [grid.is_overlapping, grid.is_complete]
    return _render(
        pixels,
        torch.as_tensor(grid._axes),
        rotation,
        list(grid.pitches),
        list(grid.size),
        kinds,
        name,
        chosen,
        " ".join(options),
    )


def _renderer(name: str) -> Callable[..., Tensor]:
    renderer: Callable[..., Tensor] = getattr(rendering, name)
    return renderer


@lru_cache(maxsize=16)
def _grid(
    axes: bytes,
    rotation: bytes | None,
    pitches: tuple[float, ...],
    size: tuple[int, int],
    kinds: tuple[bool, ...],
) -> PinholeGrid:
    matrices = np.frombuffer(axes).reshape(-1, 3, 3)
    rotated = None if rotation is None else np.frombuffer(rotation).reshape(3, 3)
    named = dict(zip(("is_overlapping", "is_complete"), kinds, strict=True))
    return PinholeGrid(matrices, size, pitches[0], rotated, row_pitch=pitches[1], **named)


@torch.library.custom_op("tangent_train::render", mutates_args=())
def _render(
    pixels: Tensor, axes: Tensor, rotation: Tensor | None, pitches: list[float], size: list[int],
    kinds: list[bool], name: str, numbers: list[int] | None, options: str,
) -> Tensor:  # fmt: skip
    """Call a function of `tangent_train.rendering`."""
    turned = None if rotation is None else rotation.numpy(force=True).tobytes()
    sides = (size[0], size[1])
    grid = _grid(axes.numpy(force=True).tobytes(), turned, (*pitches,), sides, (*kinds,))
    return _renderer(name)(pixels.detach(), grid, numbers, *options.split()).contiguous()


@_render.register_fake
def _(
    pixels: Tensor, axes: Tensor, rotation: Tensor | None, pitches: list[float], size: list[int],
    kinds: list[bool], name: str, numbers: list[int] | None, options: str,
) -> Tensor:  # fmt: skip
    del rotation, pitches, kinds, options
    if name == "equirect_to_tangent":
        count = len(axes) if numbers is None else len(numbers)
        return pixels.new_empty((*pixels.shape[:-3], count, pixels.shape[-3], *size))
    shape = (*pixels.shape[:-4], *(numbers or ()))
    if name == "tangent_to_labels":
        return pixels.new_empty(shape, dtype=torch.int64)
    return pixels.new_empty((*pixels.shape[:-4], pixels.shape[-3], *(numbers or ())))


@torch.library.custom_op("tangent_train::render_gradient", mutates_args=())
def _gradient(
    gradient: Tensor, shape: list[int], axes: Tensor, rotation: Tensor | None, pitches: list[float],
    size: list[int], kinds: list[bool], name: str, numbers: list[int] | None, options: str,
) -> Tensor:  # fmt: skip
    """Return the gradient of the pixels; rendering is linear in them."""
    turned = None if rotation is None else rotation.numpy(force=True).tobytes()
    sides = (size[0], size[1])
    grid = _grid(axes.numpy(force=True).tobytes(), turned, (*pitches,), sides, (*kinds,))

    def differentiate() -> Tensor:
        pixels = gradient.new_zeros(shape).requires_grad_()
        rendered = _renderer(name)(pixels, grid, numbers, *options.split())
        return torch.autograd.grad(rendered, pixels, gradient.detach())[0].contiguous()

    with ThreadPoolExecutor(1) as new:  # this thread records no gradients inside of an operation
        return new.submit(differentiate).result()


@_gradient.register_fake
def _(gradient: Tensor, shape: list[int], *_: Any) -> Tensor:
    return gradient.new_empty(shape)


def _keep(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
    del output
    pixels, axes, rotation, *others = inputs
    ctx.save_for_backward(axes, rotation)
    ctx.arguments = list(pixels.shape), others


def _differentiate(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
    shape, others = ctx.arguments
    return (_gradient(gradient, shape, *ctx.saved_tensors, *others), *[None] * 8)


_render.register_autograd(_differentiate, setup_context=_keep)
