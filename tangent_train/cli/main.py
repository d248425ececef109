"""Entry points of the console scripts.

Nothing heavy is imported before the settings are known to be right: ``--help`` and a misspelt
override answer at once. ``python -m tangent_train.cli.main train …`` is ``tangent-train …``.
"""

from __future__ import annotations

import os
import sys
from importlib import import_module
from typing import TYPE_CHECKING, Any

from tangent_train.errors import DataError, SettingError

if TYPE_CHECKING:
    from collections.abc import Callable

    from omegaconf import DictConfig

__all__ = [
    "check",
    "evaluate",
    "export",
    "keypoints",
    "predict",
    "prepare",
    "render",
    "report",
    "train",
    "transfer",
]

_MODULES = {
    "check": "check",
    "export": "export",
    "keypoints": "keypoints",
    "predict": "predict",
    "render": "render",
    "transfer": "transfer",
}
"""Where a command is, if not in `run`."""

_OF_FILES = ("export", "keypoints", "predict", "render")
"""Commands whose paths are taken as they are, whatever characters are in them."""


def train() -> None:
    """``tangent-train``: train a network, then evaluate it."""
    _main("train")


def evaluate() -> None:
    """``tangent-evaluate checkpoint=…``: evaluate a checkpoint."""
    _main("evaluate")


def prepare() -> None:
    """``tangent-prepare data=…``: make or check a data set."""
    _main("prepare")


def check() -> None:
    """``tangent-check data=…``: everything that is wrong with a data set."""
    _main("check")


def transfer() -> None:
    """``tangent-transfer experiment=…``: train on photos, evaluate on panoramas."""
    _main("transfer")


def predict() -> None:
    """``tangent-predict checkpoint=… input=… output=…``: label images of one's own."""
    _main("predict")


def render() -> None:
    """``tangent-render input=… output=…``: tangent images as files, and back."""
    _main("render")


def export() -> None:
    """``tangent-export checkpoint=… format=…``: the network for other programs."""
    _main("export")


def keypoints() -> None:
    """``tangent-keypoints data=…``: keypoints of pairs of panoramas, matched and scored."""
    _main("keypoints")


def report() -> None:
    """``tangent-report <run folders>``: tables and a chart over runs."""
    from tangent_train.cli.report import report as write_report

    _with_arguments("report", write_report)


def _with_arguments(command: str, run: Callable[[list[str]], None]) -> None:
    try:
        run(sys.argv[1:])
    except (DataError, SettingError) as error:
        sys.exit(f"tangent-{command}: {error}")
    except KeyboardInterrupt:
        sys.exit(130)


def _main(command: str) -> None:
    typed = sys.argv[1:]
    try:
        _compose_and_run(command, typed)
    except (DataError, SettingError) as error:
        sys.exit(f"tangent-{command}: {error}")
    except KeyboardInterrupt:
        sys.exit(130)  # as a shell says it; runs have said how to go on
    finally:
        sys.argv[1:] = typed


def _compose_and_run(command: str, typed: list[str]) -> None:
    from hydra.core.hydra_config import HydraConfig
    from omegaconf import OmegaConf

    from tangent_train.cli.compose import check_overrides, quote_path
    from tangent_train.cli.stored import CHOOSABLE, stored_run

    as_module = __name__ == "__main__"
    arguments = typed[1:] if as_module else typed
    if command in _OF_FILES:
        arguments = [quote_path(argument) for argument in arguments]
    said, config_name = arguments, command
    stored = stored_run(command, arguments)
    if stored is None:
        check_overrides(command, arguments)
    else:
        choosable = CHOOSABLE if command == "evaluate" else ()
        check_overrides(stored.name, stored.arguments, stored.known, choosable)
        arguments, config_name = stored.additions(), stored.name
    visible_gpus = os.environ.get("CUDA_VISIBLE_DEVICES")

    def job(config: DictConfig) -> float | None:
        # Lightning starts further processes with this command line: it must be the typed one.
        sys.argv[1:] = typed
        from tangent_train.cli.sweep import in_sweep, leave_warnings_to_the_sweep, run_job

        try:
            settings: Any = OmegaConf.to_container(config, resolve=True)
            if in_sweep():
                return run_job(command, said, visible_gpus, settings)
            leave_warnings_to_the_sweep()
            commands = import_module(f"tangent_train.cli.{_MODULES.get(command, 'run')}")
            run = getattr(commands, command)
            if stored is None:  # the stages of a transfer keep the references of its config
                result: float | None = run(config if command == "transfer" else settings)
            else:
                chosen = HydraConfig.get().runtime.choices
                result = run(*stored.settings(settings, [g for g in CHOOSABLE if g in chosen]))
        except (DataError, SettingError) as error:
            sys.exit(f"tangent-{command}: {error}")
        return result

    try:
        _run_hydra(job, config_name, arguments)
    except (NotADirectoryError, PermissionError) as error:
        unwritable = SettingError(
            error.filename or "output",
            found=(error.strerror or str(error)).lower(),
            expected="a file or folder that can be read and written",
            remedy="Change its permissions, or choose another one (of a run: hydra.run.dir=…).",
        )
        sys.exit(f"tangent-{command}: {unwritable}")


def _run_hydra(
    job: Callable[[DictConfig], float | None], config_name: str, arguments: list[str]
) -> None:
    import hydra
    from hydra._internal.utils import get_args_parser
    from hydra.errors import CompactHydraException
    from omegaconf.errors import OmegaConfBaseException

    from tangent_train.cli.compose import config_folder

    # Lightning prints its own messages: Hydra's handlers would print them again. A sweep has only
    # Hydra's. argparse wants all overrides in one place.
    several = get_args_parser().parse_args(arguments).multirun
    quiet = ["hydra/job_logging=none"] + ["hydra/hydra_logging=none"] * (not several)
    places = (i for i, a in enumerate(arguments) if a[:1] == "~" or ("=" in a and a[0] != "-"))
    place = next(places, len(arguments))
    sys.argv[1:] = [*arguments[:place], *quiet, *arguments[place:]]
    os.environ["HYDRA_FULL_ERROR"] = "1"  # raises what it would print
    run = hydra.main(version_base="1.3", config_path=str(config_folder()), config_name=config_name)
    try:
        run(job)()
    except CompactHydraException as error:  # of Hydra itself, which says what is wrong
        sys.exit(str(error))
    except OmegaConfBaseException as error:
        found = str(error.msg or error).partition("\n")[0]
        raise SettingError(
            error.full_key or "config", found=found, expected="settings that can be resolved"
        ) from error
    except RuntimeError as error:
        if not several:
            raise
        sys.exit(str(error))  # of a launcher: jobs have said what was wrong with them


if __name__ == "__main__":
    _main(sys.argv[1])
