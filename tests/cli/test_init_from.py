"""Networks and tensors that a run takes from another file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from hydra.core.hydra_config import HydraConfig

from datamodules.core.inputs import RGBD_NORMALIZATION, Normalization
from tangent_train.checkpoints.loaded import load_network
from tangent_train.cli.pretrained import with_pretrained_network
from tangent_train.cli.run import build
from tangent_train.config.build import build_from_config
from tangent_train.config.settings import validate
from tangent_train.errors import DataError
from tangent_train.inference.export import export_network
from tangent_train.photo_networks import PhotoNetwork, import_network
from tests.cli.tiny_runs import SETTINGS, Run, results
from tests.running import Capture, Patch, composed
from tests.tasks.small_networks import with_statistics

IMAGENET = {"mean": [0.485, 0.456, 0.406], "std": [0.229, 0.224, 0.225]}
UNET = {"_target_": "models.UNet", "in_channels": 3, "num_classes": 21, "widths": [4, 8, 12]}


def _write_imported(path: Path, classes: int, **stated: Any) -> Path:
    """Write a network with random numbers as `tangent-import` does."""
    torch.manual_seed(3)
    settings = UNET | {"num_classes": classes}
    network: Any = with_statistics(build_from_config(settings, "network"))
    names = [f"thing {number}" for number in range(classes)]
    normalization = Normalization.of("imagenet", 3)
    photo = PhotoNetwork(network, settings, names, normalization, (64, 64))
    import_network(photo, path, levels=6, **stated)
    return path


@pytest.fixture
def imported(tmp_path: Path) -> Path:
    return _write_imported(tmp_path / "net.ckpt", 21)


def _begun(monkeypatch: Patch, path: Path, *overrides: str) -> tuple[Any, Any]:
    """Return the settings of a command line with ``init_from``, and the file of the network."""
    config = composed("train", "level=5", *overrides, return_hydra_config=True)
    monkeypatch.setattr(HydraConfig, "get", lambda: config.hydra)
    plain: Any = {name: config[name] for name in config if name != "hydra"}
    return with_pretrained_network(path, validate("train", plain))


def test_a_network_that_returns_probabilities_is_not_trained(
    tmp_path: Path, monkeypatch: Patch
) -> None:
    path = _write_imported(tmp_path / "net.ckpt", 21, score_kind="probabilities")
    with pytest.raises(DataError, match="returns probabilities; expected logits"):
        _begun(monkeypatch, path)
    settings, file = _begun(monkeypatch, path, "network=unet_small")
    assert (settings.network["_target_"], file) == ("models.UNet", None)


@pytest.mark.parametrize(
    ("overrides", "widths"),
    [
        (["experiment=rooms/demo"], [4, 8, 12]),
        (["network=unet_small"], [16, 32, 64, 128, 256]),
        (["network.widths=[4,4]"], [4, 4]),
    ],
)
def test_the_network_is_the_file_s_unless_one_is_typed(
    overrides: list[str], widths: list[int], imported: Path, tmp_path: Path, monkeypatch: Patch
) -> None:
    export_network(load_network(imported), tmp_path / "net.safetensors")
    for path in (imported, tmp_path / "net.safetensors"):
        settings, file = _begun(monkeypatch, path, *overrides, "data.inputs=[rgb]")
        assert settings.network["widths"] == widths
        assert settings.data["normalization"] == IMAGENET
        assert file == (path if widths == UNET["widths"] else None)
        _, task = build(settings, file)
        assert task(torch.zeros(1, 3, 32, 32))["out"].shape == (1, 13, 32, 32)


def test_depth_is_added_to_a_network_for_photos(imported: Path, monkeypatch: Patch) -> None:
    settings, _ = _begun(monkeypatch, imported)
    assert settings.network == UNET | {"in_channels": None, "num_classes": None}
    mean, std = RGBD_NORMALIZATION.mean[3], RGBD_NORMALIZATION.std[3]
    expected = {"mean": [*IMAGENET["mean"], mean], "std": [*IMAGENET["std"], std]}
    assert settings.data["normalization"] == expected


def test_files_that_do_not_describe_their_network_change_nothing(
    imported: Path, tmp_path: Path, monkeypatch: Patch
) -> None:
    tensors = torch.load(imported, weights_only=True)["state_dict"]
    torch.save(tensors, tmp_path / "state.pt")
    settings, file = _begun(monkeypatch, tmp_path / "state.pt")
    assert settings.network["widths"] == [16, 32, 64, 128, 256, 256]
    assert file is None


def test_fine_tuning_leaves_a_run_of_its_own(
    tmp_path: Path, rooms: str, run: Run, capsys: Capture
) -> None:
    """Here with the data's number of classes, but of other names."""
    path = _write_imported(tmp_path / "net.ckpt", 13)
    typed = [text for text in SETTINGS if "network" not in text]
    tuned = ["data.inputs=[rgb]", "trainer.max_epochs=1", "task.frozen=[stem,downs]"]
    slower = ["task.backbone_lr_factor=0.1", "scheduler=constant", f"init_from={path}"]
    run("train", *typed, rooms, *tuned, *slower, "hydra.run.dir=tuned")
    assert "  of other classes in the file: head.weight, head.bias\n" in capsys.readouterr().out
    before = torch.load(path, weights_only=True)["state_dict"]
    path.unlink()
    run("train", "resume=tuned", "trainer.max_epochs=2")
    checkpoint = tmp_path / "tuned" / "checkpoints" / "best.ckpt"
    content = torch.load(checkpoint, weights_only=True)
    assert content["fresh"] == ["head.bias", "head.weight"]
    for name, tensor in before.items():
        frozen = name.startswith(("network.stem.", "network.downs."))
        assert not frozen or torch.equal(tensor, content["state_dict"][name])
    assert load_network(checkpoint).normalization == Normalization.of("imagenet", 3)
    data = [text for text in SETTINGS if text.startswith("data.")]
    run(
        "evaluate",
        f"checkpoint={checkpoint}",
        "data=synthrooms",
        *data,
        rooms,
        "hydra.run.dir=again",
    )
    assert results(tmp_path / "again") == results(tmp_path / "tuned")
