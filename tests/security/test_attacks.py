"""Nothing in a file of other people is interpreted, wherever in it an attack is put."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import onnx
import pytest
import torch
from safetensors.torch import load_file, save_file

from tangent_train.checkpoints.loaded import METADATA_KEY, load_network, read_description
from tangent_train.cli.keypoints import earlier_results
from tangent_train.cli.run import build
from tangent_train.cli.stored import StoredRun, stored_run
from tangent_train.config.build import build_from_config
from tangent_train.errors import DataError, SettingError
from tangent_train.io.camera_files import read_cameras
from tests.cli.tiny_runs import run_command
from tests.security.attacks import (
    attacks,
    json_attacks,
    named_twice,
    places,
    places_of_arguments,
    replaced,
    sampled,
    second_readings,
)
from tests.security.honest import composed
from tests.security.watch import watched


def _nothing_happens(use: Callable[[Path], Any], path: Path, forbidden: Path, what: object) -> None:
    """Use a file: it is taken for what it is, or refused in one line that names it."""
    with watched(forbidden) as happened, suppress(DataError, SettingError):
        use(path)
    assert not happened, (what, happened)
    assert [path.name for path in forbidden.iterdir()] == ["config.json"], what


def test_in_a_checkpoint(content: dict[str, Any], forbidden: Path) -> None:
    """Every attack, and an attack at every place."""
    path, lighter = forbidden.parent / "x.ckpt", _light(content)
    evaluated = _evaluation(lighter, path)
    all_places = [("config", *place) for place in places(content["config"])]
    all_places += [
        (name,) for name in ("config", "class_names", "inputs", "predicts", "state_dict")
    ]
    all_places += [("normalization",), ("normalization", "mean")]
    for place, value in sampled(list(attacks(forbidden)), all_places):
        torch.save(replaced(lighter, place, value), path)
        for use in (load_network, evaluated, read_description):
            _nothing_happens(use, path, forbidden, (place, value))


def _light(content: dict[str, Any]) -> dict[str, Any]:
    """A checkpoint without what attacks leave alone."""
    return content | {"optimizer_states": [], "loops": {}}


def _evaluation(content: dict[str, Any], path: Path, *typed: str) -> Callable[[Path], None]:
    """Return a function that builds ``tangent-evaluate checkpoint=<path> data.root=rooms …``.

    Args:
        content: An honest checkpoint.
        path: Where to write it.
        *typed: Further settings that the user types.
    """
    torch.save(content, path)
    typed = (f"checkpoint={path}", "data.root=rooms", *typed)
    stored = stored_run("evaluate", typed)
    assert isinstance(stored, StoredRun)
    composed_settings = composed(stored.arguments)

    def evaluated(path: Path) -> None:
        stored = stored_run("evaluate", typed)
        assert isinstance(stored, StoredRun)
        settings, source = stored.settings(composed_settings)
        build(settings, source)
        build_from_config(settings["trainer"], "trainer", source, logger=False)

    evaluated(path)
    return evaluated


def test_under_names_that_can_be_read_in_two_ways(content: dict[str, Any], forbidden: Path) -> None:
    """At every argument of every section, beside settings that the user types."""
    path, lighter = forbidden.parent / "x.ckpt", _light(content)
    typed = ("data.fold=1", "trainer.max_epochs=1", "task.compile=null")
    evaluated = _evaluation(lighter, path, *typed)
    at = list(places_of_arguments(content["config"]))
    assert ("data", "mask") in at
    for config in second_readings(content["config"], at, forbidden):
        torch.save(lighter | {"config": config}, path)
        for use in (load_network, evaluated, read_description):
            _nothing_happens(use, path, forbidden, config)


def _named_twice(
    content: Any, forbidden: Path, dump: Callable[[Any], str]
) -> Iterator[tuple[Any, str]]:
    """Every name of honest content twice, as text."""
    for place in places(content):
        for text in named_twice(content, place, f"{forbidden}/x", dump):
            yield place, text


def test_in_the_metadata_of_an_exported_network(run: Path, forbidden: Path) -> None:
    header = (run.parent / "net.safetensors").read_bytes()
    length = int.from_bytes(header[:8], "little")
    described = json.loads(json.loads(header[8 : 8 + length])["__metadata__"][METADATA_KEY])
    tensors = load_file(run.parent / "net.safetensors")
    model = onnx.load(run.parent / "net.onnx")
    for place, value in sampled(list(json_attacks(forbidden)), list(places(described))):
        text = json.dumps(replaced(described, place, value))
        one, other = forbidden.parent / "x.safetensors", forbidden.parent / "x.onnx"
        save_file(tensors, one, {METADATA_KEY: text})
        onnx.helper.set_model_props(model, {METADATA_KEY: text})
        onnx.save(model, other)
        for path in (one, other):
            _nothing_happens(load_network, path, forbidden, (place, value))
        _nothing_happens(read_description, one, forbidden, (place, value))
    for place, text in _named_twice(described, forbidden, json.dumps):
        save_file(tensors, one, {METADATA_KEY: text})
        with pytest.raises(DataError, match="is repeated"):
            pytest.fail(f"{place}: {load_network(one)}")


def test_in_lists_of_cameras_and_results_of_keypoints(
    run: Path, forbidden: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(forbidden.parent)
    panorama = next((run.parent / "rooms").rglob("*equirectangular_domain_rgb.png"))
    tangent = ("output=tangent", "level=4", "base_level=0")
    run_command(monkeypatch, "render", f"input={panorama}", *tangent)
    cameras = next(Path("tangent").rglob("cameras.json"))
    Path("found").mkdir()
    results = Path("found") / "results.json"
    pairs = {"settings": {"level": 5}, "rows": [{"pair": "a", "pmr": 0.5}]}
    for path, use, honest in (
        (cameras, read_cameras, json.loads(cameras.read_text())),
        (results, lambda p: earlier_results(p.parent, {"level": 5}), pairs),
    ):
        for place, value in sampled(list(json_attacks(forbidden)), list(places(honest))):
            path.write_text(json.dumps(replaced(honest, place, value)))
            _nothing_happens(use, path, forbidden, (path, place, value))
        for place, text in _named_twice(honest, forbidden, json.dumps):
            path.write_text(text)
            with pytest.raises(DataError, match="is repeated"):
                pytest.fail(f"{place}: {use(path)}")
