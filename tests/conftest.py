"""Data in the real on-disk formats, made on the spot."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from multiprocessing import forkserver
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from hypothesis import settings
from numpy.typing import NDArray

from datamodules.stanford2d3ds.files import CLASSES
from tests.datamodules.data_files import write_png

settings.register_profile("tests", deadline=None)  # speed is no test's business
settings.load_profile("tests")

SLOW = Path(__file__).parent / "slow"

INSTANCES_PER_CLASS = 40  # the table is longer than 256 entries: two bytes of the color count
ROOMS = {
    "1": ("office_1", "office_1", "office_2", "hallway_1"),
    "2": ("office_1", "conferenceRoom_1"),
    "3": ("WC_1",),
    "4": ("lobby_1",),
    "5a": ("office_1", "office_1", "hallway_2"),
    "5b": ("hallway_2", "office_3"),
    "6": ("office_1",),
}


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark the tests in `tests/slow`, which are for `make test-all`; skip those without a GPU."""
    for item in items:
        if SLOW in item.path.parents:
            item.add_marker("slow")
        if item.get_closest_marker("gpu") and not torch.cuda.is_available():
            item.add_marker(pytest.mark.skip(reason="no CUDA device"))


def pytest_collection_finish(session: pytest.Session) -> None:
    """Start the server of processes here: the folder of the first test that needs it may go."""
    if not any(item.get_closest_marker("slow") for item in session.items):
        return
    modules = ["tangent_train.cli.train", "tangent_train.cli.transfer", "tensorboard"]
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("OMP_NUM_THREADS", "1")  # forked processes have no threads
        patch.setenv("NUMBA_NUM_THREADS", "1")
        forkserver.set_forkserver_preload(modules)
        forkserver.ensure_running()


def fabricate(
    root: Path,
    rooms: Mapping[str, Sequence[str]] = ROOMS,
    height: int = 32,
    photos: int = 0,
) -> Path:
    """Panoramas of boxes whose color and depth tell their class, with every trap of the format.

    Each has a missing region (label #0D0D0D, depth 65535, black), a patch with one black channel,
    and every other one an alpha channel. A photo is the left half of a panorama, with a pose file
    whose camera sees 60° of it; the next one 2° more.
    """
    names = ["<UNK>_0_<UNK>_0_0"]
    names += [f"{c}_{i}_office_1_1" for c in CLASSES for i in range(INSTANCES_PER_CLASS)]
    root.mkdir(parents=True, exist_ok=True)
    (root / "semantic_labels.json").write_text(json.dumps(names))
    for area, area_rooms in rooms.items():
        for number, room in enumerate(area_rooms):
            camera = hashlib.md5(f"{area}/{number}".encode(), usedforsecurity=False).hexdigest()
            rng = np.random.default_rng(int(camera[:8], 16))
            stem = f"camera_{camera}_{room}_frame_equirectangular_domain"
            pano = root / f"area_{area}" / "pano"
            for domain, image in _panorama(rng, height, alpha=number % 2 == 1).items():
                write_png(pano / domain / f"{stem}_{domain}.png", image)
            for frame in range(photos):
                stem = f"camera_{camera}_{room}_frame_{frame}_domain"
                data = root / f"area_{area}" / "data"
                for domain, image in _panorama(rng, height, alpha=False).items():
                    write_png(data / domain / f"{stem}_{domain}.png", image[:, :height])
                focal = height / (2 * math.tan(math.radians(60 + 2 * frame) / 2))
                matrix = [[focal, 0, height / 2], [0, focal, height / 2], [0, 0, 1]]
                (data / "pose").mkdir(exist_ok=True)
                axes = [[0, 1, 0, 0], [0, 0, -1, 0], [-1, 0, 0, 0]]
                pose = json.dumps(
                    {
                        "camera_k_matrix": matrix,
                        "camera_rt_matrix": axes,
                        "camera_original_rotation": [math.pi / 2, 0, 0],
                        "camera_location": [0, 0, 0],
                    }
                )
                (data / "pose" / f"{stem}_pose.json").write_text(pose)
    return root


def _panorama(rng: np.random.Generator, height: int, *, alpha: bool) -> dict[str, NDArray[Any]]:
    blocks = rng.integers(0, len(CLASSES), (height // 4, height // 2))
    classes = np.kron(blocks, np.ones((4, 4), np.int64))
    index = 1 + classes * INSTANCES_PER_CLASS + rng.integers(0, INSTANCES_PER_CLASS)
    color = np.stack([index >> 16, index >> 8 & 255, index & 255], axis=-1).astype(np.uint8)
    rgb = np.stack([20 + 15 * classes, 230 - 15 * classes, 100 + 5 * classes], axis=-1)
    rgb = rgb.astype(np.uint8)
    depth = (512 * (1 + classes / 4)).astype(np.uint16)
    rgb[: height // 8], color[: height // 8], depth[: height // 8] = 0, 13, 65535
    rgb[-height // 8 :, :8, 2] = 0
    if alpha:
        rgb = np.dstack([rgb, np.full(rgb.shape[:2], 255, np.uint8)])
        bgr = cv2.cvtColor(rgb, cv2.COLOR_RGBA2BGRA)
    else:
        bgr = cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR)
    return {"rgb": bgr, "semantic": color[..., ::-1], "depth": depth}


@pytest.fixture(scope="session", autouse=True)
def _state_home(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Nothing is remembered in the home folder, nor by another session."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_STATE_HOME", str(tmp_path_factory.mktemp("state")))
        yield


@pytest.fixture(scope="session")
def stanford_root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small data set in the format of Stanford2D3DS, 14 panoramas of 32×64; not to be changed."""
    return fabricate(tmp_path_factory.mktemp("stanford"))
