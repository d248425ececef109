"""The commands and files in README and docs, and the settings that run a command on small data."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

from tests.running import composed

TIME = "2026-01-31_12-00-00"
STAND_INS = {
    "checkpoint": f"runs/demo/{TIME}/checkpoints/best.ckpt",
    "data.root": "data/rooms_demo",
    "experiment": "rooms/demo",
    "input": "panoramas",
    "resume": f"runs/demo/{TIME}",
}
"""Values for ``…`` and ``<placeholder>``."""

SMALL: dict[str, Any] = {
    "level": 6,
    "representation.erp_height": 128,
    "representation.faces_per_panorama": 2,
    "network.depth": 50,
    "network.weights": "null",
    "network.width": 2,
    "data.num_workers": 0,
    "data.batch_size": 2,
    "data.val_fraction": 0.3,
    "data.frames": 2,
    "data.panorama_height": 128,
    **{f"data.rooms.rooms.area_{area}": 2 for area in ("1", "2", "3", "4", "5a", "5b", "6")},
    "data.rooms.height": 128,
    "data.rooms.view_size": 64,
    "data.rooms.views_per_camera": 2,
    "data.rooms.supersample": 1,
    "data.shapes.train": 3,
    "data.shapes.test": 1,
    "trainer.max_epochs": 1,
    "trainer.check_val_every_n_epoch": 1,
    "trainer.accelerator": "cpu",
    "trainer.devices": 1,
    "trainer.num_nodes": 1,
    "trainer.precision": "32-true",  # bf16 takes 20 times as long on a CPU that does not know it
    "panels": 1,
    "photos.data.batch_size": 2,
    "photos.data.num_workers": 0,
    "compare": "[]",
    "conditions": "[upright]",
    "fine_tuning.epochs": "[]",
    "seeds": "[0]",
    "folds": "[1]",
    "max_pairs": 2,
}
"""Settings appended to a command whose config has them with a value that is not null."""

CONFIGS = {
    "tangent-train": "train",
    "tangent-transfer": "transfer",
    "tangent-prepare": "prepare",
    "tangent-check": "check",
    "tangent-keypoints": "keypoints",
}
"""Programs to which these settings are appended, and their configs."""

_FENCE = re.compile(r"^( *)```+(\w*)\n(.*?)^\1```+$", re.MULTILINE | re.DOTALL)
_FILE = re.compile(r"^# (\S+\.\w+)\n")
_OPEN = re.compile(r"…|<[^<>]*>")


@dataclass
class Block:
    """Commands that belong together, or a Python program.

    Attributes:
        location: Page and line.
        commands: Lines of a shell; continued lines are joined.
        python: The Python program.
        files: Contents of the files that the page shows, by path.
    """

    location: str
    commands: list[str] = field(default_factory=list)
    python: str = ""
    files: dict[str, str] = field(default_factory=dict)


def find_blocks(name: str, text: str) -> Iterator[Block]:
    """Return the commands and programs of a Markdown page."""
    fences = [(m.start(), m[2], re.sub(rf"^{m[1]}", "", m[3], flags=re.M)) for m in
              _FENCE.finditer(text)]  # fmt: skip
    files = {found[1]: body for _, _, body in fences if (found := _FILE.match(body))}
    for start, language, body in fences:
        location = f"{name}:{text.count(chr(10), 0, start) + 1}"
        if language in ("bash", "sh", "shell", "console"):
            lines = body.replace("\\\n", " ").splitlines()
            yield Block(location, [line.removeprefix("$ ") for line in lines], files=files)
        elif language == "python" and not _FILE.match(body):
            yield Block(location, python=body, files=files)


def split_line(line: str) -> tuple[dict[str, str], list[str]]:
    """Return the variables and words of a command line before a pipe, split like a shell does."""
    joined = _OPEN.sub(lambda found: found[0].replace(" ", "_"), line.partition(" | ")[0])
    words = shlex.split(joined, comments=True)
    variables: dict[str, str] = {}
    while words and (words[0] == "export" or re.match(r"\w+=", words[0])):
        name, _, value = words.pop(0).partition("=")
        variables |= {name: value} if value else {}
    return variables, words


def fill_in(words: list[str], world: Path) -> list[str]:
    """Replace placeholders and absolute paths by files of the world, and a sweep by one run."""
    program, *arguments = [word for word in words if word != "…"]
    if "…" in words and program == "tangent-predict":
        arguments += ["input=panoramas", "output=labels"]
    is_sweep = program != "python" and "-m" in arguments
    filled = []
    for word in arguments:
        name, equals, value = word.replace("=/", "=").rpartition("=")
        if _OPEN.fullmatch(value):
            value = STAND_INS[name]
        elif _OPEN.search(value):
            parts = ("**" if _OPEN.fullmatch(p) else _OPEN.sub("*", p) for p in value.split("/"))
            found = sorted(world.glob("/".join(parts)))
            assert found, f"no file matches {word}"
            value = str(found[0].relative_to(world))
        if is_sweep and not value.startswith(("[", "{")):
            value = value.partition(",")[0]
        filled.append(f"{name}{equals}{value}")
    if program == "tangent-predict" and not any(word.startswith("depth=") for word in arguments):
        filled = [re.sub("runs/(demo|student)", "runs/rgb", word) for word in filled]
    if "data=stanford2d3ds_pairs" in filled:
        filled = [word.replace("data/2d3ds", "data/pairs") for word in filled]
    if is_sweep:
        filled = [word for word in filled if not word.startswith(("-m", "sweep=", "launcher="))]
    return [program, *filled]


def small_settings(words: list[str], world: Path) -> list[str]:
    """Return settings that let a command take seconds."""
    program, *arguments = words
    if program == "python":
        return ["--help"] if arguments[0] == "-m" else []
    if "--help" in arguments or any(word.startswith("resume=") for word in arguments):
        return []
    has_data = any(word.startswith(("data=", "experiment=")) for word in arguments)
    config = CONFIGS.get(program, "train" if has_data else None)
    if config is None or any(word.startswith(("left=", "input=")) for word in arguments):
        return []
    overrides = [
        w for w in arguments if "=" in w and not w.startswith(("sweep=", "launcher=", "hydra."))
    ]
    if program == "tangent-evaluate":
        groups = ("data=", "experiment=", "representation=")
        overrides = [word for word in overrides if word.startswith(groups)]
    folders = (
        [world / arguments[arguments.index("--config-dir") + 1]]
        if "--config-dir" in arguments
        else []
    )
    search = ",".join(f"file://{folder}" for folder in folders)
    found = composed(config, *overrides, f"hydra.searchpath=[{search}]")
    settings = {n: v for n, v in SMALL.items() if OmegaConf.select(found, n) is not None}
    evaluates = {"experiment=zero_shot", "checkpoint=cityscapes.ckpt"} & set(arguments)
    if evaluates:  # a transfer without training refuses these
        settings = {
            n: v for n, v in settings.items() if not n.startswith(("fine_tuning", "network"))
        }
    if program == "tangent-evaluate":
        sections = ["data.rooms", "data.shapes"]
        if any(word.startswith("representation=") for word in arguments):  # else that of the file
            sections.append("representation.")
        settings = {n: v for n, v in settings.items() if n.startswith(tuple(sections))}
    return [f"{name}={value}" for name, value in settings.items()]
