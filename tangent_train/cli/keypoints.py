"""``tangent-keypoints``: match and score keypoints of pairs of panoramas."""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

from rich.progress import track

from datamodules.core.panorama_pairs import ImagePairs, PanoramaPair, PanoramaPairs
from tangent_train.config.build import build_from_config
from tangent_train.config.settings import KeypointSettings
from tangent_train.console import print_text
from tangent_train.errors import DataError, SettingError, width_height
from tangent_train.files import check_fields, read_json, write_bytes
from tangent_train.io.pixel_files import read_image_size
from tangent_train.keypoints.colmap import add_pair
from tangent_train.keypoints.compare import AS_GIVEN, Comparer, Comparison, Row
from tangent_train.keypoints.report import KeypointReport, matches_png
from tangent_train.keypoints.two_view import colmap

_IMAGE_SETTINGS = ("left", "right", "input", "pairing")


def keypoints(settings: KeypointSettings) -> None:
    """Compare keypoints of panoramas and of tangent images on pairs, and write the scores.

    Args:
        settings: Settings of the command.

    Raises:
        SettingError: A setting is missing or invalid.
        DataError: No pairs are found.
    """
    of_comparer = {field.name: getattr(settings, field.name) for field in fields(Comparer)}
    output, comparer = settings.output, Comparer(**of_comparer)
    colmap()  # refuses a missing pycolmap before minutes of work
    data, pairs = _pairs(settings)
    names = {"export", *of_comparer}
    content = settings.model_dump(mode="json", include=names) | {"data": data}
    done = earlier_results(output, content)
    pairs.make_files()
    pair_names = pairs.names[: settings.max_pairs]

    def report() -> KeypointReport:
        rows = [row for name in pairs.names for row in done.get(name, ())]
        return KeypointReport(rows, comparer.representations, content, pairs.published)

    missing = [(k, name) for k, name in enumerate(pair_names) if name not in done]
    count = len(pair_names)
    print_text(f"{count - len(missing)} of {count} pairs are done already")
    for index, name in track(missing, "Comparing pairs", disable=not missing):
        try:
            pair = pairs.read(index)
            comparison = comparer.compare(pair)
            if settings.export:
                _export(output / "export", pairs.files, pair, comparison)
        except (DataError, MemoryError) as error:  # a SettingError would concern all pairs
            print_text(f"Pair {name}: {error or 'not enough memory'}")
            continue
        if index < settings.pictures:
            for condition in comparison.images:
                file = f"{index:03}_{file_name(name)}_{condition}.png"
                write_bytes(output / "matches" / file, matches_png(comparison, condition))
        done[name] = comparison.rows
        report().write(output)
    for table in report().means():
        table.print()
    print_text(f"Results are in {output}." if done else "There are no results.")
    if settings.export:
        print_text(f"For COLMAP: {output / 'export'}, image_path {_root(pairs.files)}")
    if failed := len(set(pair_names) - set(done)):
        sys.exit(f"tangent-keypoints: {failed} of {count} pairs could not be used, see above")


def _pairs(settings: KeypointSettings) -> tuple[Any, PanoramaPairs]:
    """Return the settings of the pairs, and the pairs, from images or from a data set."""
    images = {name: getattr(settings, name) for name in _IMAGE_SETTINGS}
    if any(images[name] is not None for name in ("left", "right", "input")):
        return settings.model_dump(mode="json", include=set(_IMAGE_SETTINGS)), ImagePairs(**images)
    pairs = build_from_config(settings.data, "data")
    if not isinstance(pairs, PanoramaPairs):
        expected = "a data set of pairs: synthrooms_pairs, stanford2d3ds_pairs or zind_pairs"
        raise SettingError("data", found=type(pairs).__name__, expected=expected)
    return settings.data, pairs


def earlier_results(output: Path, settings: Mapping[str, Any]) -> dict[str, list[Row]]:
    """Return the scores of the finished pairs in a folder, by name.

    Args:
        output: Output folder.
        settings: Settings that the scores depend on.

    Raises:
        DataError: ``results.json`` was not written by this command.
        SettingError: The scores are of other settings, or the folder has only other files.
    """
    path, expected = output / "results.json", "results of tangent-keypoints"
    if not path.exists():
        if output.exists() and any(output.iterdir()):
            found = f"{output} with other files"
            raise SettingError("output", found=found, expected="a new or empty folder")
        return {}
    kinds = {"settings": dict, "rows": list[dict]}  # type: ignore[type-arg]
    content = check_fields(path, read_json(path, expected), kinds, expected)
    done: dict[str, list[Row]] = {}
    for row in content["rows"]:
        done.setdefault(str(row.get("pair")), []).append(row)
    before = content["settings"]
    for name, value in settings.items():
        if before.get(name) != value:
            raise SettingError(
                name,
                found=value,
                expected=f"{before.get(name)}, with which the results in {output} were made",
                remedy="Choose another output, or remove that folder.",
            )
    return done


def _export(
    folder: Path, files: Sequence[Path], pair: PanoramaPair, comparison: Comparison
) -> None:
    """Add the unrotated pair to the database of every representation.

    Raises:
        DataError: A file shows only a part of the sphere.
    """
    images = []
    for file in (pair.left.file, pair.right.file):
        shape = read_image_size(file)
        if abs(shape[1] - 2 * shape[0]) > 1:
            found = f"{width_height(shape)}, a part of a panorama"
            raise DataError(file, found=found, expected="a whole panorama for COLMAP")
        images.append((file.absolute().relative_to(_root(files)).as_posix(), shape))
    for name, matched in comparison.matched[AS_GIVEN].items():
        path = folder / file_name(name) / "database.db"
        keypoints = (matched.left, matched.right)
        add_pair(path, images, keypoints, matched.matches, matched.geometry)


def _root(files: Sequence[Path]) -> Path:
    """Return the innermost folder that contains all images."""
    return Path(os.path.commonpath([file.absolute().parent for file in files]))


def file_name(name: str) -> str:
    """Replace characters of a name that do not belong in a file name; at most 80 are kept.

    >>> file_name("hall/a – hall/b")
    'hall_a_hall_b'
    """
    return re.sub(r"[^\w.-]+", "_", name).strip("_.")[:80] or "pair"
