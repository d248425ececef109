"""``tangent-keypoints``: match and score keypoints of pairs of panoramas."""

from __future__ import annotations

import re
import sys
from dataclasses import fields
from typing import Any

from rich.progress import track

from datamodules.core.panorama_pairs import ImagePairs, PanoramaPairs
from tangent_train.cli import main
from tangent_train.config.build import build_from_config
from tangent_train.config.settings import KeypointSettings
from tangent_train.console import print_text
from tangent_train.errors import DataError, SettingError
from tangent_train.files import write_bytes
from tangent_train.keypoints.compare import Comparer
from tangent_train.keypoints.report import matches_png, write_report
from tangent_train.keypoints.two_view import colmap
from tangent_train.manifest import Manifest


def keypoints(settings: KeypointSettings) -> None:
    """Compare keypoints of panoramas and of tangent images on pairs, and write the scores.

    Raises:
        SettingError: A setting is invalid, or the output was written with other settings.
        DataError: No pairs are found.
    """
    colmap()  # refuses a missing pycolmap before minutes of work
    of_comparer = {field.name: getattr(settings, field.name) for field in fields(Comparer)}
    comparer, output = Comparer(**of_comparer), settings.output
    data, pairs = _pairs(settings)
    content = {**of_comparer, "data": data}
    manifest = Manifest.open(output, content)
    pairs.make_files()
    names, finished = pairs.names[: settings.max_pairs], manifest.finished
    missing = manifest.missing(names)
    print_text(f"{len(names) - len(missing)} of {len(names)} pairs are done already")
    for name in track(missing, "Comparing pairs", disable=not missing):
        index = names.index(name)
        try:
            comparison = comparer.compare(pairs.read(index))
        except (DataError, MemoryError) as error:  # a SettingError would concern all pairs
            print_text(f"Pair {name}: {error or 'not enough memory'}")
            continue
        for condition in comparison.images if index < settings.pictures else ():
            file = output / "matches" / f"{index:03}_{file_name(name)}_{condition}.png"
            write_bytes(file, matches_png(comparison, condition))
        manifest.finish(name, rows=comparison.rows)
    rows = [row for name in pairs.names for row in finished.get(name, {}).get("rows", ())]
    if rows:
        for table in write_report(output, rows, content, pairs.published):
            table.print()
    print_text(f"Results are in {output}." if rows else "There are no results.")
    if failed := manifest.missing(names):
        sys.exit(f"tangent-keypoints: {len(failed)} of {len(names)} pairs failed, see above")


def _pairs(settings: KeypointSettings) -> tuple[Any, PanoramaPairs]:
    """Return the settings of the pairs, and the pairs, from images or from a data set."""
    given = (settings.left, settings.right, settings.input)
    if any(path is not None for path in given):
        left, right, images = (None if path is None else str(path) for path in given)
        section = {"left": left, "right": right, "input": images, "pairing": settings.pairing}
        return section, ImagePairs(**section)  # type: ignore[arg-type]
    pairs = build_from_config(settings.data or {}, "data")
    if not isinstance(pairs, PanoramaPairs):
        raise SettingError(
            "data",
            found=type(pairs).__name__,
            expected="a data set of pairs: synthrooms_pairs, stanford2d3ds_pairs or zind_pairs",
        )
    return settings.data, pairs


def file_name(name: str) -> str:
    """Replace characters of a name that do not belong in a file name; at most 80 are kept.

    >>> file_name("hall/a – hall/b")
    'hall_a_hall_b'
    """
    return re.sub(r"[^\w.-]+", "_", name).strip("_.")[:80] or "pair"


if __name__ == "__main__":
    main.keypoints()
