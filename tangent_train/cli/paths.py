"""Refuse paths of a command before its libraries are imported, which takes seconds."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from tangent_train.config.help import option_comments
from tangent_train.config.settings import PredictSettings, RenderSettings, Settings
from tangent_train.errors import SettingError
from tangent_train.files import check_new, config_folder, label_map_file
from tangent_train.io.image_files import input_paths
from tangent_train.manifest import check_continues

_STORED_OTHERWISE = ("checkpoint", "level", "write")
"""Settings of which a manifest holds a digest, or values that replace null."""


def check_paths(settings: Settings) -> None:
    """Refuse missing inputs, and outputs that exist or were written with other settings.

    Raises:
        DataError: There are no images or videos.
        SettingError: A file or folder is missing, or an output cannot be used.
    """
    values: dict[str, Any] = dict(settings)
    start, output = values.get("init_from"), values.get("output")
    if start is not None and values["resume"] is None and not start.exists():
        raise SettingError("init_from", found=start, expected="an existing file")
    label_map = values.get("label_map")
    if label_map is not None and not label_map_file(label_map).exists():
        raise SettingError("label_map", found=label_map, expected="an existing file")
    data = values.get("data") or {}
    target, root = str(data.get("_target_")), Path(str(data.get("root")))
    is_generated = not {"rooms", "shapes"}.isdisjoint(data)
    if target.startswith("datamodules.") and not is_generated and not root.is_dir():
        expected = f"a {option_comments(config_folder()).get((target, 'root'), 'folder')}"
        raise SettingError("data.root", found=f"{root}, no such folder", expected=expected)
    if isinstance(settings, PredictSettings | RenderSettings) and values["input"] is not None:
        input_paths(values["input"])
    if "overwrite" in values and output and output.is_file():
        check_new(output, overwrite=values["overwrite"])
    if isinstance(settings, PredictSettings | RenderSettings) and output and not output.is_file():
        content = settings.model_dump(mode="json", exclude={*settings.not_content})
        check_continues(output, content, _STORED_OTHERWISE)
