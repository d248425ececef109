"""Every attack at many places of a checkpoint."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from tests.security.checkpoints import attack_checkpoints


@pytest.mark.timeout(1800)
def test_no_attack_at_any_place_of_a_checkpoint_is_interpreted(
    content: dict[str, Any], forbidden: Path
) -> None:
    attack_checkpoints(content, forbidden, each=10)
