"""``tangent-render``: tangent images as files for other programs, and back."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from tangent_train.cli.rendering.back import render_back
from tangent_train.cli.rendering.forward import render_forward
from tangent_train.cli.rendering.settings import BackSettings, ForwardSettings
from tangent_train.errors import SettingError

if TYPE_CHECKING:
    from collections.abc import Mapping

__all__ = ["render"]


def render(settings: Mapping[str, Any]) -> None:
    """Do what ``configs/render.yaml`` says.

    Args:
        settings: The composed settings.

    Raises:
        DataError: A file cannot be used.
        SettingError: A setting cannot work.
    """
    if settings["back"] is not None:
        render_back(BackSettings.of(settings))
    elif settings["input"] is not None:
        render_forward(ForwardSettings.of(settings))
    else:
        raise SettingError(
            "input",
            found="none",
            expected="input=<panoramas>, or back=<results for tangent images>",
        )
