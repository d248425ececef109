"""``tangent-evaluate``: evaluate a checkpoint on the test fold of its data."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from tangent_train.checkpoints.loaded import LoadedNetwork, load_network
from tangent_train.cli.command_settings import EvaluateSettings
from tangent_train.cli.run import Run, machine_faults
from tangent_train.cli.settings import parse_settings
from tangent_train.cli.stored import run_settings
from tangent_train.config.build import SettingsFile


def evaluate(
    settings: Mapping[str, Any],
    source: SettingsFile | None = None,
    trained: LoadedNetwork | None = None,
) -> None:
    """Evaluate a checkpoint on the test fold of its data.

    Args:
        settings: Settings of the run, and ``checkpoint``, ``label_map`` and ``unmapped``. A stage
            of a transfer may lack the last two.
        source: File that settings come from, see `build_from_config`.
        trained: Network of a file without settings of a run, if it has been loaded.

    Raises:
        SettingError: The checkpoint does not fit the data.
    """
    checkpoint = parse_settings(EvaluateSettings, settings).checkpoint
    mapped = settings.get("label_map") is not None
    if not mapped:
        settings = {name: value for name, value in settings.items() if name != "unmapped"}
    if trained is None and (mapped or run_settings(checkpoint) is None):
        trained = load_network(checkpoint, settings.get("trust", ()))
    run = Run.create(settings, source, trained, trains=False)
    with machine_faults(run.folder, run.data):
        run.test(run.trainer([]), checkpoint)
