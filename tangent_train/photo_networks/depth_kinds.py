"""Find which kind of depth a photo network returns, and try it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import islice
from pathlib import Path
from typing import Any, get_args

import torch

from tangent_train.checkpoints.kinds import DepthKind
from tangent_train.errors import DataError, SettingError
from tangent_train.photo_networks.network import PhotoNetwork
from tangent_train.photo_networks.score_kinds import trial_images, trial_output

_METRIC: Sequence[DepthKind] = "metric_z", "metric_distance"
_RELATIVE: Sequence[DepthKind] = "relative_disparity", "relative_depth"
_FAMILIES: dict[str, Sequence[DepthKind]] = {
    "depth_pro": ("canonical_inverse",),
    "metric": _METRIC,  # Depth Anything: its depth_estimation_type
    "relative": _RELATIVE,
    "glpn": _METRIC,
    "tipsv2_dpt": _METRIC,
    "zoedepth": _METRIC,
}
"""Possible kinds of networks in transformers, the usual one first."""

_REFUSED = {
    "chmv2": "heights of trees in aerial images, which are not distances from the camera",
    "prompt_depth_anything": "depth that continues the depth image of a sensor, a second input",
}

_NAMES = (
    "Set depth=, e.g. relative_disparity for MiDaS and its DPT (Intel/dpt-large), metric_z for "
    "networks trained on the meters of NYU or KITTI."
)
_FARTHEST_M = 1000.0
_SPREAD = 1e-3
"""Least difference of depths at noise and plain images, relative to their largest value."""


def declared_kind(config: Mapping[str, Any], path: Path, given: DepthKind | None) -> DepthKind:
    """Return the kind of depth of a network of transformers.

    Args:
        config: Content of its ``config.json``.
        path: That file, for messages.
        given: The user's setting ``depth``, which must not contradict the config.

    Raises:
        DataError: The network returns something else, or needs another input.
        SettingError: The config does not determine the kind, or contradicts `given`.
    """
    name = str(config.get("model_type"))
    if name == "depth_anything":
        name = str(config.get("depth_estimation_type", "relative"))
    if name in _REFUSED:
        raise DataError(path, found=f"{name}: {_REFUSED[name]}", expected="depth of photos")
    kinds = _FAMILIES.get(name, ())
    if given is None and not kinds:
        expected = f"one of {', '.join(get_args(DepthKind))}, which {path} does not contain"
        raise SettingError("depth", found="none", expected=expected, remedy=_NAMES)
    if given is not None and kinds and given not in kinds:
        expected = f"{' or '.join(kinds)}, because {path} has {name}"
        raise SettingError("depth", found=given, expected=expected)
    return given or kinds[0]


@torch.no_grad()
def try_depth(network: PhotoNetwork) -> list[str]:
    """Run a depth network on a black, a white and a random image.

    Args:
        network: The network; in evaluation mode afterwards.

    Returns:
        A sentence for everything that looks wrong.

    Raises:
        SettingError: The network does not take RGB images of its size, or returns something other
            than one finite number per pixel.
    """
    network.network.eval()
    kind = network.depth_kind
    depth = torch.cat([trial_output(network, image) for image in islice(trial_images(network), 3)])
    known = depth[depth.isfinite()]
    if depth.shape[1] != 1 or not len(known):
        raise SettingError(
            "output of the network",
            found=f"{depth.shape[1]} per pixel, {len(known)} of {depth.numel()} numbers are finite",
            expected=f"one finite number per pixel, {kind}",
            remedy="Leave out depth= for classes. Weights that contain NaN return no numbers.",
        )
    least, most = known.amin().item(), known.amax().item()
    noise = _SPREAD * max(abs(least), abs(most))
    odd = {
        "nearly the same depth everywhere": most - least <= noise,
        f"negative numbers, unusual for {kind}": least < -noise and kind != "log_distance",
        "depth of more than 1 km": most > _FARTHEST_M and kind in _METRIC,
    }
    numbers = f"from {least:.4g} to {most:.4g} on images of noise"
    return [f"it returns {what}, {numbers}" for what, is_so in odd.items() if is_so]
