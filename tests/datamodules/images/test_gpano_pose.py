from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
from PIL import Image

from datamodules.images.gpano_pose import up_of
from tangent_train.errors import DataError
from tangent_train.rendering.upright.gravity import up_from_pose

if TYPE_CHECKING:
    from pathlib import Path


def _save(path: Path, tags: dict[str, str]) -> Path:
    listed = " ".join(f'GPano:{name}="{value}"' for name, value in tags.items())
    xmp = (
        '<x:xmpmeta xmlns:x="adobe:ns:meta/">'
        '<rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#"><rdf:Description '
        f'xmlns:GPano="http://ns.google.com/photos/1.0/panorama/" {listed}/></rdf:RDF></x:xmpmeta>'
    )
    Image.new("RGB", (8, 4)).save(path, xmp=xmp.encode())
    return path


@pytest.mark.parametrize("suffix", [".jpg", ".webp"])
@pytest.mark.parametrize(
    ("tags", "pitch_deg", "roll_deg"),
    [
        ({"PosePitchDegrees": "17.0", "PoseRollDegrees": "-121.0"}, 17, -121),
        ({"PosePitchDegrees": "-24.49", "PoseRollDegrees": "8.96"}, -24.49, 8.96),
        ({"PosePitchDegrees": "5"}, 5, 0),
        ({"PoseRollDegrees": "180", "PoseHeadingDegrees": "77"}, 0, 180),
        ({"PosePitchDegrees": "-90", "PoseRollDegrees": "0.0"}, -90, 0),
    ],
)
def test_tags(
    tmp_path: Path, suffix: str, tags: dict[str, str], pitch_deg: float, roll_deg: float
) -> None:
    up = up_of(_save(tmp_path / f"image{suffix}", tags))
    assert up is not None
    np.testing.assert_array_equal(up, up_from_pose(pitch_deg, roll_deg))


@pytest.mark.parametrize(
    "tags",
    [
        {},
        {"PoseHeadingDegrees": "225.0"},
        {"PosePitchDegrees": "0.0", "PoseRollDegrees": "-0"},
    ],
)
def test_images_that_do_not_say(tmp_path: Path, tags: dict[str, str]) -> None:
    assert up_of(_save(tmp_path / "image.jpg", tags)) is None


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("PosePitchDegrees", "91"),
        ("PosePitchDegrees", "steep"),
        ("PoseRollDegrees", "nan"),
        ("PoseRollDegrees", "-inf"),
        ("PoseRollDegrees", "180.5"),
        ("PoseRollDegrees", ""),
    ],
)
def test_tags_that_cannot_be_are_refused(tmp_path: Path, name: str, value: str) -> None:
    path = _save(tmp_path / "image.jpg", {name: value})
    with pytest.raises(DataError, match=rf"image\.jpg: found GPano:{name} .*expected degrees from"):
        up_of(path)
