"""Settings of data sets that cannot work are refused by name, before any file is read."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from datamodules.cityscapes import Cityscapes
from datamodules.core.inputs import RGB_NORMALIZATION
from datamodules.densepass import DensePASS
from datamodules.folder.labeled import FolderPanoramas
from datamodules.matterport360 import Matterport360
from datamodules.modelnet40.shapes import ModelNet40
from datamodules.stanford2d3ds.panoramas import Stanford2D3DS, Stanford2D3DSPerspective
from datamodules.structured3d import Structured3DPerspective
from datamodules.synpass import SynPASS
from datamodules.synthia.omnisynthia import OmniSynthia
from datamodules.synthrooms.datamodule import SynthRooms, SynthRoomsPerspective
from datamodules.zind.panoramas import Zind
from tangent_train.errors import SettingError
from tangent_train.rendering import EquirectRepresentation, PerspectiveRepresentation
from tests.datamodules.folder.folder_format import write_classes

ERP: Any = EquirectRepresentation(level=3)

CROPS: Any = PerspectiveRepresentation(level=5)


@pytest.mark.parametrize(
    ("data", "settings", "name"),
    [
        (Stanford2D3DS, {"batch_size": 0}, "batch_size"),
        (Stanford2D3DS, {"normalization": RGB_NORMALIZATION}, "normalization"),
        (Stanford2D3DS, {"color_jitter": 1.1}, "color_jitter"),
        (Stanford2D3DS, {"inputs": "rgb"}, "inputs: found rgb; expected a list"),
        (Stanford2D3DS, {"inputs": ("depth",)}, "inputs"),
        (Stanford2D3DS, {"inputs": ("rgb", "heat")}, "inputs"),
        (Stanford2D3DS, {"upright": "maybe"}, "upright"),
        (Stanford2D3DS, {"max_tilt_deg": 0}, "max_tilt_deg"),
        (Stanford2D3DS, {"test_rotation": 200}, "test_rotation"),
        (Stanford2D3DS, {"fold": 4}, "fold"),
        (Stanford2D3DS, {"unknown": "black"}, "unknown"),
        (Stanford2D3DS, {"val_fraction": 1.0}, "val_fraction"),
        (Stanford2D3DS, {"areas": ("5a", "5b")}, "areas"),
        (OmniSynthia, {"train_sequences": ("03",)}, "train_sequences"),
        (OmniSynthia, {"test_sequences": ()}, "test_sequences"),
        (FolderPanoramas, {"test_fraction": 0}, "test_fraction"),
        (FolderPanoramas, {"split_seed": -1}, "split_seed"),
        (FolderPanoramas, {"normalization": {"mean": [0]}}, "normalization"),
        *(
            (
                FolderPanoramas,
                {"normalization": {"mean": mean, "std": std}},
                r"normalization: .*mean",
            )
            for mean, std in ((0.5, 0.5), ([".nan", 0, 0], [1, 1, 1]), ([None] * 3, [1] * 3))
        ),
        (
            FolderPanoramas,
            {"normalization": {"mean": [123.7, 116.3, 103.5], "std": [58.4, 57.1, 57.4]}},
            r"normalization: .*divide all by 255: mean \[0\.4851, 0\.4561, 0\.4059\], std ",
        ),
        (
            FolderPanoramas,
            {"normalization": {"mean": [0, 0, 0], "std": [255, 255, 255]}},
            r"normalization: .*std \[1\.0, 1\.0, 1\.0\]",
        ),
        (
            FolderPanoramas,
            {"normalization": {"mean": [-0.5, 0, 0], "std": [1, 1, 1]}},
            r"normalization: .*expected numbers from 0 to 1",
        ),
        (Zind, {"inputs": ["rgb", "depth"]}, "inputs"),
        (Zind, {"doors": "open"}, "doors"),
        (Zind, {"test_fraction": 1.1}, "test_fraction"),
        (DensePASS, {"horizon_row": 401}, "horizon_row"),
        (DensePASS, {"area": [-180, 180, -30, 30]}, "area"),
        (DensePASS, {"inputs": ["rgb", "depth"]}, "inputs"),
        (SynPASS, {"weather": "snow"}, "weather"),
        (SynPASS, {"weather": []}, "weather"),
        (SynPASS, {"time": "dawn"}, "time"),
        (SynPASS, {"test_split": "train"}, "test_split"),
        (Matterport360, {"release": "sfss", "classes": "360bev"}, "classes: .*expected 41"),
        (ModelNet40, {"batch_size": 0}, "batch_size"),
        (ModelNet40, {"test_rotation": "z"}, "test_rotation"),
    ],
    ids=lambda value: value.__name__ if isinstance(value, type) else str(value),
)
def test_impossible_settings_are_refused(
    data: Any, settings: dict[str, Any], name: str, tmp_path: Path
) -> None:
    if data is FolderPanoramas:
        write_classes(tmp_path / "data")
    with pytest.raises(SettingError, match=rf"(data\.|^){name}"):
        data(tmp_path / "data", ERP, **settings)


@pytest.mark.parametrize(
    ("data", "representation", "settings", "message"),
    [
        (Stanford2D3DSPerspective, ERP, {}, "EquirectRepresentation; expected one for photos"),
        (Stanford2D3DS, CROPS, {}, "PerspectiveRepresentation; expected one for panoramas"),
        (ModelNet40, CROPS, {}, "representation=tangent"),
        (Cityscapes, CROPS, {"fov": 180}, "fov: found 180"),
        (Structured3DPerspective, CROPS, {"configuration": "simple"}, "expected full or empty"),
        (Structured3DPerspective, CROPS, {"lighting": "raw"}, "lighting: .*expected rawlight or"),
        (SynthRooms, ERP, {"rooms": {"rooms": {"1": 2}}, "fold": 2}, "fold 2: 2, 4"),
        (SynthRoomsPerspective, CROPS, {"rooms": {}}, "views_per_camera: found 0"),
    ],
)
def test_conflicting_settings_are_refused(
    data: Any, representation: Any, settings: dict[str, Any], message: str, tmp_path: Path
) -> None:
    with pytest.raises(SettingError, match=message):
        data(tmp_path, representation, **settings)
