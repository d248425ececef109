from __future__ import annotations

import math
from typing import Any

import pytest
import torch

from tangent_train.errors import SettingError
from tangent_train.tasks.schedules import WarmupCosineLR


def _optimizer(*rates: float) -> torch.optim.Optimizer:
    groups: Any = [{"params": [torch.nn.Parameter(torch.zeros(1))], "lr": rate} for rate in rates]
    return torch.optim.AdamW(groups, betas=(0.7, 0.99))


def _rates(scheduler: Any, optimizer: torch.optim.Optimizer, steps: int) -> list[float]:
    rates = []
    for _ in range(steps):
        rates.append(optimizer.param_groups[0]["lr"])
        assert optimizer.param_groups[0]["betas"] == (0.7, 0.99)
        optimizer.step()
        scheduler.step()
    return rates


def test_the_rate_rises_in_a_line_and_falls_along_a_cosine() -> None:
    optimizer = _optimizer(2.0, 0.5)
    rates = _rates(WarmupCosineLR(optimizer, 100, warmup=0.1), optimizer, 100)
    assert rates[:10] == pytest.approx([2 * (k + 1) / 11 for k in range(10)])
    falling = [1 + math.cos(math.pi * k / 90) for k in range(90)]
    assert rates[10:] == pytest.approx(falling)
    assert [group["lr"] for group in optimizer.param_groups] == [0, 0], "after the last step"


@pytest.mark.parametrize("steps", [1, 2, 3, 10, 20])
@pytest.mark.parametrize("warmup", [0, 0.05, 0.1, 0.5, 0.99])
def test_any_number_of_steps_has_one_with_the_full_rate(steps: int, warmup: float) -> None:
    optimizer = _optimizer(3.0)
    rates = _rates(WarmupCosineLR(optimizer, steps, warmup), optimizer, steps)
    assert max(rates) == 3
    assert min(rates) > 0
    top = rates.index(3)
    assert rates[:top] == sorted(rates[:top])
    assert rates[top:] == sorted(rates[top:], reverse=True)


def test_a_resumed_schedule_goes_on_and_knows_its_length() -> None:
    optimizer = _optimizer(1.0)
    expected = _rates(WarmupCosineLR(optimizer, 20, 0.2), optimizer, 20)
    before = _optimizer(1.0)
    scheduler = WarmupCosineLR(before, 20, 0.2)
    _rates(scheduler, before, 7)
    after = _optimizer(1.0)
    resumed = WarmupCosineLR(after, 999, 0.2)
    after.load_state_dict(before.state_dict())
    resumed.load_state_dict(scheduler.state_dict())
    assert resumed.total_steps == 20
    assert _rates(resumed, after, 13) == expected[7:]


@pytest.mark.parametrize("warmup", [-0.1, 1, 1.5, float("nan")])
def test_impossible_shares_are_refused(warmup: float) -> None:
    with pytest.raises(SettingError, match=r"scheduler\.warmup: found"):
        WarmupCosineLR(_optimizer(1.0), 10, warmup)
