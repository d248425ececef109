"""``tangent-evaluate``: evaluate a network from a file on the test fold of a data set."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import lightning
import numpy as np
from hydra.core.hydra_config import HydraConfig
from hydra.utils import get_class
from lightning.pytorch.utilities import rank_zero_only

from datamodules.core.label_map import PANOPTIC
from tangent_train.checkpoints.loaded import LoadedNetwork, load_network
from tangent_train.cli import main
from tangent_train.cli.run import Run, build_data, build_head, build_task
from tangent_train.cli.scored_files import score_files
from tangent_train.config.build import build_from_config
from tangent_train.config.settings import EvaluateSettings, refuse_typed
from tangent_train.errors import SettingError, check_choice, listed
from tangent_train.inference.api import load_label_map, map_classes
from tangent_train.inference.engine import Predictor
from tangent_train.inference.images import InputImage, read_panorama
from tangent_train.inference.views import ViewSelector, check_size, panorama_settings
from tangent_train.io.jobs import Inputs
from tangent_train.progress import show_progress


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
    if settings.input is not None:
        refuse_typed(("data", "experiment", "panels"), "nothing: input= has no labels")
    checkpoint: Any = settings.checkpoint
    loaded = load_network(checkpoint, settings.trust)
    loaded = loaded.prompted(settings.prompts, settings.threshold)
    remedy = "Choose the task of the network: task=segmentation, depth or classification."
    head: Any = get_class(settings.task["head"]["_target_"])
    loaded.check_predicts(head.kind, remedy)
    settings = settings.model_copy(update=_of_network(settings, loaded))
    data, notes = build_data(settings) if settings.input is None else None, []
    if settings.label_map is not None:
        label_map, targets = load_label_map(settings.label_map), data and data.class_names[1:]
        mapped = map_classes(loaded, label_map, settings.unmapped, targets)
        loaded, notes = mapped.loaded, [f"Label map {settings.label_map}: {mapped.description}."]
    data = data or _unlabeled(settings, loaded)
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
    if settings.consistency or settings.input is not None:
        head.consistency = rank_zero_only(_rotated)(settings, loaded, head, data) or {}
    task = build_task(settings, data, loaded.network, head)
    run = Run(folder, settings, data, task, loaded, notes)
    rank_zero_only(run.write_settings)()
    if settings.input is None:
        run.test(run.trainer(), checkpoint)
    else:
        task.result = None
        run.report(checkpoint, range(len(data.splits()["test"])), ())


def _unlabeled(settings: EvaluateSettings, loaded: LoadedNetwork) -> Any:
    """Return what takes the place of a data set for panoramas without labels."""
    inputs = Inputs.find(str(settings.input))
    jobs = list(inputs.jobs(inputs.names))
    return SimpleNamespace(
        noun="panoramas" + " without depth" * ("depth" in loaded.inputs), labels="",
        splits=lambda: {"test": jobs}, groups=lambda _: (), folds=(),
        facts={"data": str(settings.input)}, class_names=loaded.class_names,
        representation=build_from_config(settings.representation or {}, "representation"),
    )  # fmt: skip


def _rotated(settings: EvaluateSettings, loaded: LoadedNetwork, head: Any, data: Any) -> Any:
    """Return the scores of `Predictor.consistency` of all panoramas, arrays by name."""
    check_choice("data, with consistency=", data.noun, ("panoramas",))
    items = data.splits()["test"]
    if settings.input is None:
        read = map(data.dataset("test").read, range(len(items)))
        images = (InputImage(i.rgb, i.depth, i.up, area=data.canvas) for i in read)
    else:
        images = (read_panorama(job.value or job.path) for job in items)
    views, rng = ViewSelector(loaded), np.random.default_rng(settings.seed)
    views.representation = data.representation
    predictor, found = Predictor(loaded, head, views, "auto"), list[dict[str, float]]()
    scores = (predictor.consistency(i, settings.consistency or 8, rng) for i in images)
    show_progress(map(found.append, scores), "Rotating", "panoramas", len(items))
    return {name: np.array([of_image[name] for of_image in found]) for name in found[0]}


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
    data = settings.data if settings.input is None else {"_target_": "panoramas"}
    if loaded.inputs:
        data = {**data, **loaded.data_settings}
    network = loaded.settings
    return {"level": level, "representation": section, "data": data, "network": network}


if __name__ == "__main__":
    main.evaluate()
