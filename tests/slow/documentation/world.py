"""The world that documented commands run in: every file they name is there, only small."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from PIL import ExifTags, Image

from datamodules.synthshapes.generate import ShapeSettings, generate_shapes
from tests.datamodules.folder.folder_format import write_data_set
from tests.datamodules.stanford2d3ds.stanford_pairs_format import write_paper_pairs
from tests.datamodules.synthia.synthia_format import write_panoramas, write_views
from tests.slow.documentation.cluster import write_cluster
from tests.slow.documentation.running import run

if TYPE_CHECKING:
    from tests.conftest import FabricateStanford

ROWS = 32
TIME = "2026-01-31_12-00-00"
RUNS = (
    "demo",
    "make_demo",
    "run",
    "standard",
    "accuracy/few_aux",
    "rooms/accuracy",
    "paper/semseg_s7_b0_rgbd",
)
"""Names of the runs that documents name: all of them copies of one."""

PLACES = {
    "/data/2d3ds": "2d3ds",
    "/data/synthia": "synthia",
    "/data/ModelNet40": "modelnet40",
    "/ssd": "ssd",
    "/shared": "shared",
}
"""Absolute paths of the documents, and where they are in this world."""

SEQUENCES = dict.fromkeys(("01", "02", "04", "05", "06"), 2)
INSTALLED = "installed"
"""A folder of packages that a reader has."""

CLUSTER = "cluster"
"""A folder of SLURM's commands."""

PAPER_PAIRS = "paper_pairs"
"""Where panoramas with the names of the paper's pairs are: only those, without labels."""

RGB_CHECKPOINT = "best.ckpt"
"""Of a network without depth; the demo's is one with it."""

ROOM_FOLDERS = ("data/synthrooms", "data/rooms_standard")
"""Where further experiments look for rooms: copies of the demo's."""

_NETWORK = """
from torch import nn

class MyNetwork(nn.Conv2d):
    def __init__(self, in_channels, num_classes):
        super().__init__(in_channels, num_classes, 1)
"""
_ROOMS = {"area_1": 2, "area_2": 2, "area_3": 1, "area_4": 1, "area_5a": 1, "area_5b": 1}
ROOMS = {
    **{f"data.rooms.rooms.{area}": count for area, count in (_ROOMS | {"area_6": 1}).items()},
    "data.rooms.height": ROWS,
    "data.rooms.view_size": ROWS,
    "data.rooms.supersample": 1,
}
"""Settings of a few small rooms."""

SHAPES = {"data.shapes.train": 3, "data.shapes.test": 1, "network.width": 2}
"""Settings of a few shapes and a narrow network."""

DEMO: dict[str, Any] = {
    "level": 4,
    "representation.crop_multiple": "null",
    "representation.faces_per_panorama": 2,
    "network.widths": "[4,8]",
    "data.panoramas_per_step": 2,
    "data.validation_fraction": 0.3,
    **ROOMS,
    "trainer.max_epochs": 1,
    "trainer.accelerator": "cpu",
    "panels": 1,
    "tensorboard_images": 1,
}


def build_world(folder: Path, fabricate_stanford: FabricateStanford) -> Path:
    """Make the files; returns the folder. Nothing in it depends on where it is: it can be copied.

    Args:
        folder: A new one.
        fabricate_stanford: Writes a small data set in the format of Stanford2D3DS.
    """
    folder.mkdir(parents=True)
    fabricate_stanford(folder / PLACES["/data/2d3ds"], height=ROWS, photos=2)
    write_panoramas(write_views(folder / PLACES["/data/synthia"], SEQUENCES), SEQUENCES, ROWS)
    (folder / INSTALLED).mkdir()
    (folder / INSTALLED / "my_package.py").write_text(_NETWORK)
    write_paper_pairs(folder / PAPER_PAIRS, ROWS)
    _write_pictures(folder)
    _write_tangent_images(folder)
    _write_shapes(folder)
    write_data_set(folder / "my_rooms", height=ROWS, depth=True)
    settings = [f"{name}={value}" for name, value in DEMO.items()]
    first, *others = (folder / "runs" / name / TIME for name in RUNS)
    rgb = folder / "runs" / "rgb" / TIME
    for made, inputs in ((first, "[rgb,depth]"), (rgb, "[rgb]")):
        place = [f"data.inputs={inputs}", f"hydra.run.dir={made.relative_to(folder)}"]
        done = run(["tangent-train", "experiment=rooms/demo", *settings, *place], {}, folder)
        assert done.status == 0, done.output
    shutil.copyfile(rgb / "checkpoints" / "best.ckpt", folder / RGB_CHECKPOINT)
    for other in others:
        shutil.copytree(first, other)
    for room_folder in ROOM_FOLDERS:
        shutil.copytree(folder / "data" / "rooms_demo", folder / room_folder)
    write_cluster(folder / CLUSTER)
    shutil.copyfile(first / "checkpoints" / "best.ckpt", folder / "other.ckpt")
    return folder


def _write_shapes(folder: Path) -> None:
    """A run on made shapes, and these in the place of ModelNet40."""
    small = [f"{name}={value}" for name, value in SHAPES.items()]
    small += ["level=4", "data.validation_fraction=0.34", "trainer.max_epochs=1"]
    place = f"hydra.run.dir=runs/shapes/default/{TIME}"
    done = run(["tangent-train", "experiment=shapes/default", *small, place], {}, folder)
    assert done.status == 0, done.output
    generate_shapes(folder / PLACES["/data/ModelNet40"], ShapeSettings(train=3, test=1))


def _write_tangent_images(folder: Path) -> None:
    """Those of a panorama, and what another program made of them."""
    done = run(["tangent-render", "input=room.jpg", "output=tangent"], {}, folder)
    assert done.status == 0, done.output
    images = folder / "tangent" / "room"
    for kind in ("room", "room_depth", "room_features"):
        results = folder / "results" / kind
        results.mkdir(parents=True)
        if kind != "room":
            shutil.copytree(images, images.with_name(kind))
        for image in images.glob("face_*.png"):
            rgb = cv2.imread(str(image))
            assert rgb is not None
            if kind == "room_depth":
                depth = 1000 + rgb[..., 0].astype(np.uint16)
                assert cv2.imwrite(str(results / image.name), depth)
            else:
                made = rgb[..., 0] // 32 if kind == "room" else rgb.astype(np.float32)
                np.save(results / f"{image.stem}.npy", made)


def _write_pictures(folder: Path) -> None:
    rng = np.random.default_rng(0)
    panorama = cv2.resize(rng.integers(0, 256, (8, 16, 3), np.uint8), (4 * ROWS, 2 * ROWS))
    photo = cv2.resize(rng.integers(0, 256, (6, 8, 3), np.uint8), (2 * ROWS, ROWS * 3 // 2))
    depth = np.full(panorama.shape[:2], 2000, np.uint16)
    for name in ("panorama", "room", "panoramas/hall", "panoramas/kitchen", "holiday/beach"):
        path = folder / f"{name}.jpg"
        path.parent.mkdir(exist_ok=True)
        assert cv2.imwrite(str(path), panorama)
        (folder / "depth").mkdir(exist_ok=True)
        assert cv2.imwrite(str(folder / "depth" / f"{path.stem}.png"), depth)
    assert cv2.imwrite(str(folder / "photo.jpg"), photo)
    assert cv2.imwrite(str(folder / "labels.png"), panorama[..., 0] // 32)
    assert cv2.imwrite(str(folder / "room.png"), panorama)
    assert cv2.imwrite(str(folder / "strip.jpg"), cv2.resize(panorama, (288, 64)))
    exif = Image.Exif()
    exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.FocalLengthIn35mmFilm] = 24
    (folder / "photos").mkdir()
    Image.fromarray(photo).save(folder / "photos" / "garden.jpg", exif=exif)
