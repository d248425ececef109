"""Networks and tensors that a run takes from another file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import OmegaConf

from datamodules.core.inputs import RGBD_NORMALIZATION, Normalization
from tangent_train.checkpoints.content import read_settings
from tangent_train.checkpoints.loaded import load_network
from tangent_train.cli.pretrained import with_pretrained_network
from tangent_train.cli.run import build
from tangent_train.config.build import build_from_config
from tangent_train.errors import DataError, SettingError
from tangent_train.inference.export import export_network
from tangent_train.photo_networks import PhotoNetwork, import_network
from tests.cli.tiny_runs import SETTINGS, Run, results
from tests.running import Capture, Patch, composed, composed_settings
from tests.tasks.small_networks import with_statistics

IMAGENET = {"mean": [0.485, 0.456, 0.406], "std": [0.229, 0.224, 0.225]}


UNET = {"_target_": "models.UNet", "in_channels": 3, "num_classes": 21, "widths": [4, 8, 12]}


def _write_imported(path: Path, classes: int, **stated: Any) -> Path:
    """Write a network with random numbers as `tangent-import` does."""
    torch.manual_seed(3)
    settings = UNET | {"num_classes": classes}
    network: Any = with_statistics(build_from_config(settings, "network"))
    if stated:
        network.head.weight.data.fill_(0)
        network.head.bias.data.fill_(1 / classes)
    names = [f"thing {number}" for number in range(classes)]
    normalization = Normalization.of("imagenet", 3)
    photo = PhotoNetwork(network, settings, names, normalization, (64, 64))
    import_network(photo, path, levels=6, **stated)
    return path


def test_a_network_that_returns_probabilities_is_not_trained(
    tmp_path: Path, monkeypatch: Patch
) -> None:
    path = _write_imported(tmp_path / "net.ckpt", 21, score_kind="probabilities")
    with pytest.raises(DataError, match=r"returns probabilities; expected scores before a softmax"):
        _begun(monkeypatch, path)
    settings, _ = _begun(monkeypatch, path, "network=unet_small")
    assert settings["network"]["_target_"] == "models.UNet"


@pytest.fixture
def imported(tmp_path: Path) -> Path:
    return _write_imported(tmp_path / "net.ckpt", 21)


def _begun(monkeypatch: Patch, path: Path, *overrides: str) -> tuple[Any, Any]:
    """Return the settings of a command line with ``init_from``, and the file they come from."""
    config = composed("train", "level=5", *overrides, return_hydra_config=True)
    monkeypatch.setattr(HydraConfig, "get", lambda: config.hydra)
    everything: Any = OmegaConf.to_container(config, resolve=False)
    del everything["hydra"]
    settings: Any = OmegaConf.to_container(OmegaConf.create(everything), resolve=True)
    return with_pretrained_network(path, settings)


@pytest.mark.parametrize(
    ("overrides", "widths"),
    [
        (["experiment=rooms/demo"], [4, 8, 12]),
        (["network=unet_small"], [16, 32, 64, 128, 256]),
        (["network.widths=[4,4]"], [4, 4]),
        (["experiment=rooms/demo", "+network.widths=[4,4]"], [4, 4]),
    ],
)
def test_the_network_is_the_file_s_unless_one_is_typed(
    overrides: list[str],
    widths: list[int],
    imported: Path,
    tmp_path: Path,
    monkeypatch: Patch,
    capsys: Capture,
) -> None:
    export_network(load_network(imported), tmp_path / "net.safetensors")
    for path in (imported, tmp_path / "net.safetensors"):
        settings, source = _begun(monkeypatch, path, *overrides, "data.inputs=[rgb]")
        assert settings["network"]["widths"] == widths
        assert settings["data"]["normalization"] == IMAGENET
        taken = widths == UNET["widths"]
        note = f"Network of {path}: models.UNet" if taken else "Network of the config: models.UNet"
        assert note in capsys.readouterr().out
        assert (source is None) != taken
        if source is None:
            continue
        assert [name for name in settings if source.gave(name)] == ["network"]
        _, task = build(settings, source)
        assert task(torch.zeros(1, 3, 32, 32)).shape == (1, 13, 32, 32)


def test_depth_is_added_to_a_network_for_photos(imported: Path, monkeypatch: Patch) -> None:
    settings, _ = _begun(monkeypatch, imported)
    assert settings["network"] == UNET | {"in_channels": None, "num_classes": None}
    mean, std = RGBD_NORMALIZATION.mean[3], RGBD_NORMALIZATION.std[3]
    expected = {"mean": [*IMAGENET["mean"], mean], "std": [*IMAGENET["std"], std]}
    assert settings["data"]["normalization"] == expected


def test_a_network_that_holds_the_file_s_is_kept(imported: Path, monkeypatch: Patch) -> None:
    """As an experiment with cross-image context that starts from a network without."""
    config = composed("train", "level=5", return_hydra_config=True)
    monkeypatch.setattr(HydraConfig, "get", lambda: config.hydra)
    settings = composed_settings("train", "network=unet_small_context")
    begun, source = with_pretrained_network(imported, settings)
    assert begun["network"] == settings["network"]
    assert source is None


def test_files_that_do_not_describe_their_network_change_nothing(
    imported: Path, tmp_path: Path, monkeypatch: Patch
) -> None:
    tensors = torch.load(imported, weights_only=True)["state_dict"]
    torch.save(tensors, tmp_path / "state.pt")
    settings, source = _begun(monkeypatch, tmp_path / "state.pt")
    assert settings["network"]["widths"] == [16, 32, 64, 128, 256, 256]
    assert "normalization" not in settings["data"]
    assert source is None
    with pytest.raises(DataError, match=r"net\.onnx: found an ONNX file, .*exported from"):
        _begun(monkeypatch, tmp_path / "net.onnx")


def test_classes_of_files_are_called_only_where_they_are_known(
    imported: Path, tmp_path: Path, monkeypatch: Patch
) -> None:
    content = torch.load(imported, weights_only=True)
    content["config"]["network"] = {"_target_": "torch.nn.Flatten"}
    torch.save(content, tmp_path / "odd.ckpt")
    begun = _begun(monkeypatch, tmp_path / "odd.ckpt", "data.inputs=[rgb]")
    with pytest.raises(DataError, match=r"odd\.ckpt: found network\..*_target_=torch.nn.Flatten"):
        build(*begun)
    begun = _begun(
        monkeypatch, tmp_path / "odd.ckpt", "trust=[torch.nn.Flatten]", "data.inputs=[rgb]"
    )
    with pytest.raises(SettingError, match=r"scores of the network: found \(1, "):
        build(*begun)


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
    run("train", "resume=tuned", rooms, "trainer.max_epochs=2")
    checkpoint = tmp_path / "tuned" / "checkpoints" / "best.ckpt"
    content = torch.load(checkpoint, weights_only=True)
    assert content["fresh"] == ["head.bias", "head.weight"]
    for name, tensor in before.items():
        frozen = name.startswith(("network.stem.", "network.downs."))
        assert not frozen or torch.equal(tensor, content["state_dict"][name])
    choices = content["config"]["choices"]
    assert "network" not in choices, "it is of no option"
    assert choices["experiment"] == "rooms/demo"
    trained = load_network(checkpoint)
    assert trained.class_names == tuple(content["class_names"])
    assert trained.normalization == Normalization.of("imagenet", 3)
    run("evaluate", f"checkpoint={checkpoint}", rooms, "hydra.run.dir=again")
    assert results(tmp_path / "again") == results(tmp_path / "tuned")
    assert read_settings(tmp_path / "again" / "config.yaml")["choices"] == choices
