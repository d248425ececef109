"""Prompts through `tangent-import`, `tangent-predict`, `tangent-export` and in Python."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest

import tangent_train as tt
from tangent_train.io.pixel_files import read_pixels, write_pixels
from tests.cli.tiny_runs import Predict, Run
from tests.photo_networks.prompted_networks import saved_clipseg, saved_sam3
from tests.running import Capture

PROMPTS = "{seat: [mast, eskis], tah: tah}"
OBJECTS = "[labels,panoptic,objects,overlay]"


@pytest.fixture
def panorama(tmp_path: Path) -> Path:
    rgb = np.random.default_rng(0).integers(0, 256, (4, 8, 3), np.uint8)
    write_pixels(tmp_path / "in" / "hall.png", rgb.repeat(16, 0).repeat(16, 1))
    return tmp_path / "in" / "hall.png"


def _written(folder: Path) -> dict[str, Any]:
    kinds = {p.parent.name for p in folder.glob("*/hall.png")}
    return {kind: read_pixels(folder / kind / "hall.png", indices=False) for kind in kinds}


def test_sam_through_all_commands(
    tmp_path: Path, panorama: Path, run: Run, predict: Predict, capsys: Capture
) -> None:
    saved_sam3(tmp_path / "net")
    common = (
        "library=huggingface",
        "model=net",
        "views=cubemap",
    )  # without overlap, random masks remain
    run("import", *common, f"prompts={PROMPTS}", "output=ours.ckpt")
    printed = capsys.readouterr().out
    assert "2 classes: seat, tah" in printed
    assert "objects of: seat, tah" in printed
    run("import", *common, "prompts=[kite]", "output=other.ckpt")
    (expected,) = predict(checkpoint="ours.ckpt", write=OBJECTS).values()
    names = {segment["class"] for segment in expected["segments"]}
    assert names == {"seat", "tah"}
    assert '"1":{"number":1,"class":"' in (tmp_path / "out" / "report.html").read_text()
    changed = {"checkpoint": "other.ckpt", "output": "changed", "write": OBJECTS}
    (entry,) = predict(prompts=PROMPTS, **changed).values()
    assert entry == expected
    ours, other = _written(tmp_path / "out"), _written(tmp_path / "changed")
    assert ours.keys() == other.keys() == {"labels", "panoptic", "objects", "overlay"}
    for kind, pixels in ours.items():
        np.testing.assert_array_equal(pixels, other[kind])
    with pytest.raises(SystemExit, match=r"prompts: found .* with which changed was written"):
        predict(prompts="[tah]", **changed)

    network = tt.load("other.ckpt")
    labels = network.labels(panorama, prompts={"seat": ["mast", "eskis"], "tah": "tah"})
    np.testing.assert_array_equal(
        labels, read_pixels(tmp_path / "out/labels/hall.png", indices=True)
    )
    assert network.class_names == ("unknown", "seat", "tah")
    assert {each["class"] for each in network.panoptic(panorama)[1]} == {"seat", "tah"}
    with pytest.raises(SystemExit, match="cannot be written"):
        run("export", "checkpoint=ours.ckpt", "output=ours.onnx")


def test_clipseg_through_all_commands(
    tmp_path: Path, panorama: Path, run: Run, predict: Predict
) -> None:
    saved_clipseg(tmp_path / "net")
    run("import", "library=huggingface", "model=net", "prompts=[kite]", "output=net.ckpt")
    (tmp_path / "map.json").write_text('{"source": "texts", "classes": {"chair": ["seat", "tah"]}}')
    given = {"checkpoint": "net.ckpt", "prompts": PROMPTS, "label_map": "map.json"}
    (entry,) = predict(**given, threshold=0.4).values()
    assert entry["classes"].keys() == {"unknown", "chair"}
    network = tt.load("net.ckpt", prompts=["mast"], threshold=0.4)
    assert network.class_names == ("unknown", "mast")
    labels = network.labels(panorama)
    run("export", "checkpoint=net.ckpt", "output=net.safetensors")
    again = tt.load("net.safetensors", prompts=["mast"], threshold=0.4)
    np.testing.assert_array_equal(again.labels(panorama), labels)
    run("export", "checkpoint=net.ckpt", "output=net.onnx")
    names = [tensor.name for tensor in onnx.load(tmp_path / "net.onnx").graph.initializer]
    assert any("vision_model" in name for name in names)
    assert not any("text" in name or "token" in name for name in names)
    with pytest.raises(SystemExit, match="a network without text"):
        predict(checkpoint="net.onnx", prompts="[mast]", output="of_onnx")
