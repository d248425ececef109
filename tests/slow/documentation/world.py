"""The files that documented commands read, small, and how commands are run among them."""

from __future__ import annotations

import importlib
import json
import multiprocessing
import os
import re
import runpy
import shutil
import sys
import tempfile
import tomllib
import traceback
from functools import partial
from pathlib import Path
from typing import Any, NoReturn

import av
import cv2
import numpy as np
from PIL import ExifTags, Image

from datamodules.cityscapes import CLASSES
from tangent_train.geometry import TangentGrid
from tangent_train.io.camera_files import write_rig
from tests.conftest import fabricate
from tests.datamodules.folder.folder_format import write_data_set, write_strips
from tests.datamodules.folder.photo_format import write_photos
from tests.datamodules.matterport_format import write_matterport
from tests.datamodules.stanford_pairs_format import write_paper_pairs
from tests.datamodules.street_format import (
    write_cityscapes,
    write_densepass,
    write_synpass,
)
from tests.datamodules.structured3d_format import write_structured3d
from tests.datamodules.synthia_format import write_panoramas, write_views
from tests.datamodules.zind_format import write_homes
from tests.inference.trained import write_depth_checkpoint
from tests.photo_networks import depth_networks
from tests.photo_networks import huggingface_networks as networks
from tests.slow.documentation.commands import TIME, fill_in, small_settings

ROOT = Path(__file__).resolve().parents[3]
SCRIPTS = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]
ROWS = 128
UPERNET = "openmmlab/upernet-convnext-tiny"
OF_CITYSCAPES = "nvidia/segformer-b0-finetuned-cityscapes-1024-1024"
DEPTH_ANYTHING = "depth-anything/Depth-Anything-V2-Small-hf"
"""Photo networks as the hub has them, where their names on the hub are paths."""
_SEQUENCES = dict.fromkeys(("01", "02", "04", "05", "06"), 2)
_TWO_BATCHES = {"PL_TRAINER_LIMIT_TRAIN_BATCHES": "2", "PL_TRAINER_LIMIT_VAL_BATCHES": "2"}


def build_world(folder: Path) -> Path:
    """Write all files that the pages name; the folder can be copied anywhere."""
    fabricate(folder / "data" / "2d3ds", height=ROWS, photos=2)
    write_panoramas(write_views(folder / "data" / "synthia", _SEQUENCES), _SEQUENCES, ROWS)
    write_cityscapes(folder / "data" / "cityscapes", ROWS)
    write_densepass(folder / "data" / "densepass", names=(1, 2))
    write_synpass(folder / "data" / "synpass", ROWS)
    write_structured3d(folder / "data" / "structured3d", height=ROWS, photos=True)
    write_matterport(folder / "data" / "matterport360", height=ROWS)
    write_paper_pairs(folder / "data" / "pairs", ROWS)
    write_homes(folder / "zind" / "sample_tour", rows=ROWS)
    write_data_set(folder / "my_rooms", height=ROWS, depth=True)
    write_strips(folder / "my_strips", (50, 2 * ROWS), 12)
    _write_streets(folder / "my_streets")
    write_photos(folder / "my_photos")
    classes = {name: [name] for name in ("wall", "floor", "window")}  # those of my_rooms
    (folder / "my_map.json").write_text(json.dumps({"source": "ADE20K", "classes": classes}))
    _write_pictures(folder)
    _write_colmap_model(folder / "project")
    small_photos = {"height": 32, "width": 32}
    networks.saved(networks.upernet, folder / UPERNET, size=small_photos)
    networks.saved(depth_networks.depth_anything, folder / DEPTH_ANYTHING)
    of_streets = partial(networks.segformer, CLASSES)
    networks.saved(of_streets, folder / OF_CITYSCAPES, size=small_photos)
    demo = f"runs/demo/{TIME}"
    for line in (
        f"tangent-train experiment=rooms/demo hydra.run.dir={demo}",
        f"tangent-train experiment=rooms/demo data.inputs=[rgb] hydra.run.dir=runs/rgb/{TIME}",
        f"tangent-train experiment=rooms/depth hydra.run.dir=runs/rooms/depth/{TIME}",
        f"tangent-train experiment=shapes/default hydra.run.dir=runs/shapes/default/{TIME}",
        "tangent-prepare data=synthshapes data.root=data/ModelNet40",
        "tangent-export checkpoint=runs/rgb/…/checkpoints/best.ckpt output=model.onnx",
        "tangent-export checkpoint=runs/rgb/…/checkpoints/best.ckpt output=model.safetensors",
        "tangent-render input=room.jpg output=tangent",
        f"tangent-import library=huggingface model={UPERNET} output=upernet.ckpt",
        f"tangent-import library=huggingface model={OF_CITYSCAPES} output=cityscapes.ckpt",
    ):
        run(line.split(), {}, folder)
    for root in ("synthrooms", "rooms_standard"):
        shutil.copytree(folder / "data" / "rooms_demo", folder / "data" / root)
    shutil.copyfile(folder / demo / "checkpoints" / "best.ckpt", folder / "other.ckpt")
    shutil.copytree(folder / demo, folder / "runs" / "demo" / "first")  # of `make demo`
    trained = next((folder / "runs" / "rgb").glob("*/checkpoints/best.ckpt"))
    shutil.copyfile(trained, folder / "net.ckpt")
    write_depth_checkpoint(folder / "depth.ckpt")
    for kind in ("room", "room_depth", "room_features"):  # what another program made of them
        images = shutil.copytree(folder / "tangent" / "room", folder / "kept" / kind)
        shutil.copytree(images, folder / "tangent" / kind, dirs_exist_ok=True)
        (folder / "results" / kind).mkdir(parents=True)
        for path in images.glob("face_*.png"):
            rgb: Any = cv2.imread(str(path))
            out = folder / "results" / kind / path.stem
            if kind == "room_depth":
                cv2.imwrite(f"{out}.png", 1000 + rgb[..., 0].astype(np.uint16))
            else:
                np.save(out, rgb[..., 0] // 32 if kind == "room" else rgb.astype(np.float32))
    return folder


def _write_streets(root: Path) -> None:
    rng = np.random.default_rng(0)
    for name in "abcd":
        for folder, image in (
            ("images", rng.integers(0, 256, (50, 2 * ROWS, 3), np.uint8)),
            ("labels", rng.integers(0, 3, (50, 2 * ROWS), np.uint8)),
        ):
            (root / folder).mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(root / folder / f"{name}.png"), image)


def _write_pictures(folder: Path) -> None:
    rng = np.random.default_rng(0)
    panorama = cv2.resize(rng.integers(0, 256, (8, 16, 3), np.uint8), (2 * ROWS, ROWS))
    for name in ("panorama", "room", "panoramas/hall", "panoramas/kitchen", "holiday/beach"):
        for path, image in (
            (folder / f"{name}.jpg", panorama),
            (folder / "depth" / f"{Path(name).name}.png", np.full((ROWS, 2 * ROWS), 2000)),
        ):
            path.parent.mkdir(exist_ok=True)
            cv2.imwrite(str(path), image.astype(np.uint8 if image is panorama else np.uint16))
    cv2.imwrite(str(folder / "room.png"), panorama)
    cv2.imwrite(str(folder / "labels.png"), panorama[..., 0] // 32)
    for name in ("tripod", "poles", "labels/labels/hall", "labels/labels/kitchen"):
        path = folder / f"{name}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(path), panorama[..., 0] // 64)
    (folder / "labels" / "classes.json").write_text('["wall", "person", "sky", "floor"]')
    with av.open(str(folder / "walk.mp4"), "w") as output:
        stream: Any = output.add_stream("mpeg4", rate=5)
        stream.height, stream.width = panorama.shape[:2]
        output.mux(stream.encode(av.VideoFrame.from_ndarray(panorama, format="bgr24")))
        output.mux(stream.encode(None))
    cv2.imwrite(str(folder / "strip.jpg"), cv2.resize(panorama, (288, 64)))
    exif = Image.Exif()
    exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.FocalLengthIn35mmFilm] = 24
    for name in ("photo.jpg", "photos/garden.jpg"):
        (folder / name).parent.mkdir(exist_ok=True)
        Image.fromarray(panorama[:, : 3 * ROWS // 2]).save(folder / name, exif=exif)


def _write_colmap_model(project: Path) -> None:
    """A project, and a model in which one of its images has a pose."""
    model = project / "sparse" / "0"
    model.mkdir(parents=True)
    write_rig(
        project / "rig_config.json", {"face_000/": (TangentGrid(0, 5), 0)}, {"a.png": "a.jpg"}
    )
    (model / "cameras.txt").write_text("1 PINHOLE 32 32 30 30 16 16\n")
    (model / "images.txt").write_text("1 1 0 0 0 0 0 0 1 face_000/a.png\n\n")
    (model / "points3D.txt").write_text("")


def words_in_world(words: list[str], world: Path) -> list[str]:
    """Return a command with files of the world in place of placeholders and missing runs."""
    for named in re.findall(r"(?<!dir=)runs/([\w/-]+?)(?=/…|/<|/\d{4}-|\s|$)", " ".join(words)):
        if not (world / "runs" / named).exists():
            kind = "shapes/default" if "shapes" in named else "demo"
            shutil.copytree(world / "runs" / kind / TIME, world / "runs" / named / TIME)
    return fill_in(words, world)


def run(words: list[str], variables: dict[str, str], world: Path) -> None:
    """Run a documented command on small data; it must succeed and write a file.

    The process is forked from the server of conftest, which has imported the slow modules.
    """
    words = words_in_world(words, world)
    for name, _, value in (word.partition("=") for word in words):
        place = world / value
        if name == "output" and place != world:
            shutil.rmtree(place) if place.is_dir() else place.unlink(missing_ok=True)
    words += small_settings(words, world)
    before = _times(world)
    context = multiprocessing.get_context("forkserver")
    with tempfile.NamedTemporaryFile() as log:
        process = context.Process(target=_child, args=(words, variables, str(world), log.name))
        process.start()
        process.join(300)
        status = process.exitcode
        process.kill()
        output = Path(log.name).read_text(errors="replace")
    report = f"was run as: {' '.join(words)}\n{output}"
    assert status == 0, report
    assert "Traceback" not in output, report
    may_only_print = ("tangent-check", "tangent-prepare", "python")
    if words[0] not in may_only_print and "--help" not in words:
        assert _times(world) != before, f"nothing was written: {report}"


def _times(folder: Path) -> dict[Path, int]:
    return {path: path.stat().st_mtime_ns for path in folder.rglob("*") if path.is_file()}


def _child(words: list[str], variables: dict[str, str], folder: str, log: str) -> NoReturn:
    sys.settrace(None)  # covered by other tests: tracing it takes five times as long
    with Path(log).open("wb") as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
    os.chdir(folder)
    paths = [".", str(ROOT)]  # a reader's own modules; the studies and benchmarks of the checkout
    sys.path[:0] = paths
    os.environ |= {"COLUMNS": "120", "PYTHONPATH": ":".join(paths), **_TWO_BATCHES, **variables}
    program, *arguments = words
    status: object = 0
    try:
        if program == "python":
            module = arguments[0] == "-m"
            sys.argv = arguments[module:]
            (runpy.run_module if module else runpy.run_path)(sys.argv[0], run_name="__main__")
        else:
            name, _, function = SCRIPTS[program].partition(":")
            sys.argv = [str(Path(sys.executable).with_name(program)), *arguments]
            getattr(importlib.import_module(name), function)()
    except SystemExit as ended:
        status = ended.code
    except BaseException:
        traceback.print_exc()
        status = 1
    if isinstance(status, str):
        sys.stderr.write(f"{status}\n")
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(status if isinstance(status, int) else int(status is not None))
