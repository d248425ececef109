"""Refuse paths of a command before its libraries are imported, which takes seconds."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from tangent_train.config.settings import PredictSettings, RenderSettings, Settings
from tangent_train.errors import SettingError
from tangent_train.files import check_new
from tangent_train.io.image_files import input_paths
from tangent_train.manifest import check_continues

_STORED_OTHERWISE = ("checkpoint", "level", "write")
"""Settings of which a manifest holds a digest, or values that replace null."""


def check_paths(settings: Settings) -> None:
    """Refuse missing inputs, and outputs that exist or were written with other settings.

    Raises:
        DataError: There are no images or videos.
        SettingError: A file is missing, or an output cannot be used.
    """
    values: dict[str, Any] = dict(settings)
    start, output = values.get("init_from"), values.get("output")
    if start is not None and values["resume"] is None and not start.exists():
        raise SettingError("init_from", found=start, expected="an existing file")
    if isinstance(settings, PredictSettings | RenderSettings) and values["input"] is not None:
        input_paths(values["input"])
    for path in filter(None, (output, values.get("figure"))):
        if "overwrite" in values and Path(path).is_file():
            check_new(path, overwrite=values["overwrite"])
    if isinstance(settings, PredictSettings | RenderSettings) and output and not output.is_file():
        content = settings.model_dump(mode="json", exclude={*settings.not_content})
        check_continues(output, content, _STORED_OTHERWISE)
