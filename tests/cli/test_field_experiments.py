"""Every experiment ``field/…``: it has the facts of its protocol, trains and is evaluated."""

from __future__ import annotations

import re
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from hydra.core.global_hydra import GlobalHydra
from hydra.core.singleton import Singleton

from datamodules.cityscapes.classes import CLASSES
from tangent_train.cli import transfer_stages
from tangent_train.cli.run import build, build_data
from tangent_train.files import config_folder
from tangent_train.results.published import facts, protocols
from tests.cli.tiny_runs import Run, results
from tests.field_worlds import WORLDS, World
from tests.running import ROOT, Patch, command_of, composed, composed_settings

SMALL = ("trainer.max_epochs=1", "trainer.accelerator=cpu", "data.num_workers=0", "panels=0")
SMALL_PHOTOS = ("photos.data.num_workers=0",)
PROTOCOLS = {
    entry["experiment"]: name
    for name, entry in protocols().items()
    if entry.get("experiment", "").startswith("field/")
}
FILES = {f"field/{path.stem}" for path in (config_folder() / "experiment/field").glob("*.yaml")}

Worlds = dict[str, tuple[World, Path]]


@pytest.fixture(scope="session")
def worlds(tmp_path_factory: pytest.TempPathFactory) -> Worlds:
    """The worlds with their folders; not to be changed."""
    folder = tmp_path_factory.mktemp("field")
    return {name: (world, world.write(folder / name)) for name, world in WORLDS.items()}


def _world(worlds: Worlds, section: dict[str, Any]) -> tuple[World, Path]:
    return worlds[str(section["_target_"]).rpartition(".")[2]]


def _with_a_small_network(command: str, experiment: str) -> list[str]:
    """Arguments of an experiment with another network and no other settings of a network."""
    arguments = [f"experiment={experiment}", "network=unet_small"]
    small = composed(command, arguments[1]).network.keys()
    removed = composed(command, *arguments).network.keys() - small
    return [*arguments, "network.widths=[4,8]", *(f"~network.{name}" for name in removed)]


def test_every_experiment_of_the_field_has_a_protocol_and_is_documented() -> None:
    page = (ROOT / "docs" / "how-to" / "field_benchmarks.md").read_text()
    assert PROTOCOLS.keys() == FILES == set(re.findall(r"(?<=`)field/\w+(?=`)", page))


@pytest.mark.parametrize("experiment", sorted(PROTOCOLS))
def test_an_experiment_of_the_field_follows_its_protocol(
    experiment: str, worlds: Worlds, run: Run, tmp_path: Path, monkeypatch: Patch
) -> None:
    """At its full size by its settings, and in a small run that is trained and evaluated."""
    protocol = facts(PROTOCOLS[experiment])
    command = command_of(experiment)
    transfers = command == "transfer"
    arguments = _with_a_small_network(command, experiment)
    settings = composed_settings(command, *arguments)
    world, root = _world(worlds, settings["data"])
    settings["data"]["root"] = root
    data, task = build(settings)
    assert {**data.facts, **task.facts} == protocol
    settings["data"] |= {"mask": -60, "test_rotation": "so3"}
    changed = {"mask": "-60", "test_rotation": "so3"}
    assert build_data(settings).facts == data.facts | changed, "as it is, not as it is named"
    arguments += [f"data.root={root}", *SMALL, *world.small]
    if transfers:
        _, photos = _world(worlds, settings["photos"]["data"])
        arguments += [f"photos.data.root={photos}", *SMALL_PHOTOS, "photos.data.photos_per_step=2"]
        monkeypatch.setattr(transfer_stages, "run_process", _in_this_process(run))
    run(command, *arguments)
    (path,) = (tmp_path / "runs").rglob("S/results.json" if transfers else "results.json")
    found = results(path.parent)["protocol"]
    assert found.pop("size") != protocol.pop("size")
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
    settings |= settings["photos"] if name == "paper_photos" else {}
    protocol = facts(name)
    assert settings["task"].get("absent_class") == protocol.pop("absent_class", None)
    assert protocol.pop("weighting", "pixels") == "pixels"
    assert build_data(settings).facts == protocol


def test_an_imported_network_is_evaluated_on_photos_and_panoramas(
    worlds: Worlds, run: Run, tmp_path: Path, monkeypatch: Patch
) -> None:
    from tests.inference.photo_networks import huggingface_networks as networks

    size = {"height": 32, "width": 32}
    networks.saved(partial(networks.segformer, CLASSES), tmp_path / "segformer", size=size)
    run("import", "network=huggingface", "model=segformer", "output=segformer.ckpt")
    monkeypatch.setattr(transfer_stages, "run_process", _in_this_process(run))
    experiment = "field/cityscapes_densepass_13"
    (_, panoramas), (_, photos) = worlds["DensePASS"], worlds["Cityscapes"]
    arguments = [f"data.root={panoramas}", f"photos.data.root={photos}", "level=6", *SMALL_PHOTOS]
    arguments += [f"experiment={experiment}", "checkpoint=segformer.ckpt", *SMALL[1:]]
    run("transfer", *arguments, "class_map=cityscapes_to_densepass13")
    folder = tmp_path / "runs" / "transfer" / experiment / "seed_0"
    assert {path.name for path in folder.iterdir()} == {"P", "S"}
    assert not list(folder.glob("*/checkpoints"))
    found, protocol = results(folder / "S"), facts(PROTOCOLS[experiment])
    assert found["protocol"] == protocol | {"size": "256 × 128"}
    assert found["class_map"] == "cityscapes_to_densepass13"
    report = (folder.parent / "transfer.md").read_text()
    assert "Trans4PASS+ (S), trained on Cityscapes: 51.4 and" in report


def _in_this_process(run: Run) -> Any:
    """Run a stage of a transfer, which is within Hydra, without starting a process."""

    def run_process(line: Sequence[str]) -> int:
        state = Singleton.get_state()
        GlobalHydra.instance().clear()
        run(*line[3:])
        Singleton.set_state(state)
        return 0

    return run_process
