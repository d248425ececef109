"""Colors of classes and of distances."""

from __future__ import annotations

import re
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

UNKNOWN_COLOR = np.full(3, 136, np.uint8)
"""Gray of unknown pixels: no label, no distance, or no picture."""

_LIGHTNESS = (30, 92)  # L* of generated colors
_SHADES = 0.9  # cosine of the largest angle between the hues of classes of one meaning
_MEANINGS = {
    "eec": "wall partition",
    "b75": "floor flooring rug carpet mat",
    "7af": "ceiling",
    "5ff": "window windowpane glass",
    "d90": "door doorway",
    "937": "chair armchair seat stool bench ottoman",
    "ec0": "table desk counter countertop",
    "65f": "sofa couch cushion pillow",
    "3c8": "bed cradle",
    "353": "cabinet bookcase bookshelf shelf shelves shelving wardrobe drawers dresser furniture",
    "02e": "board whiteboard blackboard picture painting poster mirror screen television monitor",
    "fc5": "lamp light streetlight chandelier sconce",
    "fac": "curtain blind",
    "ce9": "column pillar beam",
    "e74": "stairs stairway staircase step escalator",
    "09c": "sink toilet bathtub shower",
    "c9c": "clutter object box bag prop basket",
    "9cf": "sky",
    "280": "vegetation tree plant grass flower palm",
    "db6": "terrain earth ground field sand dirt hill mountain rock",
    "47e": "water sea river lake pool waterfall fountain",
    "639": "road street runway lane marking line path",
    "e5c": "sidewalk pavement",
    "730": "building house skyscraper tower hut bridge",
    "e10": "person pedestrian rider human",
    "31b": "car vehicle truck bus van train boat ship airplane",
    "b04": "bicycle motorcycle minibike",
    "f98": "fence railing rail track banister",
    "079": "pole",
    "fe0": "sign signboard billboard",
}
"""Colors as #rgb, each with the words of one meaning.

Of the ten most frequent classes of a data set, no two are nearer than 15 in CIELAB, with full color
vision and without red or green cones.
"""

_COLORS = {
    word.rstrip("s"): (int(color, 16), rank)
    for color, line in _MEANINGS.items()
    for rank, word in enumerate(line.split())
}
"""Color of each word, and its rank among those of the same meaning."""

_SEEN = np.array(
    [
        [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
        # Without L and without M cones: Machado, Oliveira, Fernandes 2009, severity 1.
        [[0.1523, 1.0526, -0.2049], [0.1145, 0.7863, 0.0992], [-0.0039, -0.0481, 1.0520]],
        [[0.3673, 0.8606, -0.2280], [0.2801, 0.6725, 0.0474], [-0.0118, 0.0429, 0.9689]],
    ]
)
"""Linear RGB as seen with full color vision, and without red or green cones."""


@lru_cache
def class_colors(class_names: tuple[str, ...]) -> NDArray[np.uint8]:
    """Return distinct colors of classes by the meaning of their names, gray for the unknown class.

    A meaning has the same color in every data set. Further classes of the same meaning have colors
    of its hue, and names without a known word any color: the one that is farthest from all others,
    see `colors_as_seen`.

    Args:
        class_names: Names of the K + 1 labels, the unknown class first, to 256.

    Returns:
        ``(K+1, 3)`` RGB, not writable.
    """
    rgb = 17 * np.indices((16, 16, 16)).reshape(3, -1).T  # the place of a color is the number #rgb
    lab = colors_as_seen(rgb)
    light, hue = lab[:, 0, 0], np.arctan2(lab[:, 0, 2], lab[:, 0, 1])
    away = np.where((light >= _LIGHTNESS[0]) & (light <= _LIGHTNESS[1]), np.inf, 0.0)
    meanings = [(0x888, 0), *map(_meaning, class_names[1:])][: len(class_names)]
    by_rank = sorted(range(len(meanings)), key=lambda label: meanings[label][1])
    best = {meanings[label][0]: label for label in reversed(by_rank)}
    is_best = [k >= 0 and best[k] == label for label, (k, _) in enumerate(meanings)]
    chosen = {}
    for label in sorted(range(len(meanings)), key=lambda label: not is_best[label]):
        place = meanings[label][0]
        if not is_best[label]:
            is_alike = np.cos(hue - hue[place]) > _SHADES if place >= 0 else True
            place = int(np.where(is_alike, away, 0).argmax())
        distances = np.linalg.norm(lab - lab[place], axis=-1)
        away = np.minimum(away, distances[:, 0] + 3 * distances[:, 1:].min(axis=1))
        chosen[label] = place
    colors = rgb[[chosen[label] for label in sorted(chosen)]].astype(np.uint8)
    colors.setflags(write=False)
    return colors


def _meaning(name: str) -> tuple[int, int]:
    """Return the color of the last known word of a name, or -1, and a rank: 0 for the best name.

    Of several names, e.g. "sofa, couch", the first with a known word counts.
    """
    for synonym in re.split("[,;/]", name.lower()):
        words = [word.rstrip("s") for word in re.findall("[a-z]+", synonym)]
        if known := [_COLORS[word] for word in words if word in _COLORS]:
            return known[-1][0], known[-1][1] + len(words) - 1
    return -1, 0


def colors_as_seen(rgb: NDArray[np.integer]) -> NDArray[np.float32]:
    """Return RGB colors ``(n, 3)`` in CIELAB, ``(n, 3, 3)``.

    The second axis is full color vision, no red cones and no green cones.
    """
    srgb = rgb / 255
    linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    seen = np.clip(linear @ _SEEN.transpose(0, 2, 1), 0, 1).astype(np.float32)
    return np.stack([cv2.cvtColor(image[None], cv2.COLOR_LRGB2Lab)[0] for image in seen], axis=1)


@lru_cache
def distance_colors() -> NDArray[np.uint8]:
    """Return 256 RGB colors from the nearest to the farthest distance, not writable.

    They are viridis from its bright end: equal steps look equally large, and near is brighter than
    far without color vision too.
    """
    ramp = np.arange(255, -1, -1, dtype=np.uint8)[:, None]
    colors: NDArray[np.uint8] = np.asarray(cv2.applyColorMap(ramp, cv2.COLORMAP_VIRIDIS), np.uint8)
    colors = np.ascontiguousarray(colors[:, 0, ::-1])
    colors.setflags(write=False)
    return colors
