"""Networks of prior methods train, resume, are evaluated and exported, as typed.

A new network is a row of `NETWORKS`; `tests/slow/cli/test_networks.py` then leaves it out.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
import torch
import yaml  # type: ignore[import-untyped]

from tangent_train.cli.run import build
from tests.cli.tiny_runs import SMALL_ROOMS, results, run_in
from tests.running import ROOT, composed_settings


class PriorMethod(NamedTuple):
    """A network of the config tree.

    Attributes:
        settings: Settings that make it small.
        representation: Class of the representation that it chooses.
        has_onnx: True if it can be written as an ONNX file; False if that is refused.
        package: Package that it needs.
    """

    settings: tuple[str, ...] = ()
    representation: str = "IcosphereRepresentation"
    has_onnx: bool = True
    package: str = "torch"


_NARROW = ("network.widths=[4,8,8]",)
NETWORKS = {
    **dict.fromkeys(
        ("spherical_unet", "spherical_segformer", "sfno"),
        PriorMethod((), "EquirectRepresentation", has_onnx=False, package="torch_harmonics"),
    ),
    "ugscnn": PriorMethod(_NARROW),
    "hexrunet": PriorMethod(_NARROW),
    "spherephd": PriorMethod(_NARROW),
    "icocnn": PriorMethod(_NARROW),
    "spherenet_icosphere": PriorMethod(_NARROW),
    "spherenet_unet": PriorMethod(
        ("network.network.widths=[4,8,8]",), "EquirectRepresentation", has_onnx=False
    ),
}


@pytest.fixture(scope="module")
def rooms(tmp_path_factory: pytest.TempPathFactory) -> tuple[str, ...]:
    """Settings of generated rooms, for the `data` of any command."""
    folder = tmp_path_factory.mktemp("rooms")
    of_data = (text for text in SMALL_ROOMS if text.startswith(("data.rooms.", "trainer.")))
    settings = ("data=synthrooms", f"data.root={folder}/rooms", *of_data)
    read = (text for text in settings if not text.startswith("trainer."))
    run_in(folder, "prepare", *read, "level=4")
    return settings


@pytest.mark.parametrize("name", NETWORKS)
def test_trains_resumes_evaluates_and_exports(
    name: str, rooms: tuple[str, ...], tmp_path: Path
) -> None:
    method = NETWORKS[name]
    pytest.importorskip(method.package)
    small = "level=4", "trainer.max_epochs=1", "scheduler=constant", "hydra.run.dir=run"
    settings = "experiment=rooms/methods", f"network={name}", *rooms, *small, *method.settings
    run_in(tmp_path, "train", *settings)
    config = yaml.safe_load((tmp_path / "run" / "config.yaml").read_text())
    assert config["representation"]["_target_"].endswith(f".{method.representation}")
    last = tmp_path / "run/checkpoints/last.ckpt"
    before = torch.load(last, weights_only=True)["state_dict"]
    run_in(tmp_path, "train", "resume=run", "trainer.max_epochs=2")
    after = torch.load(last, weights_only=True)
    assert after["epoch"] == 1
    same = [n for n, tensor in before.items() if torch.equal(tensor, after["state_dict"][n])]
    assert not [n for n in same if n.startswith("network.")], "tensors that do not learn"

    run_in(tmp_path, "evaluate", f"checkpoint={last}", *rooms, "hydra.run.dir=evaluated")
    expected = np.array(results(tmp_path / "evaluated")["confusion"])
    for suffix in (".safetensors", ".onnx"):
        export = f"checkpoint={last}", f"output=net{suffix}"
        if suffix == ".onnx" and not method.has_onnx:
            with pytest.raises(SystemExit, match=r"A \.safetensors file takes every network"):
                run_in(tmp_path, "export", *export)
            continue
        run_in(tmp_path, "export", *export)
        run_in(tmp_path, "evaluate", f"checkpoint=net{suffix}", *rooms, f"hydra.run.dir={suffix}")
        found = np.array(results(tmp_path / suffix)["confusion"])
        if suffix == ".safetensors":
            np.testing.assert_array_equal(found, expected)
        assert np.abs(found - expected).sum() <= 0.002 * expected.sum()


OF_SHAPES = {
    "torch_harmonics": ("network=zonal_classifier", "network.widths=[4,8]"),
    "torch": ("network=spherical_cnn", "network.widths=[4,8]", "network.bandwidths=[6,4]"),
}
"""Networks for shapes under rotation, by the package that they need."""


@pytest.mark.parametrize("package", OF_SHAPES)
def test_networks_of_shapes_train_resume_and_evaluate(package: str, tmp_path: Path) -> None:
    pytest.importorskip(package)
    data = (
        *("experiment=shapes/default", "data.shapes.train=3", "data.shapes.test=2"),
        *("data.val_fraction=0", "level=4"),
    )
    run = "trainer.max_epochs=1", "scheduler=constant", "hydra.run.dir=run"
    settings = (*data, *OF_SHAPES[package], *run)
    run_in(tmp_path, "train", *settings, "representation=erp")
    run_in(tmp_path, "train", "resume=run", "trainer.max_epochs=2")
    last = tmp_path / "run/checkpoints/last.ckpt"
    run_in(tmp_path, "evaluate", f"checkpoint={last}", *data, "hydra.run.dir=evaluated")
    assert results(tmp_path / "evaluated")["confusion"] == results(tmp_path / "run")["confusion"]
    wrong = "representation=tangent", "hydra.run.dir=refused"
    with pytest.raises(SystemExit, match=r"found 16 × 16 .*representation=erp"):
        run_in(tmp_path, "train", *settings, *wrong)


def test_the_reference_page_lists_every_network_with_its_number_of_parameters() -> None:
    pytest.importorskip("torch_harmonics")
    page = (ROOT / "docs/reference/networks.md").read_text()
    rows = re.findall(r"^\| `(\w+)` \|.*\| `(\w+)`.*\| ([\d,]+) \|$", page, re.MULTILINE)
    assert {name for name, _, _ in rows} == NETWORKS.keys()
    for name, representation, count in rows:
        data = "data=synthrooms", "data.inputs=[rgb,depth]", "level=5"
        settings = composed_settings("train", *data, f"network={name}")
        alone = composed_settings("train", *data, f"representation={representation}")
        assert settings.representation["_target_"] == alone.representation["_target_"]
        _, task = build(settings)
        assert sum(p.numel() for p in task.network.parameters()) == int(count.replace(",", ""))
