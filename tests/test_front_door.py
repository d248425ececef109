"""``import tangent_train``: fast, and with the names that people need first."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

import tangent_train
from tangent_train.errors import SettingError
from tangent_train.geometry.sphere import check_area
from tests.running import run_python


def test_names_come_from_their_packages() -> None:
    from tangent_train import geometry, rendering
    from tangent_train.inference import api

    assert tangent_train.TangentGrid is geometry.TangentGrid
    assert tangent_train.load is api.load
    assert tangent_train.apply is api.apply
    for name in ("equirect_to_tangent", "tangent_to_equirect", "tangent_to_labels"):
        assert getattr(tangent_train, name) is getattr(rendering, name)
    assert set(tangent_train.__all__) <= set(dir(tangent_train))
    with pytest.raises(AttributeError, match="no attribute 'missing'"):
        _ = tangent_train.missing


def test_importing_the_package_imports_nothing_heavy() -> None:
    """Nor does listing its names, as notebooks do to complete them."""
    code = """if True:
        import sys, tangent_train
        dir(tangent_train)
        sys.exit(bool({'numpy', 'torch'} & set(sys.modules)))
    """
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


_HEAVY = ("torch", "numba", "cv2", "lightning", "torchmetrics", "torchvision", "transformers")


def _imported(folder: Path, command: str, *arguments: str, names: tuple[str, ...]) -> set[str]:
    """Run a command in a process of its own; return the modules that it has imported."""
    code = f"""if True:
        import sys
        from tangent_train.cli import main
        sys.argv = ['tangent-{command}', *{arguments!r}]
        try:
            main.{command}()
        except SystemExit as end:
            print(end.code or '')
        finally:
            print('imported', *[name for name in {names!r} if name in sys.modules])
    """
    done = run_python(folder, "-c", code)
    return set(done.stdout.rpartition("imported")[2].split())


@pytest.mark.parametrize(
    ("command", "arguments"),
    [
        ("train", ("--help",)),
        ("render", ("--help",)),
        ("render", ("input=missing.jpg", "output=out")),
        ("render", ("input=pano.png", "output=held")),
        ("render", ("input=pano.png", "output=done", "views=cubemap")),
        ("predict", ("checkpoint=missing.ckpt", "input=pano.png", "output=out")),
        ("predict", ("checkpoint=net.ckpt", "input=missing.jpg", "output=out")),
        ("predict", ("checkpoint=net.ckpt", "input=pano.png", "output=held")),
        ("export", ("checkpoint=net.ckpt", "output=pano.png")),
        ("train", ("init_from=missing.ckpt",)),
    ],
)
def test_help_and_refused_paths_import_nothing_heavy(
    tmp_path: Path, command: str, arguments: tuple[str, ...]
) -> None:
    for name in ("pano.png", "net.ckpt", "held/notes.txt", "done/finished.jsonl"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text('{"item": "pano"}')
    (tmp_path / "done" / "manifest.json").write_text('{"views": "horizontal"}')
    assert _imported(tmp_path, command, *arguments, names=_HEAVY) == set()


def test_rendering_and_predicting_import_no_libraries_of_training(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "pano.png"), np.zeros((16, 32, 3), np.uint8))
    arguments = ("input=pano.png", "output=out", "views=cubemap", "level=3")
    names = (*_HEAVY[3:], "matplotlib", "torch._dynamo")
    assert _imported(tmp_path, "render", *arguments, names=("torch", *names)) == set()
    assert len([*tmp_path.glob("out/pano/*.png")]) == 6
    code = f"""if True:
        import sys, tangent_train.cli.predict, tangent_train
        tangent_train.load
        sys.exit(bool(set({names!r}) & set(sys.modules)))
    """
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_modules_of_our_names_that_come_first_are_named(tmp_path: Path) -> None:
    """Python puts the working directory first on the path."""
    (tmp_path / "models.py").write_text("")
    done = run_python(tmp_path, "-c", "import tangent_train")
    assert "models.py has the name of a package of tangent-train: rename it" in done.stderr


UNTYPED: Any = tangent_train
GRID = tangent_train.TangentGrid(0, 3)
SIZE = (32, 32)
RINGS = [{"pitch": 0, "views": 8}]
PANORAMA = np.zeros((16, 32), np.uint8)


@pytest.mark.parametrize("wrong", [[[0, 1]], "room.jpg", 5, None], ids=str)
def test_arguments_of_other_types_are_named(wrong: Any) -> None:
    size, tt = (16, 32), UNTYPED
    calls: dict[str, Any] = {
        "panorama": lambda: tt.equirect_to_tangent(wrong, GRID),
        "grid": lambda: tt.equirect_to_tangent(PANORAMA, wrong),
        "tangent images": lambda: tt.tangent_to_equirect(wrong, GRID, size),
        "scores": lambda: tt.tangent_to_labels(wrong, GRID, size),
        "function": lambda: tt.apply(wrong, PANORAMA, GRID),
        "path": lambda: tt.load(5 if wrong == "room.jpg" else wrong),
    }
    for name, call in calls.items():
        with pytest.raises(TypeError, match=f"^{name}: found [A-Za-z]+; expected "):
            call()


@pytest.mark.parametrize(
    ("given", "name"),
    [
        *(({"rings": None}, "rings"), ({"rings": [8]}, "ring"), ({"rings": "horizontal"}, "ring")),
        ({"rings": [{"pitch": "0", "views": 8}]}, "pitch"),
        *(({"fov_deg": ("90", 90)}, "fov"), ({"valid": [[True]]}, "valid")),
    ],
)
def test_arguments_of_rings_of_other_types_are_named(given: dict[str, Any], name: str) -> None:
    whole = {"rings": RINGS, "fov_deg": (90, 90), "size": SIZE}
    with pytest.raises(TypeError, match=f"^{name}: found [A-Za-z]+; expected "):
        UNTYPED.RingGrid(**whole | given)


@pytest.mark.parametrize(
    "given",
    [
        *({"view_batch_size": -1}, {"view_batch_size": 0}, {"rotations": 0}),
        *({"views": 5}, {"levels": "x"}, {"rotations": "x"}, {"device": 5.5}, {"base_level": [0]}),
    ],
    ids=str,
)
def test_settings_of_other_types_are_named(given: dict[str, Any]) -> None:
    (name,) = given
    with pytest.raises(SettingError, match=rf"^{name}: found .*; expected (a valid|greater) "):
        UNTYPED.load("missing.ckpt", **given)


@pytest.mark.parametrize("area", [5, "abcd", [0, 90], [0, "a", 0, 90]], ids=str)
def test_an_area_of_another_type_is_named(area: Any) -> None:
    with pytest.raises(SettingError, match=r"^area: found \["):
        check_area(area)


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (
            lambda: tangent_train.TangentGrid(0, 20),
            "rows of an image: found 1048576; .* from 1 to 32768",
        ),
        (lambda: tangent_train.RingGrid([], (90, 90), SIZE), "number of rings: found 0; "),
        (lambda: UNTYPED.RingGrid([{"pitch": 0}], (90, 90), SIZE), "views: found None; "),
        (lambda: UNTYPED.RingGrid(RINGS, (90, 90), 32), "size: found 32; expected two numbers"),
        (lambda: UNTYPED.perspective(PANORAMA, {}, 0, 90, 8), "yaw, pitch and roll: found {}, 0"),
        (lambda: tangent_train.apply(np.mean, PANORAMA, GRID, images_per_call=0), "images_per_ca"),
        (lambda: tangent_train.TangentGrid(9, 12), "base_level: found 9; .* from 0 to 8"),
        (lambda: tangent_train.TangentGrid(-1, 4), "base_level: found -1; "),
        (lambda: tangent_train.TangentGrid(0, 4, rotation=5), "rotation: found 5.0; "),
        (lambda: tangent_train.equirect_to_tangent(PANORAMA, GRID, [20]), "faces: .*, 0 to 19"),
    ],
)
def test_sizes_and_indices_out_of_range_are_refused(build: Any, message: str) -> None:
    with pytest.raises(SettingError, match=message):
        build()
