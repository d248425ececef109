"""Data sets of partial panoramas: files of a part of the sphere, placed on all of it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from datamodules.folder.labeled import FolderPanoramas
from tangent_train.errors import DataError, SettingError
from tangent_train.io.gpano import Fill, PanoramaArea
from tangent_train.rendering import EquirectRepresentation
from tests.datamodules.data_files import read_png
from tests.datamodules.folder.folder_format import save, write_strips

AREA = (-180, 180, -35.15, 35.15)


@pytest.mark.parametrize("level", [7, 6])
def test_native_pixels_are_placed_unchanged(tmp_path: Path, level: int) -> None:
    """At the level of the files; below it they are averaged, as whole panoramas are."""
    root = write_strips(tmp_path, (100, 512), depth=True)
    erp = EquirectRepresentation(level)
    data = FolderPanoramas(root, erp, inputs=["rgb", "depth"], area=AREA, fill="edge")
    source = data.dataset("test")
    panorama, name = source.read(0), source.name(0)
    rows = 2 ** (level + 1)
    top, height = round(78 * rows / 256), 100 * rows // 256
    assert panorama.labels.shape == (rows, 2 * rows)
    stored = {part: read_png(root / part / f"{name}.png") for part in ("images", "labels", "depth")}
    step = 256 // rows
    inside = slice(top, top + height)
    if step == 1:
        np.testing.assert_array_equal(panorama.rgb[inside], stored["images"][..., ::-1])
        assert panorama.depth is not None
        np.testing.assert_allclose(panorama.depth[inside], stored["depth"] * 0.512, atol=0.51)
    mean = stored["images"].reshape(height, step, 2 * rows, step, 3).mean(axis=(1, 3))
    assert np.abs(panorama.rgb[inside] - mean[..., ::-1]).max() <= 0.51
    assert (panorama.labels[inside] > 0).any()
    for outside in (slice(0, top), slice(top + height, None)):
        assert not panorama.labels[outside].any()
        assert panorama.depth is not None
        assert not panorama.depth[outside].any()
        assert panorama.rgb[outside].any()
    labels = FolderPanoramas(root, erp, labels="distance", inputs=["rgb"], area=AREA).dataset(
        "test"
    )
    np.testing.assert_array_equal(labels.read(0).labels, panorama.depth)


def _canvas(angles: tuple[float, ...], fill: Fill) -> Any:
    canvas = PanoramaArea.on_canvas(angles, 16)
    image = np.random.default_rng(0).integers(1, 256, (*canvas.image_shape, 3), np.uint8)
    return image, canvas, canvas.filled(canvas.place(image), fill)


@pytest.mark.parametrize(
    "angles", [(-180, 180, -45, 60), (135, -135, -45, 45), (-45, 90, -90, 22.5)]
)
@pytest.mark.parametrize("fill", ["black", "mean", "edge", "reflect"])
def test_fill_is_that_of_a_slow_loop(angles: tuple[float, ...], fill: Fill) -> None:
    image, canvas, filled = _canvas(angles, fill)
    height, width = image.shape[:2]
    np.testing.assert_array_equal(canvas.cut(filled), image)
    mirrored = np.concatenate([image, image[::-1]] * 8)
    mirrored = np.concatenate([mirrored, mirrored[:, ::-1]] * 32, axis=1)
    for row, column in np.ndindex(16, 32):
        down = row - canvas.rows[0]
        right = (column - canvas.columns[0]) % 32
        left = right - 32
        across = right if right < width or right - width + 1 <= -left else left
        expected = {
            "black": (0, 0, 0),
            "mean": image.reshape(-1, 3).mean(axis=0).round(),
            "edge": image[min(max(down, 0), height - 1), min(max(across, 0), width - 1)],
            "reflect": mirrored[down, across],
        }[fill]
        if 0 <= down < height and right < width:
            expected = image[down, right]
        np.testing.assert_array_equal(filled[row, column], expected)


@pytest.mark.parametrize("angles", [(135, -135, -45, 60), (-180, 180, 10, 80)])
def test_the_area_rotates_with_the_panorama(angles: tuple[float, ...], tmp_path: Path) -> None:
    size = PanoramaArea.on_canvas(angles, 64).image_shape
    root = write_strips(tmp_path, size)
    for path in (root / "labels").iterdir():
        save(path, np.ones(size, np.uint8))
    erp = EquirectRepresentation(5)
    data = FolderPanoramas(root, erp, area=angles, test_rotation="so3", seed=1)
    panorama = data.dataset("test").read(0)
    np.testing.assert_array_equal(panorama.valid, panorama.labels > 0)


@pytest.mark.parametrize("rotation", [None, "so3"])
def test_the_estimate_of_up_does_not_see_the_fill(
    rotation: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The file is read again, because the panorama is small."""
    seen: list[Any] = []
    monkeypatch.setattr(
        "datamodules.core.image_module.estimate_up", lambda *given: seen.append(given)
    )
    root = write_strips(tmp_path, (100, 512))
    settings: Any = {"area": AREA, "fill": "reflect", "upright": "auto", "test_rotation": rotation}
    data = FolderPanoramas(root, EquirectRepresentation(5), **settings)
    judged: list[Any] = []
    data.estimate_up(lambda of, _: judged.append(of))  # type: ignore[arg-type, return-value]
    panorama = data.dataset("test").read(0)
    assert panorama.rgb.any(axis=-1).all()
    ((rgb, _, judge),) = seen
    judge(None)
    assert len(rgb) == 256
    assert panorama.valid is not None
    for colors in (rgb, judged[0].rgb):
        share = colors.any(axis=-1).mean()
        assert share == pytest.approx(panorama.valid.mean(), abs=0.02)


@pytest.mark.parametrize(
    ("settings", "error", "message"),
    [
        ({}, DataError, r"\.png: found 256 × 50 .*twice as wide as high.* All .* data\.area="),
        ({"area": (-180, 180, -45, 45)}, DataError, r"found 256 × 50 .*expected 256 × 64 .*square"),
        ({"area": AREA, "level": 7}, SettingError, r"erp_height: found 256; expected at most 128"),
    ],
)
def test_files_and_settings_that_do_not_fit_are_refused(
    settings: dict[str, Any], error: type[Exception], message: str, tmp_path: Path
) -> None:
    root = write_strips(tmp_path, (50, 256))
    erp = EquirectRepresentation(settings.pop("level", 6))
    with pytest.raises(error, match=message):
        FolderPanoramas(root, erp, **settings).dataset("train")
