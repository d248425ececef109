"""Depth networks of all families of transformers, from a saved folder to files of predictions."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from models.huggingface import DEPTH, network_types
from tangent_train.inference.photo_networks import depth_kinds
from tests.inference.photo_networks import depth_networks as depth
from tests.inference.photo_networks.test_depth import check_family


@pytest.mark.parametrize("family", depth.FAMILIES, ids=lambda family: family[0].__name__)
def test_depth_is_that_of_the_library(family: Any, tmp_path: Path) -> None:
    check_family(tmp_path, *family)


def test_all_families_are_tried_or_refused(tmp_path: Path) -> None:
    tried = {make()[0].config.model_type for make, *_ in depth.FAMILIES}
    assert tried | set(depth_kinds._REFUSED) == network_types(DEPTH)
