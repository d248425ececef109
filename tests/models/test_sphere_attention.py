"""Attention over the sphere against its formula, written out slowly in float64."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from models import SphereAttention
from models.sphere_attention import angular_attention
from models.stages import token_directions
from tangent_train.geometry import random_rotation
from tests.models.sphere_networks import awake, sphere_rays


def _inputs() -> tuple[Tensor, Tensor]:
    """Tokens of two spheres of five images, and directions that differ from sphere to sphere."""
    rotation = torch.tensor(random_rotation(np.random.default_rng(1)), dtype=torch.float32)
    rays = torch.cat([sphere_rays(5), rotation @ sphere_rays(5).roll(1, 1)])
    return torch.randn(2, 5, 12, 2, 3), token_directions(rays, 2, 3)


def _mixer() -> SphereAttention:
    mixer = SphereAttention(12, heads=3, width=6)
    awake(mixer)
    torch.nn.init.uniform_(mixer.log_kappa, -2, 3)
    return mixer.eval()


def _slow(mixer: SphereAttention, tokens: Tensor, directions: Tensor) -> Tensor:
    """The definition, one pair of tokens after the other."""
    weights = {name: tensor.double() for name, tensor in mixer.state_dict().items()}
    kappa = weights["log_kappa"].exp()
    result = torch.zeros_like(tokens, dtype=torch.float64)
    images, channels, rows, columns = tokens.shape[1:]
    places = [(i, r, c) for i in range(images) for r in range(rows) for c in range(columns)]
    for sphere, sphere_directions, out in zip(tokens, directions, result, strict=True):
        x = torch.stack([sphere[i, :, r, c] for i, r, c in places]).double()
        d = torch.stack([sphere_directions[i, :, r, c] for i, r, c in places]).double()
        x = (x - x.mean(1, keepdim=True)) / (x.var(1, correction=0, keepdim=True) + 1e-5).sqrt()
        x = x * weights["norm.weight"] + weights["norm.bias"]
        projected = x @ weights["queries_keys_values.weight"].T
        projected += weights["queries_keys_values.bias"]
        q, k, v = projected.reshape(len(places), 3, mixer.heads, -1).unbind(1)
        for i, place in enumerate(places):
            heads = []
            for head in range(mixer.heads):
                logits = [
                    float(q[i, head] @ k[j, head]) / math.sqrt(q.shape[-1])
                    + float(kappa[head]) * (float(d[i] @ d[j]) - 1)
                    for j in range(len(places))
                ]
                odds = np.exp(logits)
                same_image = odds * [other[0] == place[0] for other in places]
                share = odds / odds.sum() - same_image / same_image.sum()
                heads.append(torch.tensor(share) @ v[:, head])
            out[place[0], :, place[1], place[2]] = weights["output.weight"] @ torch.cat(heads)
    assert result.shape[2] == channels
    return result


def test_it_computes_its_formula() -> None:
    mixer, (tokens, directions) = _mixer(), _inputs()
    expected = _slow(mixer, tokens, directions)
    torch.testing.assert_close(mixer(tokens, directions).double(), expected, rtol=1e-4, atol=1e-5)
    exact = mixer.double()(tokens.double(), directions)
    torch.testing.assert_close(exact, expected, rtol=1e-6, atol=1e-6)


def test_it_starts_from_nothing_and_every_parameter_learns() -> None:
    mixer, (tokens, directions) = SphereAttention(12, heads=3, width=6), _inputs()
    assert not mixer(tokens, directions).any()
    kappa = mixer.log_kappa.exp()
    assert kappa[0] < 0.2
    assert kappa[-1] > 20
    torch.testing.assert_close(kappa[1] / kappa[0], kappa[2] / kappa[1])
    torch.nn.init.normal_(mixer.get_parameter("output.weight"))
    loss: Any = (mixer(tokens, directions) * torch.randn_like(tokens)).sum()
    loss.backward()
    for name, parameter in mixer.named_parameters():
        assert parameter.grad is not None
        assert parameter.grad.any(), name


def test_half_precision_does_not_blur_directions() -> None:
    mixer, (tokens, directions) = _mixer(), _inputs()
    torch.nn.init.constant_(mixer.log_kappa, math.log(300.0))
    expected = mixer(tokens, directions)
    with torch.autocast("cpu", torch.bfloat16):
        found = mixer(tokens, directions)
    assert found.dtype == torch.bfloat16
    torch.testing.assert_close(found.float(), expected, rtol=0.1, atol=0.1)
    queries = torch.zeros(1, 1, 2, 4, dtype=torch.bfloat16)
    close = torch.tensor([[[1.0, 0, 0], [math.cos(0.04), math.sin(0.04), 0]]])
    values = torch.tensor([[[[1.0, 0, 0, 0], [0, 1.0, 0, 0]]]], dtype=torch.bfloat16)
    with torch.autocast("cpu", torch.bfloat16):
        share = angular_attention(queries, queries, values, close, torch.tensor([1000.0]))
    expected_share = 1 / (1 + math.exp(1000 * (math.cos(0.04) - 1)))
    assert float(share[0, 0, 0, 0]) == pytest.approx(expected_share, abs=1e-4)
