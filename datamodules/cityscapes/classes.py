"""Classes of Cityscapes, which data sets of streets share."""

from __future__ import annotations

from datamodules.core.label_map import LabelMap

CLASSES: tuple[str, ...] = (
    *("road", "sidewalk", "building", "wall", "fence", "pole", "traffic light"),
    *("traffic sign", "vegetation", "terrain", "sky", "person", "rider", "car"),
    *("truck", "bus", "train", "motorcycle", "bicycle"),
)
"""The 19 classes in the order of `trainId`; the label of a class is its index plus one."""

THIRTEEN: tuple[str, ...] = (*CLASSES[:12], "car")
"""The classes of the adaptation benchmarks CS13, SP13 and DP13."""

_GROUPS = {
    "rider": "person",
    **dict.fromkeys(("truck", "bus", "motorcycle", "bicycle"), "car"),
}


def class_maps(label_map: LabelMap) -> dict[str, LabelMap]:
    """Return the label maps of the setting `classes`: all 19 classes, or the 13.

    Trains are unknown in the 13 classes.

    Args:
        label_map: Label map of the 19 classes.
    """
    return {"19": label_map, "13": label_map.regrouped(LabelMap.grouped(THIRTEEN, _GROUPS))}
