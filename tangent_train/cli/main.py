"""Entry points of the console scripts: compose the settings, validate them, run the command.

Nothing heavy is imported before Hydra has composed the settings, so that ``--help`` and a
misspelled override return immediately.
"""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout, suppress
from functools import partial
from importlib import import_module
from io import StringIO
from pathlib import Path
from shutil import rmtree
from typing import Any

from tangent_train.errors import DataError, SettingError, printable


@contextmanager
def _errors_as_messages(command: str) -> Iterator[None]:
    """Exit with one line for an error of the user's settings or files."""
    from hydra.errors import HydraException
    from omegaconf.errors import OmegaConfBaseException

    try:
        yield
    except (HydraException, OmegaConfBaseException) as error:
        from tangent_train.config.command_line import explained

        message = explained(error, command) or " ".join(str(error).split())
        sys.exit(printable(f"tangent-{command}: {message}"))
    except MemoryError as error:
        remedy = "Choose smaller images or fewer at once."
        sys.exit(f"tangent-{command}: not enough memory. {error}. {remedy}")
    except (DataError, SettingError, OSError) as error:
        sys.exit(printable(f"tangent-{command}: {error}"))
    except Exception as error:
        # Of Hydra for data=5, of Optuna if all runs fail, of Lightning.
        text, kind = " ".join(str(error).split()), type(error).__name__
        known = kind == "ValueError" and re.search("group override|No trials are completed", text)
        if not known and kind != "MisconfigurationException":
            raise
        sys.exit(printable(f"tangent-{command}: {text}"))
    except KeyboardInterrupt:
        sys.exit(130)


@contextmanager
def _unused_folder_removed(command: str) -> Iterator[None]:
    """Remove the run folder of a refused command, if it has only Hydra's files and the log."""
    from hydra.core.hydra_config import HydraConfig

    try:
        yield
    except (DataError, SettingError):
        config = HydraConfig.get()
        folder = Path(config.runtime.output_dir)
        names = {path.name for path in folder.iterdir()} - {f"{command}.log"}
        if names == {".hydra"} and "run.dir=" not in str(config.overrides.hydra):
            rmtree(folder)
        raise


def _run(command: str, settings: Any) -> Any:
    """Run a command; runs have a log file."""
    from hydra.core.hydra_config import HydraConfig

    from tangent_train.console import log_to

    name = {"import": "import_network"}.get(command, command)  # import is a keyword
    function = getattr(import_module(f"tangent_train.cli.{name}"), name)
    if command not in ("train", "evaluate") or os.environ.get("LOCAL_RANK", "0") != "0":
        return function(settings)
    with log_to(Path(HydraConfig.get().runtime.output_dir, f"{command}.log")):
        return function(settings)


def _main(command: str) -> None:
    """Run a command with the settings that Hydra composes from the command line."""
    _print_version(command)
    import hydra

    from tangent_train.cli.processes import OF_SWEEPS, in_sweep, run_job
    from tangent_train.config.command_line import check_words, with_help
    from tangent_train.config.help import annotate, listed_by_files
    from tangent_train.config.settings import config_name, missing_groups, refuse_typed, validate
    from tangent_train.files import config_folder

    def job(config: Any) -> Any:
        missing = missing_groups(command)
        if in_sweep() and not missing:  # outside the block: the other jobs go on
            return run_job(command)
        # Inside: Hydra prints a line for other exceptions.
        with _errors_as_messages(command), _unused_folder_removed(command):
            refuse_typed(OF_SWEEPS, f"a sweep: tangent-{command} -m …")
            settings = validate(command, config, missing)
            import_module("tangent_train.cli.paths").check_paths(settings)
            return _run(command, settings)

    os.environ["HYDRA_FULL_ERROR"] = "1"  # errors are raised here, not printed by Hydra
    with _errors_as_messages(command):
        sys.argv[1:] = with_help(sys.argv[1:])
        check_words(command, sys.argv[1:])
        name = config_name(command, sys.argv[1:])
        run = hydra.main(version_base="1.3", config_path=str(config_folder()), config_name=name)
        if {"--help", "-h"}.isdisjoint(sys.argv):
            run(job)()
            return
        with suppress(SystemExit), redirect_stdout(StringIO()) as printed, listed_by_files():
            run(job)()
        sys.stdout.write(annotate(printed.getvalue(), command))


def _print_version(command: str) -> None:
    """Print the version and exit if the command line asks for it."""
    if "--version" in sys.argv[1:]:
        import tangent_train

        sys.stdout.write(f"tangent-{command} {tangent_train.__version__}\n")
        sys.exit()


def report() -> None:
    """Run ``tangent-report <run folders>``: write tables and a chart over runs."""
    _print_version("report")
    from tangent_train.cli.report import report as write_report
    from tangent_train.config.command_line import with_help

    with _errors_as_messages("report"):
        write_report(with_help(sys.argv[1:]))


def overview() -> None:
    """Print the commands of the package, for ``python -m tangent_train``."""
    _print_version("train")
    from tangent_train.config.help import description
    from tangent_train.files import config_folder

    files = [path for path in sorted(config_folder().glob("*.yaml")) if path.stem != "run"]
    lines = [description(path)[0] for path in files]
    lines.append("tangent-report compares finished runs, also with published scores.\n")
    sys.stdout.write("\n".join([*lines, "--help explains the settings of a command.\n"]))


train = partial(_main, "train")
evaluate = partial(_main, "evaluate")
prepare = partial(_main, "prepare")
check = partial(_main, "check")
transfer = partial(_main, "transfer")
predict = partial(_main, "predict")
render = partial(_main, "render")
export = partial(_main, "export")
import_network = partial(_main, "import")
keypoints = partial(_main, "keypoints")

if __name__ == "__main__":
    overview()
