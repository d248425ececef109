from __future__ import annotations

import numpy as np
import pytest
import torch

from datamodules.core.class_weights import class_weights

COUNTS = np.array([4_000_000, 1_000_000, 900_000, 50_000, 0, 300])


def test_effective_weights_are_those_of_cui_for_the_mean_count() -> None:
    seen = COUNTS > 0
    counts = COUNTS[seen].astype(np.float64)
    beta = 1 - 1 / counts.mean()
    expected = (1 - beta) / (1 - beta**counts)
    weights = class_weights(COUNTS, "effective")
    found = weights[torch.from_numpy(seen)].numpy()
    np.testing.assert_allclose(found, expected / expected.mean(), rtol=1e-5)
    assert weights[4] == 0
    assert weights.dtype == torch.float32


@pytest.mark.parametrize("kind", ["log", "sqrt", "effective", "none"])
def test_only_the_shares_count(kind: str) -> None:
    once = class_weights(COUNTS, kind)  # type: ignore[arg-type]
    torch.testing.assert_close(once, class_weights(COUNTS * 1000, kind))  # type: ignore[arg-type]


@pytest.mark.parametrize("kind", ["log", "sqrt", "effective"])
def test_extreme_counts_give_finite_weights(kind: str) -> None:
    for counts in ([0, 0], [7, 0], [1, 1], [1, 10**13]):
        weights = class_weights(np.array(counts), kind)  # type: ignore[arg-type]
        assert torch.isfinite(weights).all()
        assert (weights > 0).tolist() == [count > 0 for count in counts]
