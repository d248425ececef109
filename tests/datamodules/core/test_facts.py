"""The facts of a data set on which scores depend."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from datamodules.stanford2d3ds.panoramas import Stanford2D3DS
from tests.conftest import fabricate


def test_facts_are_the_settings_as_they_are(stanford_root: Path, erp: Any, tmp_path: Path) -> None:
    facts = Stanford2D3DS(stanford_root, erp).facts
    assert facts == {
        "data": "Stanford2D3DS",
        "classes": "13",
        "unknown": "labels",
        "size": "32 × 16",
        "area": "none",
        "mask": "none",
        "test_rotation": "none",
        "areas": "1, 2, 3, 4, 5a, 5b, 6",
    }
    cv2.imwrite(str(tmp_path / "None.png"), np.full((16, 32), 255))
    for changes, changed in (
        ({"mask": -60.0}, {"mask": "-60"}),
        ({"mask": tmp_path / "None.png"}, {"mask": "None.png"}),
        ({"test_rotation": 45.0, "upright": "pose", "fold": 2}, {"test_rotation": "45"}),
        ({"classes": 8, "unknown": "all_black"}, {"classes": "8", "unknown": "all_black"}),
        ({"areas": ["1", "5a"]}, {"areas": "1, 5a"}),
    ):
        assert Stanford2D3DS(stanford_root, erp, **changes).facts == facts | changed


@dataclass(kw_only=True, eq=False, repr=False)
class Other(Stanford2D3DS):
    """A data set of another package, which only has the name in common with one of ours."""

    fact_settings = ("renamed",)
    renamed: str | None = None


Other.__name__ = "Stanford2D3DS"


def test_a_class_of_another_package_has_its_module_and_its_settings(
    stanford_root: Path, erp: Any
) -> None:
    facts = Other(stanford_root, erp, renamed="yes").facts
    assert facts["data"] == f"{__name__}.Stanford2D3DS"
    assert (facts["renamed"], facts["unknown"]) == ("yes", "labels")


@pytest.mark.parametrize(("area", "images"), [("5a", {"images": "4 of 5"}), ("1", {})])
def test_broken_test_panoramas_that_are_left_out_are_a_fact(
    area: str, images: dict[str, str], tmp_path: Path, erp: Any
) -> None:
    root = fabricate(tmp_path)
    next((root / f"area_{area}/pano/rgb").iterdir()).write_bytes(b"broken")
    data = Stanford2D3DS(root, erp, skip_broken=True)
    facts = data.facts
    data.prepare_data()
    assert data.facts == facts | images
