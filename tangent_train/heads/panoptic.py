"""Head for classes of which some are single objects: chairs, not walls."""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import find_objects
from torch import Tensor

from datamodules.core.label_map import PANOPTIC
from models.segments import Segments
from tangent_train.files import csv_text, write_text
from tangent_train.heads import pictures
from tangent_train.heads.base import PICTURES, RGB, PredictedImage, Scores
from tangent_train.heads.classes import ClassesHead, LabelMosaic
from tangent_train.heads.objects import OBJECT_COLUMNS, Objects, described, join_objects
from tangent_train.io.pixel_files import read_rgb, write_pixels
from tangent_train.metrics.image_sums import Sums, means_of_sums
from tangent_train.metrics.panoptic import LABEL, quality
from tangent_train.metrics.scores import ScoreColumn, by_solid_angle, with_solid_angle
from tangent_train.rendering.representations.views import Views


class PanopticHead(ClassesHead):
    """Classes for every pixel, and objects of some of them, see `heads.objects`.

    Predicted pixels are panoptic maps, see `metrics.panoptic`. The labels of objects replace those
    of the blended scores. Elsewhere, a class of `things` has no object: number 0.

    Args:
        class_names: Names of the K + 1 labels, the unknown class first.
        things: Names of the classes that have objects.
        **settings: See `ClassesHead`.
    """

    labels: ClassVar[str] = PANOPTIC
    columns: ClassVar[Mapping[str, ScoreColumn]] = with_solid_angle(
        {
            "pq": ScoreColumn("PQ", "%", "pq", "PQ"),
            "sq": ScoreColumn("SQ", "%", "sq", "SQ", is_main=False),
            "rq": ScoreColumn("RQ", "%", "rq", "RQ", is_main=False),
        }
    ) | {
        "pq_things": ScoreColumn("PQ of things"),
        "pq_stuff": ScoreColumn("PQ of stuff"),
        "pq_seam": ScoreColumn("PQ of objects across ±180°", is_main=False, of_sphere=True),
        "pq_poles": ScoreColumn("PQ of objects near the poles", is_main=False, of_sphere=True),
    }
    main_score: ClassVar[str] = "pq"
    waits: ClassVar[bool] = True  # objects are joined while the next image is predicted
    usual_kinds: ClassVar[Sequence[str]] = ("labels", *PICTURES)
    suffixes = MappingProxyType(
        dict.fromkeys(("panoptic", "labels", "objects"), ".png") | ClassesHead.suffixes
    )

    def __init__(
        self, class_names: Sequence[str], things: Collection[str], **settings: Any
    ) -> None:
        super().__init__(class_names, **settings)
        self.is_thing = np.isin(self.class_names, list(things))

    # Scores

    def build_metric(self) -> Any:
        """Build the metric, which keeps the sums of the segments of each panorama."""
        from tangent_train.metrics.collected import PanopticMetric  # seconds to import

        return PanopticMetric(len(self.class_names))

    def scores(self, result: Any) -> Scores:
        """Return PQ, SQ and RQ by pixels and by solid angle.

        Args:
            result: Sums ``(panoramas, 2, 3, K, 4)``, see `panoptic_sums`.
        """
        pixels, angles = map(quality, result[:, :, 0].sum(axis=0))
        return Scores(means_of_sums(self.image_sums(result)), pixels | by_solid_angle(angles))

    def image_sums(self, result: Any) -> Sums:
        """Return the sums of each panorama for classes with and without objects."""
        is_thing = self.is_thing[1:]
        return {"things": result[..., is_thing, :], "stuff": result[..., ~is_thing, :]}

    @property
    def facts(self) -> dict[str, str]:
        """The classes that have objects."""
        return {"things": ", ".join(np.array(self.class_names)[self.is_thing])}

    def comparable(self, prediction: Tensor, truth: Tensor, ray_lengths: Any = None) -> Tensor:
        """Return a panoptic map as it is written."""
        codes = self._known(prediction.cpu().numpy())
        return torch.from_numpy(codes).to(prediction.device)

    def _known(self, codes: NDArray[Any]) -> NDArray[Any]:
        """Return a panoptic map that is 0 where a thing has no object."""
        is_none = self.is_thing[codes // LABEL] & (codes % LABEL == 0)
        return np.where(is_none, 0, codes)

    def panel(self, rgb: RGB, truth: NDArray[Any], prediction: NDArray[Any]) -> RGB:
        """Draw classes in a grid, see `ClassesHead.panel`, with the borders of objects."""
        maps, names = (truth, prediction), self.class_names
        return pictures.prediction_panel(rgb, truth // LABEL, prediction // LABEL, names, maps)

    def error(self, prediction: Tensor, truth: Tensor) -> tuple[float, str]:
        """Return 1 − PQ of one panorama, and the PQ; 0 and "" without known pixels."""
        if not truth.any():
            return 0.0, ""
        metric = self.build_metric()
        metric.update(prediction.cpu(), truth.cpu())
        pq = self.scores(metric.compute()).means["pq"]
        return 1 - pq, f"PQ {100 * pq:.1f}\u00a0%"

    # Pictures and files

    def _new_mosaic(self, *given: Any, **settings: Any) -> PanopticMosaic:
        return PanopticMosaic(self, *given, **settings)

    def write(self, files: Mapping[str, Path], predicted: PredictedImage) -> None:
        """Write a panoptic map in COCO's colors, labels, 16-bit numbers of objects and pictures."""
        if file := files.get("labels"):
            write_pixels(file, self.labels_in(predicted.pixels))
        if file := files.get("objects"):
            write_pixels(file, (predicted.pixels % LABEL).astype(np.uint16))
        super().write(files, predicted)

    def write_source(self, file: Path, pixels: NDArray[Any]) -> None:
        """Write a panoptic map as RGB: ``R + 256 G + 65536 B``; 0 where a thing has no object."""
        codes = self._known(pixels).astype("<u4")
        write_pixels(file, codes[..., None].view(np.uint8)[..., :3])

    def read(self, file: Path) -> NDArray[np.int32]:
        """Read a panoptic map."""
        colors: Any = read_rgb(file, as_stored=True)
        codes: NDArray[np.int32] = colors @ np.array([1, 256, LABEL], np.int32)
        return codes

    def labels_in(self, pixels: NDArray[Any]) -> NDArray[Any]:
        """Return the labels of a panoptic map."""
        return (pixels // LABEL).astype(np.uint8)

    def report_maps(self, predicted: PredictedImage) -> dict[str, Any]:
        """Return labels, numbers of objects, and rows of the table, which evaluations lack."""
        labels, numbers = np.divmod(predicted.pixels, LABEL)
        rows = {
            segment["number"]: {name: segment[name] for name in OBJECT_COLUMNS}
            for segment in predicted.facts.get("segments", ())
            if "number" in segment
        }
        return {"prediction": labels, "numbers": numbers, "objects": rows}

    def entry(self, predicted: PredictedImage, is_counted: NDArray[np.bool_]) -> dict[str, Any]:
        """Return the shares of the classes, and COCO's ``segments_info`` with the table of objects.

        Segments that are masked are left out.
        """
        table = described(predicted.facts["objects"], self.class_names[1:], predicted.image)
        codes, of_number = predicted.pixels, {row["number"]: row for row in table}
        ids, index, counts = np.unique(codes, return_inverse=True, return_counts=True)
        boxes = find_objects(index.reshape(codes.shape) + 1)
        segments = []
        for code, count, (rows, columns) in zip(ids.tolist(), counts.tolist(), boxes, strict=True):
            label, number = divmod(code, LABEL)
            if number or (label and not self.is_thing[label]):
                size = columns.stop - columns.start, rows.stop - rows.start
                box = [columns.start, rows.start, *size]
                segment = {"id": code, "category_id": label, "area": count, "bbox": box}
                segments.append(segment | {"iscrowd": 0} | of_number.get(number, {}))
        of_classes = predicted._replace(pixels=self.labels_in(codes))
        return super().entry(of_classes, is_counted) | {"segments": segments}

    def write_tables(self, folder: Path, entries: Sequence[Mapping[str, Any]]) -> None:
        """Write ``panoptic.json`` in COCO's format, and ``objects.csv``."""
        done = [entry for entry in entries if "segments" in entry]
        content = {
            "images": [
                {"id": k, "file_name": e["file"], "width": e["columns"], "height": e["rows"]}
                for k, e in enumerate(done)
            ],
            "annotations": [
                {"image_id": k, "file_name": f"{e['name']}.png", "segments_info": e["segments"]}
                for k, e in enumerate(done)
            ],
            "categories": [
                {"id": label, "name": name, "isthing": int(self.is_thing[label])}
                for label, name in enumerate(self.class_names)
                if label
            ],
        }
        write_text(folder / "panoptic.json", json.dumps(content) + "\n")
        objects = [{"image": e["name"], **s} for e in done for s in e["segments"] if "number" in s]
        names = ["image", *OBJECT_COLUMNS]
        write_text(folder / "objects.csv", csv_text(names, objects))


class PanopticMosaic(LabelMosaic):
    """Probabilities of classes and objects of views, from which `pixels` are a panoptic map.

    Attributes:
        facts: ``objects`` are the `Objects`, after `pixels`.
    """

    def __init__(
        self, head: PanopticHead, *given: Any, camera_matrix: Any = None, **named: Any
    ) -> None:
        super().__init__(head, *given, **named)
        self._camera_matrix, self._is_thing = camera_matrix, head.is_thing[1:]
        self._sets: list[tuple[Views, Sequence[Segments]]] = []
        self._objects: Objects | None = None

    @property
    def facts(self) -> dict[str, Any]:
        """Objects, and the share of pixels without a class."""
        return {**super().facts, "objects": self._objects}

    def add_segments(self, segments: Sequence[Segments], views: Views) -> None:
        """Add the objects of some views."""
        self._sets.append((views, segments))

    def pixels(self) -> Tensor:
        """Return a panoptic map ``(H, W)``, int32."""
        labels = super().pixels().int()
        given = self._camera_matrix, self.valid, self._is_thing
        found = join_objects(self._sets, self.shape, *given)
        self._objects = found
        numbers = torch.from_numpy(found.numbers).to(labels.device)
        of_objects = torch.from_numpy(np.append(0, found.classes + 1)).to(labels)
        return torch.where(numbers > 0, of_objects[numbers], labels) * LABEL + numbers
