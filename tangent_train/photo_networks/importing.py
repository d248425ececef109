"""Write a photo network as a checkpoint of this package."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from models.onnx_network import OnnxNetwork
from tangent_train.checkpoints.distances import DistanceNetwork
from tangent_train.checkpoints.kinds import ScoreKind
from tangent_train.checkpoints.loaded import (
    LoadedNetwork,
    load_network,
    metadata_of,
    write_metadata,
)
from tangent_train.checkpoints.scores import (
    ClassScoreNetwork,
    Groups,
    network_for_views,
    size_multiple_of,
)
from tangent_train.config.build import build_from_config, unregistered
from tangent_train.errors import SettingError, width_height
from tangent_train.files import atomic_path
from tangent_train.geometry import camera_matrix_from_fov, vertex_resolution
from tangent_train.inference.representations import (
    Levels,
    ViewChoice,
    check_size,
    photo_network_settings,
)
from tangent_train.io.image_files import composed
from tangent_train.photo_networks.depth_kinds import try_depth
from tangent_train.photo_networks.network import PhotoNetwork
from tangent_train.photo_networks.score_kinds import try_network

_PHOTO_LEVELS = (5, 13)


def import_network(
    network: PhotoNetwork,
    path: Path,
    *,
    fov_deg: float = 60.0,
    levels: Levels = None,
    base_level: int | None = None,
    views: ViewChoice = None,
    unknown_classes: Collection[str] = (),
    unknown_wins: bool = True,
    image_size: tuple[int, int] | None = None,
    score_kind: ScoreKind | None = None,
    remark: Callable[[str], object] = lambda sentence: None,
) -> LoadedNetwork:
    """Try a photo network, write it as a checkpoint and read it again.

    Args:
        network: The network; it is set to evaluation mode.
        path: File to write: ``.ckpt``, or ``.onnx`` for a network from an ONNX file.
        fov_deg: Horizontal field of view of the photos it was trained on, for labels of photos.
        levels: See `photo_network_settings`.
        base_level: See `photo_network_settings`.
        views: See `photo_network_settings`.
        unknown_classes: Names of scores that are not classes, such as a background.
        unknown_wins: True if these scores may win; such pixels are unknown (label 0).
        image_size: Fixed rows and columns of the network's images; None for the size of its
            training, and for other sizes if it supports them.
        score_kind: Kind of the network's output; None for the kind that its library declares, or to
            find it by trial.
        remark: Called with each sentence about something that looks wrong.

    Returns:
        The network, read from the file.

    Raises:
        SettingError: A setting is invalid, or the names do not fit the scores.
        NoRoomError: The disk is full.
    """
    if image_size not in (None, network.image_size) and network.fixed_size:
        raise SettingError(
            "image_size",
            found=width_height(image_size),
            expected=f"{width_height(network.image_size)}, the only size that the file takes",
        )
    if image_size is not None:
        network = replace(network, image_size=image_size, fixed_size=True)
    tried: DistanceNetwork | ClassScoreNetwork
    if network.depth_kind is not None:
        outputs: dict[str, Any] = {"class_names": (), "depth_kind": network.depth_kind}
        tried = DistanceNetwork(network.network, network.depth_kind)
        for sentence in try_depth(network):
            remark(sentence)
    else:
        kind, count = try_network(replace(network, score_kind=score_kind or network.score_kind))
        names, groups = _groups(network.score_names, kind, count, unknown_classes, unknown_wins)
        outputs = {"class_names": tuple(names), "groups": groups, "score_kind": kind}
        tried = ClassScoreNetwork(network.network, len(names) - 1, groups, kind=kind)
    multiple = None if network.fixed_size else size_multiple_of(tried, 3)
    # A network of a fixed size gets square images of its longer side, see `LoadedNetwork`.
    side = min(network.image_size) if multiple else max(network.image_size)
    seen = photo_network_settings(side, levels, base_level, views)
    size = build_from_config(seen, "representation").image_size
    described = LoadedNetwork(
        module=network.network,
        **outputs,
        inputs=("rgb",),
        normalization=network.normalization,
        level=seen["level"],
        representation=seen,
        image_size=size,
        size_multiple=multiple or 1,
        fixed_size=None if multiple else network.image_size,
        photo_level=_photo_level(network.image_size[1], fov_deg),
        settings=network.settings,
    )
    check_size(described, described.image_size)
    network_for_views(described.network, seen.get("distortion_aware"))  # refused before it is used
    with atomic_path(path) as temporary:
        if isinstance(network.network, OnnxNetwork):
            write_metadata(network.network.path, temporary, described)
        else:
            _write_checkpoint(described, temporary)
        # The classes are from the user.
        trained = load_network(temporary, unregistered(network.settings))
    source = None if trained.source is None else replace(trained.source, path=path)
    return replace(trained, source=source)


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
    wins: bool,
) -> tuple[list[str], Groups | None]:
    """Return the names of the labels, and the scores of each, see `LoadedNetwork.groups`."""
    score_names = list(map(composed, score_names))
    unknown_classes = set(map(composed, unknown_classes))
    if missing := unknown_classes - set(score_names):
        raise SettingError(
            "unknown_classes",
            found=", ".join(sorted(missing)),
            expected=f"names among {', '.join(score_names)}",
        )
    scores, rest = _scores_of(len(score_names), kind, count)
    named = list(zip(scores, score_names, strict=True))
    kept = [(k, name) for k, name in named if name not in unknown_classes]
    if not kept:
        raise SettingError("unknown_classes", found="all classes", expected="a part of them")
    if not wins and (len(kept) == 1 or kind == "labels"):
        raise SettingError(
            "unknown_wins",
            found=f"false, for {kept[0][1]} alone" if len(kept) == 1 else "false, for label maps",
            expected="true, because the network has no other class to predict",
        )
    rest += [k for k, name in named if name in unknown_classes]
    names = ["unknown", *(name for _, name in kept)]
    if kind in ("logits", "probabilities") and not unknown_classes:
        return names, None
    return names, [[k] for k, _ in kept] + ([rest] if rest and wins else [])


def _scores_of(named: int, kind: ScoreKind, count: int) -> tuple[list[int], list[int]]:
    """Return indices of the named classes' scores, and of scores without a class, see `ScoreKind`.

    A single score, or labels with one name, belong to a class and its background. Of two names for
    a single score, the first is the background.
    """
    indices = list(range(named))
    if kind == "labels":
        return ([1], [0, 2]) if named == 1 else (indices, [named])
    independent = kind in ("sigmoid_logits", "sigmoid")
    if independent and (count, named) == (1, 2):
        return [1, 0], []
    if named != count:
        raise SettingError(
            "class names of the network",
            found=f"{named}, for {count} score{'s' * (count > 1)}",
            expected="one for each score"
            + (", or two for one score, the background first" if count == 1 else ""),
        )
    return indices, [count] if independent else []


def _write_checkpoint(described: LoadedNetwork, path: Path) -> None:
    content = metadata_of(described)
    names = ("settings", "representation", "level")
    network, representation, level = (content.pop(name) for name in names)
    content |= {
        "config": {"network": network, "representation": representation, "level": level},
        "predicts": described.predicts,
        "state_dict": {
            name: t.contiguous().float() if t.is_floating_point() else t
            for name, t in described.network.state_dict().items()
        },
    }
    torch.save(content, path)
