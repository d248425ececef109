"""How a camera was held, by what it has written into its panorama.

The tags are `PosePitchDegrees` and `PoseRollDegrees` of Google's Photo Sphere format; see
`tangent_train.rendering.upright.gravity.up_from_pose` for their meaning.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from datamodules.images.gpano import NAMESPACE
from datamodules.images.xmp import read_xmp_tags
from tangent_train.errors import DataError
from tangent_train.rendering.upright.gravity import up_from_pose

if TYPE_CHECKING:
    from pathlib import Path

    import numpy as np
    from numpy.typing import NDArray

__all__ = ["up_of"]

_MOST_DEG = {"PosePitchDegrees": 90.0, "PoseRollDegrees": 180.0}


def up_of(path: Path) -> NDArray[np.float64] | None:
    """The direction of up in a panorama by its own GPano tags.

    Args:
        path: JPEG, PNG, TIFF or WebP.

    Returns:
        ``(3,)`` unit vector in the panorama's frame. None where the image does not say, or says 0
        for both: so do programs that do not know.

    Raises:
        DataError: The file cannot be read, or a tag is no such angle.
    """
    tags = read_xmp_tags(path, NAMESPACE)
    pitch, roll = (_angle_deg(path, name, tags.get(name, "0")) for name in _MOST_DEG)
    return None if pitch == roll == 0 else up_from_pose(pitch, roll)


def _angle_deg(path: Path, name: str, text: str) -> float:
    most = _MOST_DEG[name]
    try:
        angle = float(text)
    except ValueError:
        angle = float("nan")
    if not abs(angle) <= most:
        raise DataError(
            path,
            found=f"GPano:{name} {text!r}",
            expected=f"degrees from −{most:.0f} to {most:.0f}",
            remedy=f"Remove the tag, for example with exiftool -XMP-GPano:{name}= <file>.",
        )
    return angle
