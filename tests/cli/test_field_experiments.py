"""Every experiment ``field/…``: it has the facts of its protocol, trains and is evaluated."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from tangent_train.cli.compose import config_folder
from tangent_train.cli.run import build, build_data
from tangent_train.results.published import facts, protocols
from tests.cli.tiny_runs import Run, results
from tests.field_worlds import WORLDS, World
from tests.running import composed, composed_settings

SMALL = ("trainer.max_epochs=1", "trainer.accelerator=cpu", "data.num_workers=0")
FIELD = sorted(
    f"field/{path.stem}" for path in (config_folder() / "experiment" / "field").glob("*.yaml")
)
PROTOCOLS = {
    entry["experiment"]: name for name, entry in protocols().items() if "experiment" in entry
}


def _with_a_small_network(experiment: str) -> list[str]:
    """Arguments of an experiment with another network and no other settings of a network."""
    arguments = [f"experiment={experiment}", "network=unet_small"]
    removed = (
        composed("train", *arguments).network.keys()
        - composed("train", arguments[1]).network.keys()
    )
    return [*arguments, "network.widths=[4,8]", *(f"~network.{name}" for name in removed)]


def _data_set(settings: dict[str, Any]) -> str:
    return str(settings["data"]["_target_"]).rpartition(".")[2]


@pytest.fixture(scope="session")
def worlds(tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[World, Path]]:
    """The worlds with their folders; not to be changed."""
    folder = tmp_path_factory.mktemp("field")
    return {name: (world, world.write(folder / name)) for name, world in WORLDS.items()}


@pytest.mark.parametrize("experiment", FIELD)
def test_an_experiment_of_the_field_follows_its_protocol(
    experiment: str, worlds: dict[str, tuple[World, Path]], run: Run, tmp_path: Path
) -> None:
    """At its full size by its settings, and in a small run that is trained and evaluated."""
    protocol = facts(PROTOCOLS[experiment])
    arguments = _with_a_small_network(experiment)
    settings = composed_settings("train", *arguments)
    world, root = worlds[_data_set(settings)]
    settings["data"]["root"] = root
    data, task = build(settings)
    assert {**data.facts, **task.facts} == protocol
    run("train", *arguments, f"data.root={root}", *SMALL, *world.small)
    (folder,) = (tmp_path / "runs").glob("field/*/*")
    found = results(folder)["protocol"]
    assert found.pop("size") != protocol.pop("size")
    assert found == protocol
    settings["data"] |= {"mask": -60, "test_rotation": "so3"}
    changed = {"mask": "-60", "test_rotation": "so3"}
    assert build_data(settings).facts == data.facts | changed, "as it is, not as it is named"
