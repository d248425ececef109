"""A depth network for photos on panoramas with known distances (``docs/results/depth.md``).

``python -m studies.depth_network net.onnx --rooms room.png=room.exr --homes zind/sample_tour``
takes a network that tangent-import wrote, panoramas with their distances in meters, and homes of
ZInD, whose layouts are known above the horizon: furniture is not in a layout. ``--picture`` draws
the depth of one panorama instead.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise, product
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from datamodules.core.files import Problems
from datamodules.zind.homes import list_home_panoramas
from studies.output import FOLDER, Row, save
from tangent_train.checkpoints.loaded import LoadedNetwork, load_network
from tangent_train.errors import DataError
from tangent_train.files import write_bytes
from tangent_train.geometry import equirect_latitudes
from tangent_train.geometry.camera import half_width
from tangent_train.heads import head_of
from tangent_train.heads.alignment import AlignedMosaic
from tangent_train.heads.pictures import (
    colorize_distance,
    distance_limits,
    with_distance_legend,
)
from tangent_train.inference.engine import Predictor, RenderedViews
from tangent_train.inference.images import InputImage, read_panorama
from tangent_train.inference.views import ViewSelector
from tangent_train.io.pixel_files import read_depth_m, read_rgb
from tangent_train.kinds import Align
from tangent_train.metrics.depth import BANDS, DepthProtocol, depth_scores, error_sums
from tangent_train.metrics.scores import BAND_EDGES_DEG
from tangent_train.rendering.representations.views import PinholeViews, Views
from tangent_train.rendering.resampling import resize

_FARTHEST_M = 100.0
"""Larger distances are invalid in some files."""

_SHAPE = 512, 1024
"""Rows and columns of all panoramas."""

_MODES: tuple[Align, ...] = "none", "scale", "grid"
_CAMERAS = "ignored", "used"
_UNALIGNED = "equirectangular image", "six cube faces"
"""Views without overlap, of which all corrections are equal."""
_WITH_GRID = (
    "20 tangent images (b = 0)",
    "16 horizontal views, 130° and 100°",
    "18 horizontal views of 100°",
    "views like the photos",
)
"""Views with the correction `grid`, which takes long, on rooms."""

_BANDS = [f"{low:g}° to {high:g}°" for low, high in pairwise(BAND_EDGES_DEG)]
_COLUMNS: dict[str, tuple[str, float, int]] = {
    "absrel": ("AbsRel", 1, 3),
    "delta1": ("δ1 %", 100, 1),
    "rmse": ("RMSE m", 1, 2),
    "absrel, median": ("AbsRel with the right median", 1, 3),
    "delta1, median": ("δ1 % with the right median", 100, 1),
    "rmse, median": ("RMSE m with the right median", 1, 2),
    "step_before": ("step before %", 100, 1),
    "step_after": ("step after %", 100, 1),
    **{band: (f"AbsRel with the right median, {band}", 1, 3) for band in _BANDS},
}
"""Title, factor and digits of the scores."""

_WITH_INTERVAL = "absrel", "delta1", "absrel, median", "delta1, median"
_MANY = 10
"""Number of panoramas from which intervals are printed."""


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


def view_options(loaded: LoadedNetwork) -> dict[str, dict[str, Any]]:
    """Return the arguments of `ViewSelector` by the name of the views.

    Args:
        loaded: The network.
    """
    level, fov_deg = loaded.photo_level or loaded.level, loaded.photo_fov_deg or (90.0, 90.0)
    found: dict[str, dict[str, Any]] = {
        "equirectangular image": {"views": "erp"},
        "six cube faces": {"views": "cubemap"},
        "20 tangent images (b = 0)": {"views": "tangent", "base_level": 0, "levels": level - 1},
        "80 tangent images (b = 1)": {"views": "tangent", "base_level": 1, "levels": level},
        "16 horizontal views, 130° and 100°": {"views": "horizontal_wide"},
        "18 horizontal views of 100°": {"views": "horizontal"},
        "views like the photos": {"views": "horizontal_camera"},
    }
    for across in (80.0, 100.0):  # stretched as the photos were
        ratio = half_width(fov_deg[1]) / half_width(fov_deg[0])
        down = 2 * math.degrees(math.atan(half_width(across) * ratio))
        views = {"option": "horizontal_camera", "fov": [across, down]}
        found[f"{across:g}° × {down:.0f}°, stretched"] = {"views": views}
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
            row |= dict(zip(_BANDS, bands.tolist(), strict=True))
    return row


def measure(
    loaded: LoadedNetwork, panoramas: Sequence[Panorama], name: str, given: Mapping[str, Any]
) -> tuple[list[Row], list[Row]]:
    """Return the scores of every panorama, and the scale of every view.

    Args:
        loaded: The network, whose camera is known.
        panoramas: The panoramas.
        name: Name of the views.
        given: Arguments of `ViewSelector`.

    Returns:
        Rows of scores for both uses of the camera and all corrections. Rows of views with a known
        distance in a quarter of their pixels: the median ratio of the network's and the true
        distances, the camera ignored.
    """
    found: list[Row] = []
    ratios: list[Row] = []
    selector = ViewSelector(loaded, **given)
    for group, image, truth in panoramas:
        ((source, shape, sets, _),) = selector(image)
        rendered = RenderedViews(loaded, source, shape, "cpu")
        with torch.no_grad():
            outputs = [loaded.network(rendered.of(views)(slice(None))) for views in sets]
        outputs = [output / _span(loaded) for output in outputs]
        for views, output in zip(sets, outputs, strict=True):
            if isinstance(views, PinholeViews):
                distances = output[:, 0] * torch.from_numpy(views.ray_lengths())
                true = views.render(truth[None], "nearest")[:, 0]
                heights = np.degrees(np.arcsin(views.grid.centers_xyz[:, 2])).round()
                for height, d, g in zip(heights, distances, true, strict=True):
                    known = g > 0
                    row: Row = {"data": group, "views": name, "pitch °": int(height)}
                    if known.float().mean() > 0.25:
                        ratios.append(row | {"ratio": float((d / g)[known].median())})
        modes = _MODES if name in _WITH_GRID and group == "rooms" else _MODES[:2]
        for camera, mode in product((0, 1), modes[: 1 if name in _UNALIGNED else 3]):
            mosaic = AlignedMosaic(image.shape, "metric_z", "feather", mode)
            for views, output in zip(sets, outputs, strict=True):
                mosaic.add(output * (_span(loaded) / _width(views) if camera else 1), views)
            used = {"data": group, "views": name, "camera": _CAMERAS[camera], "align": mode}
            row = used | scores(mosaic.pixels(), truth)
            steps = {key: mosaic.facts[key] for key in ("step_before", "step_after")}
            found.append(row | {"number": mosaic.facts["views"]} | steps)
    return found, ratios


def _span(loaded: LoadedNetwork) -> float:
    """Return the width of the photos of the training at distance 1."""
    return 2 * half_width((loaded.photo_fov_deg or (90.0, 90.0))[0])


def _width(views: Views) -> float:
    """Return the width of views at distance 1; the radians of an equirectangular image."""
    return 2 * views.grid.half_size[0] if isinstance(views, PinholeViews) else 2 * math.pi


def scales(ratios: Sequence[Row]) -> list[Row]:
    """Return mean and standard deviation of the ratios of views of one pitch."""
    rows: list[Row] = []
    for key in sorted({tuple(row.values())[:3] for row in ratios}):
        of_key = [row["ratio"] for row in ratios if tuple(row.values())[:3] == key]
        row = dict(zip(("data", "views", "pitch °"), key, strict=True))
        row |= {"number": len(of_key), "scale": f"{np.mean(of_key):.2f}"}
        rows.append(row | {"spread": f"{np.std(of_key):.2f}"})
    return rows


def table(rows: Sequence[Row], seed: int = 0) -> list[Row]:
    """Return the means over the panoramas of each group, as texts.

    Args:
        rows: Results of `measure`.
        seed: Seed of the 95 % bootstrap intervals over the panoramas of a large group.
    """
    rng, found = np.random.default_rng(seed), []
    groups = list(dict.fromkeys(row["data"] for row in rows))
    for key in dict.fromkeys(tuple(row.values())[1:4] for row in rows):
        of_key = [row for row in rows if tuple(row.values())[1:4] == key]
        line: Row = {"views": key[0], "number": int(of_key[0]["number"])}
        line |= {"camera": key[1], "align": key[2]}
        for group, (score, (title, scale, digits)) in product(groups, _COLUMNS.items()):
            found_in = [row[score] for row in of_key if row["data"] == group]
            values = scale * np.array([np.nan if v is None else v for v in found_in], float)
            values = values[~np.isnan(values)]
            text = f"{values.mean():.{digits}f}" if len(values) else ""
            if len(values) >= _MANY and score in _WITH_INTERVAL:
                draws = rng.choice(values, (2000, len(values))).mean(axis=1)
                low, high = np.quantile(draws, (0.025, 0.975))
                text += f" [{low:.{digits}f}, {high:.{digits}f}]"
            line[f"{title}, {group}"] = text
        found.append(line)
    return found


def picture(loaded: LoadedNetwork, file: Path) -> NDArray[Any]:
    """Draw a panorama, and the depth of the network with each correction, as RGB.

    Args:
        loaded: The network.
        file: The panorama; colors of a ``.hdr`` file are cut off at 1 and get a gamma of 2.2.
    """
    pixels: Any = cv2.imread(str(file), cv2.IMREAD_ANYDEPTH | cv2.IMREAD_COLOR)
    if pixels.dtype == np.float32:
        pixels = (255 * pixels.clip(0, 1) ** (1 / 2.2)).round().astype(np.uint8)
    image = read_panorama(np.ascontiguousarray(pixels[..., ::-1]))
    found: dict[str, NDArray[Any]] = {}
    for mode in _MODES:
        predictor = Predictor(loaded, head_of(loaded, align=mode), ViewSelector(loaded))
        mosaic = predictor.predict(image)
        distance, step = mosaic.pixels().numpy(), 100 * mosaic.facts["step_after"]
        found[f"align={mode}: step between views {step:.0f} %"] = distance
    limits = distance_limits(*found.values())
    tiles = {"panorama": image.rgb}
    tiles |= {title: colorize_distance(distance, limits) for title, distance in found.items()}
    parts = []
    for title, tile in tiles.items():
        small = resize(tile, (256, 512), "bilinear")
        strip = np.full((28, 512, 3), 255, np.uint8)
        cv2.putText(strip, title, (6, 20), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (0, 0, 0), 1, cv2.LINE_AA)
        parts.append(np.concatenate([strip, small]))
    rows = [np.concatenate(parts[k : k + 2], axis=1) for k in (0, 2)]
    return with_distance_legend(np.concatenate(rows), limits, "m")


def main() -> None:
    """Measure all views and write the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("network", type=Path)
    parser.add_argument("--rooms", nargs="*", default=[], metavar="IMAGE=DISTANCES")
    parser.add_argument("--homes", type=Path)
    parser.add_argument("--picture", type=Path, metavar="PANORAMA")
    given = parser.parse_args()
    loaded = load_network(given.network)
    if given.picture:
        drawn = picture(loaded, given.picture)[..., ::-1]
        write_bytes(FOLDER / "depth_network.jpg", cv2.imencode(".jpg", drawn)[1].tobytes())
        return
    panoramas = [*rooms(given.rooms), *(homes(given.homes) if given.homes else ())]
    found: list[Row] = []
    ratios: list[Row] = []
    for name, options in view_options(loaded).items():
        of_name = measure(loaded, panoramas, name, options)
        found, ratios = found + of_name[0], ratios + of_name[1]
    save("depth_network", table(found))
    save("depth_network_scales", scales(ratios))


if __name__ == "__main__":
    main()
