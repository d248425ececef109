"""A depth network for photos on panoramas with known distances (``docs/results/depth.md``).

``python -m studies.depth_network net.onnx --rooms room.png=room.exr --homes zind/sample_tour``
takes a network that tangent-import wrote, panoramas with their distances in meters, and homes of
ZInD, whose layouts are known above the horizon: furniture is not in a layout.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from datamodules.core.files import Problems
from datamodules.zind.homes import list_home_panoramas
from studies.output import Row, save
from tangent_train.checkpoints.loaded import LoadedNetwork, load_network
from tangent_train.errors import DataError
from tangent_train.geometry import equirect_latitudes
from tangent_train.heads import head_of
from tangent_train.heads.alignment import along_rays, depth_of_output, distance_of
from tangent_train.inference.engine import Predictor, RenderedViews
from tangent_train.inference.images import InputImage, read_panorama
from tangent_train.inference.views import ViewSelector
from tangent_train.io.pixel_files import read_depth_m, read_rgb
from tangent_train.metrics.depth import BANDS, DepthProtocol, depth_scores, error_sums
from tangent_train.metrics.scores import BAND_EDGES_DEG
from tangent_train.rendering.resampling import resize

_FARTHEST_M = 100.0
"""Larger distances are invalid in some files."""

_SHAPE = 512, 1024
"""Rows and columns of all panoramas."""

_MODES = "none", "scale", "grid"
_UNALIGNED = "equirectangular image", "six cube faces"
"""Views without overlap, of which every mode is the same."""


class Panorama(NamedTuple):
    """A panorama with known distances.

    Attributes:
        group: Name of its data.
        image: The panorama.
        distance_m: ``(H, W)`` distances from the center in meters, NaN where unknown.
    """

    group: str
    image: InputImage
    distance_m: torch.Tensor


def rooms(files: Sequence[str]) -> Iterator[Panorama]:
    """Yield panoramas ``<image>=<distances>``, of one size."""
    for pair in files:
        image, depth = pair.split("=")
        distance = read_depth_m(Path(depth), 1000)
        known = np.where((distance > 0) & (distance < _FARTHEST_M), distance, np.nan)
        yield Panorama("rooms", read_panorama(image), torch.from_numpy(known).float())


def homes(root: Path) -> Iterator[Panorama]:
    """Yield the panoramas of ZInD that have a layout, with distances above the horizon."""
    for panorama in list_home_panoramas(root, Problems()):
        try:
            layout = panorama.layout()
        except DataError:
            continue
        rgb = resize(read_rgb(panorama.rgb), _SHAPE, "bilinear")
        image = read_panorama(rgb)
        distance = layout.distances(image.shape) * panorama.pose()[1]
        distance[equirect_latitudes(image.shape[0]) < 0] = np.nan
        yield Panorama("ZInD", image, torch.from_numpy(distance).float())


def view_options(loaded: LoadedNetwork, fov_deg: Sequence[float]) -> dict[str, dict[str, Any]]:
    """Return the arguments of `ViewSelector` by the name of the views.

    Args:
        loaded: The network.
        fov_deg: Horizontal and vertical field of view of the photos of its training.
    """
    level, size = loaded.photo_level or loaded.level, list(loaded.fixed_size or loaded.image_size)
    found: dict[str, dict[str, Any]] = {
        "equirectangular image": {"views": "erp"},
        "six cube faces": {"views": "cubemap"},
        "20 tangent images (b = 0)": {"views": "tangent", "base_level": 0, "levels": level - 1},
        "80 tangent images (b = 1)": {"views": "tangent", "base_level": 1, "levels": level},
        "16 horizontal views, 130° and 100°": {"views": "horizontal_wide"},
        "18 horizontal views of 100°": {"views": "horizontal"},
    }
    own = {"option": "horizontal", "rings": None, "fov": list(fov_deg), "dim": size}
    for overlap in (0.1, 0.25, 0.4):
        views = own | {"square_pixels": False, "overlap": overlap}
        found[f"own field of view, overlap {overlap:g}"] = {"views": views, "levels": level}
    square = own | {"fov": [fov_deg[0]] * 2, "overlap": 0.25}
    found[f"{fov_deg[0]:g}° × {fov_deg[0]:g}°"] = {"views": square, "levels": level}
    return found


def scores(prediction: torch.Tensor, truth: torch.Tensor) -> dict[str, float]:
    """Return scores by solid angle in meters and after the median, and AbsRel of latitude bands."""
    row: dict[str, float] = {}
    for name, alignment in (("", "none"), (", median", "median")):
        protocol = DepthProtocol(alignment=alignment)  # type: ignore[arg-type]
        sums = error_sums(protocol.aligned(prediction, truth), truth).numpy()
        of_sphere = depth_scores(sums[1])
        for key in ("absrel", "delta1", "rmse"):
            row[key + name] = float(of_sphere[key])
        if name:
            bands = depth_scores(sums[BANDS])["absrel"]
            edges = pairwise(BAND_EDGES_DEG)
            for (low, high), value in zip(edges, bands, strict=True):
                row[f"absrel, median, {low:g}° to {high:g}°"] = float(value)
    return row


def measure(
    loaded: LoadedNetwork, panoramas: Sequence[Panorama], options: Mapping[str, dict[str, Any]]
) -> list[Row]:
    """Return the scores of every panorama, with all views and corrections."""
    rows: list[Row] = []
    for name, given in options.items():
        for mode in _MODES[:1] if name in _UNALIGNED else _MODES:
            head = head_of(loaded, align=mode)
            predictor = Predictor(loaded, head, ViewSelector(loaded, **given))
            for number, (group, image, truth) in enumerate(panoramas):
                mosaic = predictor.predict(image)
                row: Row = {"data": group, "panorama": number, "views": name, "align": mode}
                row |= scores(mosaic.pixels(), truth)
                steps = {key: mosaic.facts[key] for key in ("step_before", "step_after")}
                rows.append(row | {"number": mosaic.facts["views"]} | steps)
    return rows


def scales_of_views(
    loaded: LoadedNetwork, panoramas: Sequence[Panorama], options: Mapping[str, dict[str, Any]]
) -> list[Row]:
    """Return the median ratio of predicted and true distances in a view, by the view's pitch.

    Returns:
        For every option and pitch the mean and standard deviation over views and panoramas, of
        views with a known distance in a quarter of their pixels.
    """
    rows: list[Row] = []
    for name, given in options.items():
        ratios: dict[tuple[str, int], list[float]] = {}
        selector = ViewSelector(loaded, **given)
        for group, image, truth in panoramas:
            ((source, shape, sets, _),) = selector(image)
            rendered = RenderedViews(loaded, source, shape, "cpu")
            for views in sets:
                lengths = torch.from_numpy(views.ray_lengths())[:, None]
                with torch.no_grad():
                    output = loaded.network(rendered.of(views)(slice(None)))
                depth, kind = depth_of_output(output, loaded.depth_kind or "metric_z", lengths)
                distance = distance_of(along_rays(depth, kind, lengths), kind)[:, 0]
                true = views.render(truth[None], "nearest")[:, 0]
                heights = np.arcsin(views.rays()[:, 2, 2])
                for height, d, g in zip(heights, distance, true, strict=True):
                    known = g > 0
                    if known.float().mean() > 0.25:
                        ratio = float((d / g)[known].nanmedian())
                        key = group, round(float(np.degrees(height)))
                        ratios.setdefault(key, []).append(ratio)
        for (group, height), found in sorted(ratios.items()):
            mean, spread = float(np.mean(found)), float(np.std(found))
            row = {"data": group, "views": name, "pitch °": height, "number": len(found)}
            rows.append(row | {"scale": mean, "spread": spread})
    return rows


def means(rows: Sequence[Row], seed: int = 0) -> list[Row]:
    """Return means over panoramas, and 95 % bootstrap intervals of three scores."""
    keys = list(dict.fromkeys((row["data"], row["views"], row["align"]) for row in rows))
    rng, found = np.random.default_rng(seed), []
    for key in keys:
        of_key = [row for row in rows if (row["data"], row["views"], row["align"]) == key]
        table: NDArray[np.float64] = np.array(
            [[np.nan if v is None else v for v in list(row.values())[4:]] for row in of_key], float
        )
        names = list(of_key[0])[4:]
        row = {"data": key[0], "panoramas": len(of_key), "views": key[1], "align": key[2]}
        for name, values in zip(names, table.T, strict=True):
            known = values[~np.isnan(values)]
            row[name] = float(known.mean()) if len(known) else ""
            if name in ("absrel", "delta1", "delta1, median") and len(known) > 9:
                draws = rng.choice(known, (2000, len(known))).mean(axis=1)
                low, high = np.quantile(draws, (0.025, 0.975))
                row[f"{name} from"], row[f"{name} to"] = float(low), float(high)
            elif name in ("absrel", "delta1", "delta1, median"):
                row[f"{name} from"] = row[f"{name} to"] = ""
        found.append(row)
    return found


def main() -> None:
    """Measure all views and write the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("network", type=Path)
    parser.add_argument("--rooms", nargs="*", default=[], metavar="IMAGE=DISTANCES")
    parser.add_argument("--homes", type=Path)
    parser.add_argument("--fov", nargs=2, type=float, default=(62.0, 48.0))
    given = parser.parse_args()
    loaded = load_network(given.network)
    panoramas = [*rooms(given.rooms), *(homes(given.homes) if given.homes else ())]
    options = view_options(loaded, given.fov)
    save("depth_network", means(measure(loaded, panoramas, options)), digits=3)
    pinhole = {name: each for name, each in options.items() if "erp" not in each.values()}
    save("depth_network_scales", scales_of_views(loaded, panoramas, pinhole), digits=3)


if __name__ == "__main__":
    main()
