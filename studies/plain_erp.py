"""Label equirectangular images with onnxruntime alone; nothing of this project is imported.

python studies/plain_erp.py <network>.onnx classes.json label_map.json panoramas maps

The network takes RGB from 0 to 1, ``(n, 3, 512, 512)``, and returns scores before a softmax. The
panorama is reduced to 1024 × 512 and divided into a left and a right half, as a program for photos
does that knows nothing of the sphere. Labels are 1 to K in the order of the label map, at the size
of the panorama (docs/results/real_panoramas.md).
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import onnxruntime


def label(session: Any, groups: list[list[int]], file: Path) -> Any:
    """Return the labels of one panorama: of each class, the probabilities are added."""
    image: Any = cv2.imread(str(file))
    small = cv2.resize(image, (1024, 512), interpolation=cv2.INTER_AREA)[..., ::-1] / 255.0
    halves = np.stack([small[:, :512], small[:, 512:]]).transpose(0, 3, 1, 2)
    (scores,) = session.run(None, {session.get_inputs()[0].name: halves.astype(np.float32)})
    odds = np.exp(scores - scores.max(axis=1, keepdims=True))
    of_groups = [np.hstack(odds[:, group].sum(axis=1) / odds.sum(axis=1)) for group in groups]
    size = image.shape[1], image.shape[0]
    wide = [cv2.resize(one, size, interpolation=cv2.INTER_LINEAR) for one in of_groups]
    return (np.argmax(wide, axis=0) + 1).astype(np.uint8)


def main(network: str, classes: str, label_map: str, panoramas: str, maps: str) -> None:
    """Label all panoramas of a folder."""
    names = json.loads(Path(classes).read_text())
    members = json.loads(Path(label_map).read_text())["classes"].values()
    groups = [[names.index(name) for name in one if name in names] for one in members]
    session = onnxruntime.InferenceSession(network)
    Path(maps).mkdir(parents=True, exist_ok=True)
    for file in sorted(Path(panoramas).glob("*.jpg")):
        cv2.imwrite(str(Path(maps) / f"{file.stem}.png"), label(session, groups, file))


if __name__ == "__main__":
    main(*sys.argv[1:])
