"""Write a photo network as a file that all commands take."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from datamodules.core.inputs import normalize_channels
from datamodules.core.label_map import DISTANCE
from models.onnx_network import OnnxNetwork
from tangent_train.checkpoints.loaded import (
    METADATA_KEY,
    LoadedNetwork,
    declared_sizes,
    load_network,
    write_onnx_description,
)
from tangent_train.checkpoints.outputs import (
    Groups,
    OutputNetwork,
    example_inputs,
    network_for_views,
    plain_output,
)
from tangent_train.config.build import build_from_config
from tangent_train.config.from_file import classes_to_trust
from tangent_train.errors import SettingError, first_line, width_height
from tangent_train.files import atomic_path
from tangent_train.geometry import camera_matrix_from_fov, vertex_resolution
from tangent_train.geometry.camera import half_width
from tangent_train.inference.views import (
    Levels,
    ViewChoice,
    camera_settings,
    check_size,
    photo_network_settings,
)
from tangent_train.io.image_files import composed
from tangent_train.kinds import ScoreKind, depth_channels
from tangent_train.photo_networks.network import PhotoNetwork

_PHOTO_LEVELS = (5, 13)

USUAL_FOV_DEG = 60.0
"""Horizontal field of view of photos if it is unknown."""

_MASK_NAMES = 2
"""Largest number of names for a single score: the class, or its background and the class."""

_ROUNDED = 2e-3
"""Largest error of a sum of probabilities in float16."""


def import_network(
    network: PhotoNetwork,
    path: Path,
    *,
    fov_deg: float | tuple[float, float] | None = None,
    levels: Levels = None,
    base_level: int | None = None,
    views: ViewChoice = None,
    unknown_classes: Collection[str] = (),
    unknown_wins: bool = True,
    image_size: tuple[int, int] | None = None,
    score_kind: ScoreKind | None = None,
) -> LoadedNetwork:
    """Run a photo network on one image, write it to a file and read it again.

    Args:
        network: The network; it is set to evaluation mode.
        path: File to write: ``.ckpt``, or ``.onnx`` for a network from an ONNX file.
        fov_deg: Horizontal field of view of the photos it was trained on, or horizontal and
            vertical of photos that were stretched. None for `USUAL_FOV_DEG` in predictions on
            photos. If given, metric z-depth is taken for right for this camera only.
        levels: See `photo_network_settings`.
        base_level: See `photo_network_settings`.
        views: See `photo_network_settings`.
        unknown_classes: Names of scores that are not classes, such as a background.
        unknown_wins: True if these scores may win; such pixels are unknown (label 0).
        image_size: Fixed rows and columns of the network's images; None for the size of its
            training, and for other sizes if it supports them.
        score_kind: Kind of the network's output; None for the kind that its library declares, or
            `usual_kind` of an ONNX file.

    Returns:
        The network, read from the file.

    Raises:
        SettingError: A setting is invalid, or the names do not fit the scores.
        OSError: The disk is full.
    """
    multiple, only_size = declared_sizes(network.module)
    fixed = image_size or only_size
    if network.things and fixed and fixed[0] != fixed[1]:
        found = f"{width_height(fixed)}, and objects"
        raise SettingError("image_size", found=found, expected="a square, which views are")
    size = fixed or network.image_size
    output = _output(network, size)
    described: dict[str, Any] = {"class_names": (), "predicts": DISTANCE}
    if network.depth_kind is None:
        kind = score_kind or network.score_kind or usual_kind(output, len(network.score_names))
        count = output.shape[1]
        unknown = {*unknown_classes, *network.unknown}
        names, groups = _groups(network.score_names, kind, count, unknown, unknown_wins)
        things = tuple(name for name in map(composed, network.things) if name in names)
        described = {"class_names": names, "groups": groups, "score_kind": kind, "things": things}
    camera = None if fov_deg is None else _both_fov_deg(fov_deg, size)
    depth_kind = network.depth_kind
    if depth_kind == "metric_z" and camera is not None:
        depth_kind = "canonical_z"
    # A network of a fixed size gets square images of its longer side, see `NetworkDescription`.
    side = max(size) if fixed else min(size)
    photo_level = _photo_level(size[1], camera[0] if camera else USUAL_FOV_DEG)
    of_camera = camera_settings(camera, size, photo_level)
    seen = photo_network_settings(side, levels, base_level, views, of_camera)
    loaded = LoadedNetwork(
        module=network.module,
        **described,
        depth_kind=depth_kind,
        inputs=("rgb",),
        normalization=network.normalization,
        level=seen["level"],
        representation=seen,
        image_size=build_from_config(seen, "representation").image_size,
        size_multiple=multiple,
        fixed_size=fixed,
        photo_level=photo_level,
        photo_fov_deg=camera,
        settings=network.settings,
    )
    check_size(loaded, loaded.image_size)
    network_for_views(loaded.network, seen.get("distortion_aware"))  # refused before it is used
    with atomic_path(path) as temporary:
        if isinstance(network.module, OnnxNetwork):
            write_onnx_description(network.module.path, temporary, loaded)
        else:
            _write_checkpoint(loaded, temporary)
        # The classes are from the user.
        return load_network(temporary, classes_to_trust(network.settings))


@torch.no_grad()
def _output(network: PhotoNetwork, size: tuple[int, int]) -> Tensor:
    """Return the output ``(1, K, h, w)`` for an image of noise; label maps and depth have K = 1."""
    image = torch.rand(1, 3, *size, generator=torch.Generator().manual_seed(0))
    images = normalize_channels(image, [1, 1, 1], network.normalization)
    module, channels = network.module.eval(), 0
    if network.depth_kind is not None:
        channels = depth_channels(network.depth_kind)
        module = OutputNetwork(module, channels, kind=None)
    try:
        output = plain_output(module(*example_inputs(module, images))).float()
    except Exception as error:  # networks raise many kinds about images that they do not take
        found = f"{type(error).__name__} ({first_line(error)})"
    else:
        output = output if output.ndim == image.ndim else output[:, None]
        fits = output.shape[2:] == size and channels in (0, output.shape[1])
        if fits and output.isfinite().any():
            return output
        found = f"{tuple(output.shape)}, {int(output.isfinite().sum())} numbers are finite"
    raise SettingError(
        "output of the network",
        found=f"{found} for an RGB image of {width_height(size)}",
        expected="scores (1, K, h, w) of the image's size; labels or depth with K = 1, points 3",
        remedy="If it needs another size, set image_size=[rows,columns].",
    )


def usual_kind(output: Tensor, named: int) -> ScoreKind:
    """Return the kind of output of an ONNX file if the user does not state it.

    Values between 0 and 1 that sum to one over the classes are probabilities. One whole number per
    pixel is a label, if there are more than two names.

    Args:
        output: Output for one image, ``(1, K, h, w)``.
        named: Number of class names.
    """
    if output.shape[1] == 1 and named > _MASK_NAMES:
        return "labels"
    is_share = bool((output >= 0).all() and (output <= 1).all())
    has_unit_sums = bool(((output.sum(dim=1) - 1).abs() < _ROUNDED).all())
    return "probabilities" if is_share and (has_unit_sums or output.shape[1] == 1) else "logits"


def _both_fov_deg(
    fov_deg: float | tuple[float, float], size: tuple[int, int]
) -> tuple[float, float]:
    """Return a horizontal and vertical field of view; one number is that of square pixels."""
    if isinstance(fov_deg, tuple):
        return fov_deg
    return fov_deg, 2 * math.degrees(math.atan(half_width(fov_deg) * size[0] / size[1]))


def _photo_level(columns: int, fov_deg: float) -> int:
    """Return the level s with the focal length nearest to that of photos.

    The focal length of level s is ``2^s / R_v(−1)`` pixels.

    Args:
        columns: Number of columns of the photos.
        fov_deg: Horizontal field of view of the photos.

    Raises:
        SettingError: The field of view is not between 0° and 180°.
    """
    focal = camera_matrix_from_fov(fov_deg, (1, columns))[0, 0]
    level = round(math.log2(focal * vertex_resolution(-1)))
    return min(max(level, _PHOTO_LEVELS[0]), _PHOTO_LEVELS[1])


def _groups(
    score_names: Sequence[str],
    kind: ScoreKind,
    count: int,
    unknown_classes: Collection[str],
    unknown_wins: bool,
) -> tuple[list[str], Groups | None]:
    """Return names of the labels, and the scores of each, see `NetworkDescription.groups`.

    Of two names for a single score, the first is the background.
    """
    names, unknown = list(map(composed, score_names)), set(map(composed, unknown_classes))
    is_mask = kind != "labels" and count == 1 and len(names) <= _MASK_NAMES
    scores, rest = list(range(len(names))), [len(names)] if kind == "labels" else []
    if is_mask:  # index 1 is "not of the class", see `ScoreKind`
        scores, rest = ([0], [1]) if len(names) == 1 else ([1, 0], [])
    classes = {name: k for k, name in zip(scores, names, strict=True) if name not in unknown}
    has_second = len(classes) > 1 and kind != "labels"
    fits = {
        f"names of {count} scores": kind == "labels" or is_mask or len(names) == count,
        f"unknown_classes among {', '.join(names)}": unknown <= set(names),
        "other classes besides unknown_classes": bool(classes),
        "unknown_wins=true, or a second best class": unknown_wins or has_second,
    }
    for expected in (text for text, is_met in fits.items() if not is_met):
        found = f"{len(names)}, and unknown_classes {', '.join(sorted(unknown)) or 'none'}"
        raise SettingError("class names of the network", found=found, expected=expected)
    rest += [k for k, name in zip(scores, names, strict=True) if name in unknown]
    labels = ["unknown", *classes]
    if not rest and scores == list(range(count)):
        return labels, None
    return labels, [[k] for k in classes.values()] + ([rest] if rest and unknown_wins else [])


def _write_checkpoint(loaded: LoadedNetwork, path: Path) -> None:
    tensors = {
        f"network.{name}": t.contiguous().float() if t.is_floating_point() else t
        for name, t in loaded.module.state_dict().items()
    }
    torch.save({METADATA_KEY: loaded.plain(), "state_dict": tensors}, path)
