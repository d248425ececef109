"""Alignment of the views of panoramas with known distances (``docs/results/depth.md``).

``python -m studies.depth_alignment depth.exr layout.npy`` takes files of distances. Each view
becomes the output of an imaginary network: it gets a random scale, a random shift (for disparity),
and a smooth error.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from studies.output import Row, save
from tangent_train.heads.alignment import (
    align_views,
    distance_of,
    from_distance,
    sample_views,
    sphere_points,
)
from tangent_train.io.pixel_files import read_depth_m
from tangent_train.kinds import Align, DepthKind
from tangent_train.rendering import HorizontalRepresentation

_RINGS = (
    {"pitch": 0, "views": 6, "fov": 130},
    {"pitch": 40, "views": 5},
    {"pitch": -40, "views": 5},
)
"""Those of ``representation=horizontal_wide``."""

_RINGS_BY_FOV = {
    60: {0: 10, 36: 10, -36: 10, 72: 6, -72: 6},
    90: {0: 6, 50: 6, -50: 6},
    100: {0: 6, 50: 5, -50: 5},
    130: {0: 4, 50: 4, -50: 4},
}
"""Number of views by pitch, for views of some field of view in degrees."""

_KINDS: tuple[DepthKind, ...] = ("metric_z", "relative_disparity")
_MODES: tuple[Align | None, ...] = (None, "grid")


def depth_alignment(
    distance_m: NDArray[np.floating],
    kind: DepthKind,
    smooth_error: float,
    dim: int = 256,
    *,
    rings: Sequence[Mapping[str, float]] = _RINGS,
    fov: float = 100,
    pixel_noise: float = 0,
    seed: int = 0,
    modes: Sequence[Align | None] = _MODES,
) -> Row:
    """Return steps between views, and errors of aligned views, in percent.

    Args:
        distance_m: ``(H, W)`` distances of a panorama; NaN or 0 where unknown.
        kind: Kind of the output of the imaginary network.
        smooth_error: Standard deviation of the smooth error of a view's logarithms.
        dim: Rows and columns of a view.
        rings: Rings of views.
        fov: Field of view in degrees, where a ring has no other.
        pixel_noise: Standard deviation of the noise of a pixel's logarithm.
        seed: Seed of the random errors, scales and shifts.
        modes: Corrections; None for that of the kind.
    """
    known = torch.from_numpy(np.where(distance_m > 0, distance_m, np.nan)).float()
    shape, rng = (known.shape[0], known.shape[1]), np.random.default_rng(seed)
    views = HorizontalRepresentation(9, dim=dim, rings=rings, fov=fov).view_sets()
    y, x = np.meshgrid(*[np.linspace(-1, 1, dim)] * 2, indexing="ij")
    truths, outputs = [], []
    for part in views:
        truth, column = part.render(known[None], "nearest").double(), (len(part), 1, 1, 1)
        angle, (tilt, radial) = rng.uniform(0, 2 * np.pi, column), rng.normal(size=(2, *column))
        error = tilt * (np.cos(angle) * x + np.sin(angle) * y) + radial * (x**2 + y**2)
        error -= error.mean(axis=(2, 3), keepdims=True)
        error *= smooth_error / error.std(axis=(2, 3), keepdims=True)
        error += rng.normal(0, pixel_noise, error.shape)
        lengths = torch.from_numpy(part.ray_lengths()).double()[:, None]
        exact = from_distance(truth * torch.from_numpy(np.exp(error)), kind, lengths)
        scale = np.exp(rng.normal(0, np.log(5) / 2, column)).clip(1 / 5, 5)
        shift = np.zeros(1) if kind == "metric_z" else rng.uniform(-0.3, 0.3, column)
        outputs.append(torch.from_numpy(scale) * exact + torch.from_numpy(shift))
        truths.append(truth)
    points = sphere_points(shape)
    samples = [
        sample_views(output, part, shape, points)
        for output, part in zip(outputs, views, strict=True)
    ]
    row: Row = {"output": kind, "smooth error %": 100 * smooth_error}
    for mode in modes:
        alignment, errors, first = align_views(samples, kind, mode), [], 0
        for output, truth, part in zip(outputs, truths, views, strict=True):
            numbers, lengths = slice(first, first + len(part)), torch.from_numpy(part.ray_lengths())
            distance = distance_of(alignment.applied(output, numbers, lengths), kind)
            errors.append((distance / truth).log().flatten(1).numpy())
            first += len(part)
        of_views = np.concatenate(errors) - np.nanmedian(np.concatenate(errors))
        name, report = "" if mode is None else f", {mode}", alignment.facts
        row.setdefault("step before", 100 * (report["step_before"] or 0))
        row[f"step{name}"] = 100 * (report["step_after"] or 0)
        row[f"error{name}"] = 100 * float(np.nanmedian(np.abs(of_views)))
        row[f"view{name}"] = 100 * float(np.abs(np.nanmedian(of_views, axis=1)).max())
    return row


def fields_of_view(distances_m: Sequence[NDArray[np.floating]], seeds: Sequence[int]) -> list[Row]:
    """Return the largest errors of a view, means over panoramas and seeds, in percent.

    Args:
        distances_m: ``(H, W)`` distances of each panorama; NaN or 0 where unknown.
        seeds: Seeds of the random errors.
    """
    rows = []
    for kind, (fov, views), error in product(_KINDS, _RINGS_BY_FOV.items(), (0.02, 0.05)):
        rings = [{"pitch": pitch, "views": count} for pitch, count in views.items()]
        row: Row = {"output": kind, "field of view °": fov, "views": sum(views.values())}
        row["error %"] = 100 * error
        for name, errors in (("smooth errors", (error, 0.0)), ("pixel noise", (0.0, error))):
            how: Any = {"rings": rings, "fov": fov, "modes": [None], "pixel_noise": errors[1]}
            found = [
                depth_alignment(distance_m, kind, errors[0], 128, seed=seed, **how)["view"]
                for distance_m, seed in product(distances_m, seeds)
            ]
            row[f"view, {name}"] = float(np.mean(found))
        rows.append(row)
    return rows


def main() -> None:
    """Measure all files and write the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("files", nargs="+", type=Path, help="distances in meters: .exr or .npy")
    files = parser.parse_args().files
    rows = [
        {"panorama": path.stem, **depth_alignment(read_depth_m(path, 1000), kind, error)}
        for path in files
        for kind in _KINDS
        for error in (0.0, 0.05, 0.1, 0.2)
    ]
    save("depth_alignment", rows, digits=2)
    rows = fields_of_view([read_depth_m(path, 1000) for path in files], range(3))
    save("depth_alignment_fov", rows, digits=2)


if __name__ == "__main__":
    main()
