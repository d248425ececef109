"""``tangent-keypoints``: keypoints of pairs of panoramas, matched and scored."""

from __future__ import annotations

import sys
import time
from typing import TYPE_CHECKING, Any

from rich.console import Console

from datamodules.core.image_pairs import ImagePairs
from datamodules.core.panorama_pairs import PanoramaPairs
from datamodules.core.progress import progress_bar
from datamodules.stanford2d3ds.pairs import StanfordPairs, published_pairs
from tangent_train.cli.keypoint_pairs.export import ColmapExport
from tangent_train.cli.keypoint_pairs.folder import EXPORT, ResultsFolder
from tangent_train.cli.keypoint_pairs.outputs import PairOutputs
from tangent_train.cli.keypoint_pairs.settings import KeypointSettings
from tangent_train.cli.processes import ended_by_sigterm
from tangent_train.errors import DataError, SettingError
from tangent_train.keypoints.detectors import Detector
from tangent_train.keypoints.motion_search import colmap
from tangent_train.registry import make, maker_of
from tangent_train.results.keypoints.compare import Comparer, Matching
from tangent_train.results.keypoints.entries import PairEntry
from tangent_train.results.keypoints.representations import Representations
from tangent_train.results.keypoints.tables import KeypointReport, overall_tables, shown_name

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

__all__ = ["keypoints"]

_SECONDS_BETWEEN_WRITES = 5.0


def keypoints(config: Mapping[str, Any]) -> None:
    """Compare keypoints of panoramas and of tangent images on pairs, and write what was found.

    Args:
        config: The composed ``keypoints.yaml``.

    Raises:
        SettingError: A setting is missing or cannot work.
        DataError: There are no pairs.
    """
    settings = KeypointSettings.of(config)
    colmap()  # pycolmap is needed: it is missed now rather than after minutes
    with ended_by_sigterm():  # after it: pycolmap has a handler that prints its stack
        _compare_and_tell(_pairs(config), settings)


def _compare_and_tell(pairs: PanoramaPairs, settings: KeypointSettings) -> None:
    comparer = _comparer(settings)
    folder = ResultsFolder(settings.output, settings.deciding)
    outputs = _outputs(settings, comparer, folder)
    if outputs.export is not None and isinstance(pairs, ImagePairs):
        count = min(len(pairs), settings.max_pairs or len(pairs))
        outputs.export.check_files([file for k in range(count) for file in pairs.files(k)])
    earlier = folder.open(overwrite=settings.overwrite)
    pairs.make_files()
    names = [pairs.name(k) for k in range(len(pairs))][: settings.max_pairs]
    missing = outputs.missing(names, earlier)
    console = Console(soft_wrap=True, highlight=False)
    console.print(_what_happens(settings, comparer, len(names), len(missing)), markup=False)
    entries = dict(earlier)
    try:
        _compare_all(pairs, missing, comparer, outputs, entries)
    except (KeyboardInterrupt, SystemExit):
        done = sum(name in entries for name in names)
        console.print(
            f"Interrupted: {done} of {len(names)} pairs are done. The same command goes on.",
            markup=False,
        )
        raise
    finally:
        ordered = [entries[n] for n in map(pairs.name, range(len(pairs))) if n in entries]
        _write(folder, ordered, pairs, comparer, settings)
    for table in overall_tables(_report(ordered, pairs, comparer, settings)):
        console.print(table)
    if any(entry.error is None for entry in ordered):
        console.print(f"Results are in {folder.path}.", markup=False)
    good = [name for name in names if entries[name].error is None]
    if outputs.export is not None and good and not outputs.export.is_complete(good):
        root = outputs.export.finish(good)
        console.print(f"For COLMAP: {outputs.export.folder}, image_path {root}", markup=False)
    if len(good) < len(names):
        failed = f"{len(names) - len(good)} of {len(names)} pairs"
        sys.exit(f"tangent-keypoints: {failed} could not be used, see above")


def _pairs(config: Mapping[str, Any]) -> PanoramaPairs:
    kind = maker_of(config["data"], "data")
    if not issubclass(kind, PanoramaPairs):
        raise SettingError(
            "data",
            found=config["data"]["_target_"],
            expected="pairs: data=synthrooms_pairs, stanford2d3ds_pairs or image_pairs",
        )
    given = [name for name in ("left", "right", "input") if config[name] is not None]
    if given and not issubclass(kind, ImagePairs):
        raise SettingError(
            given[0],
            found=config[given[0]],
            expected="none with other data than image_pairs",
            remedy="Leave it or data= out.",
        )
    pairs: PanoramaPairs = make(config["data"], "data")
    return pairs


def _comparer(settings: KeypointSettings) -> Comparer:
    return Comparer(
        Representations(
            settings.base_levels,
            Detector(settings.detector),
            settings.margin,
            shrunk=settings.controls,
        ),
        Matching(settings.ratio, settings.mutual, settings.max_error_deg, settings.seed),
        settings.level,
        turned=settings.controls,
    )


def _outputs(settings: KeypointSettings, comparer: Comparer, folder: ResultsFolder) -> PairOutputs:
    export = None
    if settings.export != "none":
        names = tuple(comparer.representations.names)
        export = ColmapExport(folder.path / EXPORT, settings.export, names)
    return PairOutputs(folder, settings.pictures, settings.controls, export)


def _what_happens(settings: KeypointSettings, comparer: Comparer, count: int, missing: int) -> str:
    """One line before the work begins."""
    kept = f"; {count - missing} of them are there already" if missing < count else ""
    names = ", ".join(map(shown_name, comparer.representations.names))
    level = "of each pair" if settings.level is None else settings.level
    turned = ", also with the right panorama turned" if settings.controls else ""
    noun = "pair" if count == 1 else "pairs"
    return f"{count} {noun}, {settings.detector}, {names}, level {level}{turned}{kept}"


def _compare_all(
    pairs: PanoramaPairs,
    missing: Sequence[int],
    comparer: Comparer,
    outputs: PairOutputs,
    entries: dict[str, PairEntry],
) -> None:
    """Fill `entries` pair by pair, and write them every few seconds."""
    begun = written = time.monotonic()
    with progress_bar(show=bool(missing)) as bar:
        task = bar.add_task("Comparing pairs", total=len(missing), rate="")
        for number, (name, entry) in enumerate(
            _compared(pairs, missing, comparer, outputs), start=1
        ):
            entries[name] = entry
            if entry.error is not None:
                message = f"Pair {name}: {entry.error}"
                bar.console.print(message, style="red", markup=False, soft_wrap=True)
            for side in entry.without_keypoints:
                message = f"Pair {name}: no keypoint on {side}"
                bar.console.print(message, style="yellow", markup=False, soft_wrap=True)
            if time.monotonic() - written > _SECONDS_BETWEEN_WRITES:
                outputs.folder.write(entries.values())
                written = time.monotonic()
            rate = f"{number / (time.monotonic() - begun):.2f} pairs/s"
            bar.update(task, completed=number, rate=rate)


def _compared(
    pairs: PanoramaPairs, missing: Sequence[int], comparer: Comparer, outputs: PairOutputs
) -> Iterator[tuple[str, PairEntry]]:
    for index in missing:
        name = pairs.name(index)
        try:
            pair = pairs.read(index)
            comparison = comparer.compare(pair)
            outputs.write(index, pair, comparison)
        except (DataError, MemoryError) as error:  # of this pair; a SettingError is of all
            yield name, PairEntry(name, error=str(error) or type(error).__name__)
        else:
            yield name, comparison.entry


def _write(
    folder: ResultsFolder,
    entries: Sequence[PairEntry],
    pairs: PanoramaPairs,
    comparer: Comparer,
    settings: KeypointSettings,
) -> None:
    folder.write(entries)
    if any(entry.error is None for entry in entries):
        folder.write_tables(_report(entries, pairs, comparer, settings))


def _report(
    entries: Sequence[PairEntry],
    pairs: PanoramaPairs,
    comparer: Comparer,
    settings: KeypointSettings,
) -> KeypointReport:
    of_paper = isinstance(pairs, StanfordPairs) and pairs.is_published
    published = {str(pair.number): pair for pair in published_pairs()} if of_paper else {}
    return KeypointReport(
        tuple(entries), tuple(comparer.representations.names), published, settings.told
    )
