"""Writing a photo network as a checkpoint of this package."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch

from datamodules.images.image_files import composed
from models.onnx_network import OnnxNetwork
from tangent_train.checkpoints.scores import Groups, Scores, size_multiple_of
from tangent_train.checkpoints.trained import (
    TrainedNetwork,
    load_trained,
    metadata_json,
    write_metadata,
)
from tangent_train.errors import SettingError
from tangent_train.files import atomic_path
from tangent_train.geometry import vertex_resolution
from tangent_train.inference.photo_networks.network import PhotoNetwork
from tangent_train.registry import unregistered

_TANGENT = "tangent_train.rendering.TangentRepresentation"
_LEVELS = (5, 13)


def import_network(
    network: PhotoNetwork,
    path: Path,
    *,
    fov_deg: float = 60.0,
    level: int | None = None,
    base_level: int | None = None,
    nothing: Collection[str] = (),
    nothing_wins: bool = True,
) -> TrainedNetwork:
    """Write a photo network as a checkpoint, read it again and label one image with it.

    Args:
        network: The network.
        path: The file: ``.ckpt``, or ``.onnx`` of a network from such a file.
        fov_deg: Horizontal field of view of the photos it was trained on.
        level: Level s of the panoramas; None for the angular resolution of those photos.
        base_level: Base level b of the tangent images; None for the size of those photos.
        nothing: Names of scores that mean nothing, such as a background.
        nothing_wins: Whether these may win, which is then written as unknown (label 0).

    Returns:
        The network as its file gives it back.

    Raises:
        SettingError: A setting is impossible, or the names do not fit the scores.
        NoRoomError: The disk is full.
    """
    seen = representation_of(network.image_size, fov_deg, level, base_level)
    names, groups = _groups(network.score_names, nothing, nothing_wins)
    with atomic_path(path) as temporary:
        if isinstance(network.network, OnnxNetwork):
            _write_onnx(network, temporary, names, groups, seen)
        else:
            _write_checkpoint(network, temporary, names, groups, seen)
        trained = load_trained(temporary, unregistered(network.settings))  # it was made from them
        _use(trained, seen, network.image_size)
    source = None if trained.source is None else replace(trained.source, path=path)
    return replace(trained, source=source)


def representation_of(
    image_size: tuple[int, int],
    fov_deg: float,
    level: int | None = None,
    base_level: int | None = None,
) -> dict[str, Any]:
    """Settings of the tangent images that look most like the photos a network was trained on.

    Level s has the focal length nearest to theirs, ``2^s / R_v(−1)`` pixels;
    base level b the largest images that are not larger than theirs. Their side is that of the
    photos' shorter one: what is beyond the default side overlaps with other images.

    Args:
        image_size: Rows and columns of the photos.
        fov_deg: Their horizontal field of view.
        level: Given level s.
        base_level: Given base level b.

    Raises:
        SettingError: An impossible field of view, or levels that do not fit.
    """
    if not 0 < fov_deg < 180:
        raise SettingError("fov", found=fov_deg, expected="more than 0 and less than 180 degrees")
    if level is None:
        focal = image_size[1] / 2 / math.tan(math.radians(fov_deg) / 2)
        level = round(math.log2(focal * vertex_resolution(-1)))
        level = min(max(level, _LEVELS[0]), _LEVELS[1])
    side = min(image_size)
    if base_level is None:
        base_level = max(0, math.ceil(level - math.log2(side)))
    dim = max(side, 2 ** (level - base_level))
    return {"_target_": _TANGENT, "base_level": base_level, "level": level, "dim": dim}


def _groups(
    score_names: Collection[str], nothing: Collection[str], wins: bool
) -> tuple[list[str], Groups | None]:
    """Names of the labels, and the scores of each; see `TrainedNetwork.groups`."""
    score_names, nothing = list(map(composed, score_names)), list(map(composed, nothing))
    places = list(enumerate(score_names))
    missing = set(nothing) - set(score_names)
    if missing:
        raise SettingError(
            "nothing", found=", ".join(sorted(missing)), expected=f"of {', '.join(score_names)}"
        )
    kept = [(k, name) for k, name in places if name not in nothing]
    if not kept:
        raise SettingError("nothing", found="all classes", expected="some of them")
    names = ["unknown", *(name for _, name in kept)]
    if not nothing:
        return names, None
    empty = [[k for k, name in places if name in nothing]] if wins else []
    return names, [[k] for k, _ in kept] + empty


@torch.no_grad()
def _use(trained: TrainedNetwork, seen: Mapping[str, Any], photos: tuple[int, int]) -> None:
    """Label one image as the commands will: names that do not fit the scores are refused."""
    try:
        trained.network(torch.zeros(1, 3, seen["dim"], seen["dim"]))
    except SettingError:
        raise
    except (RuntimeError, ValueError) as error:
        raise SettingError(
            "level, base_level",
            found=f"tangent images of {seen['dim']}×{seen['dim']}, which the network does not take "
            f"({str(error).partition(chr(10))[0]})",
            expected=f"its own images, of {'×'.join(map(str, photos))}",
            remedy="Leave base_level null, or make it larger.",
        ) from error


def _write_checkpoint(
    network: PhotoNetwork,
    path: Path,
    names: list[str],
    groups: Groups | None,
    seen: Mapping[str, Any],
) -> None:
    config = {
        "network": network.settings,
        "representation": dict(seen),
        "level": seen["level"],
    }
    mean, std = network.normalization.mean, network.normalization.std
    tensors = network.network.state_dict()
    content = {
        "config": config,
        "kind": "segmentation",
        "class_names": names,
        "groups": groups,
        "inputs": ["rgb"],
        "normalization": {"mean": list(mean), "std": list(std)},
        "state_dict": {f"network.{n}": t.contiguous().float() if t.is_floating_point() else t
                       for n, t in tensors.items()},
        "tangent_train_version": version("tangent-train"),
    }  # fmt: skip
    torch.save(content, path)


def _write_onnx(
    network: PhotoNetwork,
    path: Path,
    names: list[str],
    groups: Groups | None,
    seen: Mapping[str, Any],
) -> None:
    inner: Any = network.network
    scores = Scores(inner, len(names) - 1, groups)
    fixed = inner.image_size
    described = TrainedNetwork(
        network=scores,
        class_names=tuple(names),
        inputs=("rgb",),
        normalization=network.normalization,
        level=seen["level"],
        representation=seen,
        image_size=(seen["dim"], seen["dim"]),
        size_multiple=1 if fixed else size_multiple_of(scores, 3) or 1,
        fixed_size=fixed,
        groups=groups,
    )
    write_metadata(inner.path, path, metadata_json(described))
