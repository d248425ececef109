"""``tangent-evaluate``: evaluate a network from a file on the test fold of a data set."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import lightning
from hydra.core.hydra_config import HydraConfig
from hydra.utils import get_class
from lightning.pytorch.utilities import rank_zero_only

from datamodules.core.label_map import PANOPTIC
from tangent_train.checkpoints.loaded import LoadedNetwork, load_network
from tangent_train.cli import main
from tangent_train.cli.run import Run, build_data, build_head, build_task
from tangent_train.cli.scored_files import OF_FILES, score_files
from tangent_train.config.settings import EvaluateSettings, refuse_typed
from tangent_train.errors import SettingError, listed
from tangent_train.inference.api import load_label_map, map_classes
from tangent_train.inference.views import check_size, panorama_settings


def evaluate(settings: EvaluateSettings) -> None:
    """Evaluate a network on the test fold of the data, and write the results.

    Raises:
        SettingError: The network does not fit the data, or nothing reads a typed setting.
    """
    folder = Path(HydraConfig.get().runtime.output_dir)
    _refuse_folder_of_run(folder)
    lightning.seed_everything(settings.seed, workers=True, verbose=False)
    if settings.predictions is not None:
        score_files(settings, folder)
        return
    refuse_typed(OF_FILES, "nothing: it is read with predictions=")
    checkpoint = settings.checkpoint
    if checkpoint is None:
        expected = "a network, or predictions=<folder>"
        raise SettingError("checkpoint", found="null", expected=expected)
    loaded = load_network(checkpoint, settings.trust)
    remedy = "Choose the task of the network: task=segmentation, depth or classification."
    head: Any = get_class(settings.task["head"]["_target_"])
    loaded.check_predicts(head.kind, remedy)
    settings = settings.model_copy(update=_of_network(settings, loaded))
    data, notes = build_data(settings), []
    if settings.label_map is not None:
        label_map = load_label_map(settings.label_map)
        mapped = map_classes(loaded, label_map, settings.unmapped, data.class_names[1:])
        loaded, notes = mapped.loaded, [f"Label map {settings.label_map}: {mapped.description}."]
    if loaded.class_names != tuple(data.class_names):
        raise SettingError(
            f"data, for {settings.checkpoint}",
            found=f"classes {listed(data.class_names)}",
            expected=f"{listed(loaded.class_names)}, which the network was trained with",
            remedy="Map classes with label_map=.",
        )
    if head.labels == PANOPTIC and not {*loaded.things} & {*data.things}:
        found, expected = "a network without objects", "objects of " + " or ".join(data.things)
        raise SettingError("checkpoint", found=found, expected=expected)
    if loaded.inputs:  # images, not shapes
        check_size(loaded, data.representation.image_size)
    head = build_head(settings, data, loaded.depth_kind)
    task = build_task(settings, data, loaded.network, head)
    run = Run(folder, settings, data, task, loaded, notes)
    rank_zero_only(run.write_settings)()
    run.test(run.trainer(), checkpoint)


@rank_zero_only
def _refuse_folder_of_run(folder: Path) -> None:
    """Refuse a folder with the settings of a run: they would be overwritten."""
    if (folder / "config.yaml").exists():
        found = f"{folder}, the folder of another run"
        raise SettingError("hydra.run.dir", found=found, expected="a new folder")


def _of_network(settings: EvaluateSettings, loaded: LoadedNetwork) -> dict[str, Any]:
    """Return the settings that come from the file: views, level, inputs and normalization."""
    level, section = settings.level or loaded.level, settings.representation or {}
    if "_target_" not in section:  # changes of the views of the file
        stored = {} if settings.level is None else panorama_settings(loaded, level)
        section = {**loaded.representation, **stored, **section}
    if section.get("level", 0) is None:
        section = {**section, "level": level}
    data = settings.data
    if loaded.inputs:
        mean, std = list(loaded.normalization.mean), list(loaded.normalization.std)
        normalization = {"mean": mean, "std": std}
        data = {**data, "inputs": list(loaded.inputs), "normalization": normalization}
    network = loaded.settings
    return {"level": level, "representation": section, "data": data, "network": network}


if __name__ == "__main__":
    main.evaluate()
