"""Classes of Cityscapes, which data sets of streets share."""

from __future__ import annotations

from datamodules.core.labels import ClassSet, class_sets

CLASSES: tuple[str, ...] = (
    *("road", "sidewalk", "building", "wall", "fence", "pole", "traffic light"),
    *("traffic sign", "vegetation", "terrain", "sky", "person", "rider", "car"),
    *("truck", "bus", "train", "motorcycle", "bicycle"),
)
"""The 19 classes in the order of `trainId`; the label of a class is its index plus one."""

THIRTEEN: tuple[str, ...] = (*CLASSES[:12], "car")
"""The classes of the adaptation benchmarks CS13, SP13 and DP13."""

CLASS_SETS = class_sets(
    CLASSES,
    {
        "13": ClassSet(
            THIRTEEN,
            CLASSES,
            {"rider": "person", **dict.fromkeys(("truck", "bus", "motorcycle", "bicycle"), "car")},
        )
    },
)
"""Values of the setting `classes`. Trains are unknown in the 13 classes."""
