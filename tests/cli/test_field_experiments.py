"""Every experiment ``field/…``: it has the facts of its protocol, trains and is evaluated."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from tangent_train.cli.run import build, build_data
from tangent_train.files import config_folder
from tangent_train.results.published import facts, protocols
from tests.cli.tiny_runs import Run, results
from tests.conftest import fabricate
from tests.datamodules.matterport_format import write_matterport
from tests.datamodules.street_format import (
    write_cityscapes,
    write_densepass,
    write_synpass,
)
from tests.datamodules.structured3d_format import write_structured3d
from tests.running import ROOT, command_of, composed_settings

WRITERS: Mapping[str, Callable[[Path], Path]] = {
    "Cityscapes": write_cityscapes,
    "DensePASS": partial(write_densepass, names=(1,)),
    "Matterport360": write_matterport,
    "Stanford2D3DS": fabricate,
    "Stanford2D3DSPerspective": partial(fabricate, photos=2),
    "Structured3D": write_structured3d,
    "SynPASS": write_synpass,
}
"""Functions that write small files, by the class of the data set."""

SMALL = (
    *("network=unet_small", "network.widths=[4,8]"),
    *("trainer.max_epochs=1", "trainer.accelerator=cpu", "data.num_workers=0", "panels=0"),
)
SIZES = {"DensePASS": ("level=6", "photos.representation.dim=[16,32]")}
SIZE = ("level=4", "representation.erp_height=32")
PROTOCOLS = {
    entry["experiment"]: name
    for name, entry in protocols().items()
    if entry.get("experiment", "").startswith("field/")
}
TRAINED = {
    f"field/{name}"
    for name in (
        *("cityscapes_densepass", "matterport360_sfss", "stanford2d3ds_depth"),
        *("stanford2d3ds_span8", "structured3d_s3d8", "synpass"),
    )
}
"""One of every data set and task."""
FILES = {f"field/{path.stem}" for path in (config_folder() / "experiment/field").glob("*.yaml")}


@pytest.fixture(scope="session")
def folders(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Folders of small data sets by their classes; not to be changed."""
    folder = tmp_path_factory.mktemp("field")
    return {name: write(folder / name) for name, write in WRITERS.items()}


def _class_of(section: Mapping[str, Any]) -> str:
    return str(section["_target_"]).rpartition(".")[2]


def test_every_experiment_of_the_field_has_a_protocol_and_is_documented() -> None:
    page = (ROOT / "docs" / "reference" / "protocols.md").read_text()
    assert PROTOCOLS.keys() == FILES == set(re.findall(r"(?<=`)field/\w+(?=`)", page))


@pytest.mark.usefixtures("stages")
@pytest.mark.parametrize("experiment", sorted(PROTOCOLS))
def test_an_experiment_of_the_field_follows_its_protocol(
    experiment: str, folders: dict[str, Path], run: Run, tmp_path: Path
) -> None:
    """At its full size by its settings; one of a data set also in a small run."""
    protocol = facts(PROTOCOLS[experiment])
    command = command_of(experiment)
    arguments = [f"experiment={experiment}", *SMALL]
    settings = composed_settings(command, *arguments)
    name = _class_of(settings.data)
    section = settings.data | {"root": str(folders[name])}
    data, task = build(settings.model_copy(update={"data": section}))
    assert {**data.facts, **task.head.facts} == protocol
    if experiment not in TRAINED:
        return
    arguments += [f"data.root={folders[name]}", *SIZES.get(name, SIZE)]
    if command == "transfer":
        photos = folders[_class_of(settings.photos.data)]
        arguments += [f"photos.data.root={photos}", "photos.data.num_workers=0"]
        arguments += ["photos.data.batch_size=2"]
    run(command, *arguments)
    pattern = "S/results.json" if command == "transfer" else "results.json"
    (path,) = (tmp_path / "runs").rglob(pattern)
    found = results(path.parent)["protocol"]
    assert found.pop("size") != protocol.pop("size")
    found.pop("images", None)  # fewer than published
    found.pop("views_aligned", None)  # of the method
    assert found == protocol


OF_THE_PAPER = [
    (name, entry["experiment"])
    for name, entry in protocols().items()
    if entry.get("experiment", "").startswith("paper/")
]


@pytest.mark.parametrize(
    ("name", "experiment"), [*OF_THE_PAPER, ("paper_512", "paper/transfer_stanford")]
)
def test_experiments_of_the_paper_have_the_facts_of_its_scores(name: str, experiment: str) -> None:
    settings = composed_settings(command_of(experiment), f"experiment={experiment}")
    if name == "paper_photos":
        settings = settings.model_copy(update=dict(settings.photos))
    protocol = facts(name)
    assert settings.task["head"].get("absent_class") == protocol.pop("absent_class", None)
    assert protocol.pop("weighting", "pixels") == "pixels"
    assert build_data(settings).facts == protocol
