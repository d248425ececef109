"""Entry points of the console scripts.

Nothing heavy is imported before Hydra has composed the settings: ``--help`` and a misspelt override
answer at once. ``python -m tangent_train.cli.main train …`` is ``tangent-train …``.
"""

from __future__ import annotations

import logging
import os
import re
import signal
import sys
import threading
from contextlib import contextmanager, redirect_stdout, suppress
from functools import partial
from importlib import import_module
from io import StringIO, TextIOWrapper
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from tangent_train.errors import DataError, SettingError, printable
from tangent_train.files import no_room
from tangent_train.imports import elsewhere

if TYPE_CHECKING:
    from collections.abc import Iterator

    from omegaconf import DictConfig


_NOT_BUILT = {
    "check": ("network", "optimizer", "task", "trainer"),
    "evaluate": ("optimizer",),
    "prepare": ("network", "optimizer", "task", "trainer"),
}
"""Sections of a run that a command does not build: added settings are checked all the same."""


def _main(command: str) -> None:
    """Compose the config ``<command>.yaml`` with the command line and hand it to the command."""
    _prepare_process()
    import hydra
    from hydra.errors import HydraException
    from omegaconf.errors import OmegaConfBaseException

    from tangent_train.cli.compose import config_folder, literal_paths
    from tangent_train.cli.help import annotate
    from tangent_train.cli.processes import end_with_first_process, ended_by_sigterm
    from tangent_train.cli.run_folder import folders
    from tangent_train.cli.setting_names import probable_setting
    from tangent_train.cli.stored import stored_run

    end_with_first_process()
    typed = sys.argv[1:]
    arguments = typed[1:] if __name__ == "__main__" else typed
    visible_gpus = os.environ.get("CUDA_VISIBLE_DEVICES")
    with _refusals(command), _errors_once(), ended_by_sigterm(), folders:
        stored = stored_run(command, arguments)

        def job(config: DictConfig) -> float | None:
            # Lightning starts further processes with this command line: it must be the typed one.
            sys.argv[1:] = typed
            with _refusals(command):
                return _run(command, config, stored, visible_gpus)

        if stored is not None:
            arguments = stored.arguments
        folder = config_folder()
        arguments = ["logger=none" if a == "logger=null" else a for a in arguments]
        if command == "import":
            # A setting, not a choice of Hydra's group of this name: for that it takes no mapping.
            arguments = [re.sub("^network=(.+)", r"network={name:\1}", a) for a in arguments]
        for k, argument in enumerate(arguments):  # Hydra takes no null for a group here
            group = re.fullmatch(r"(\w+)(@[\w.]+)?=null", argument)
            if group is not None and (folder / group[1]).is_dir():
                arguments[k] = f"~{argument.removesuffix('=null')}"
        sys.argv[1:] = literal_paths(command, arguments)
        try:
            os.environ["HYDRA_FULL_ERROR"] = "1"  # Hydra raises what it would print
            run = hydra.main(version_base="1.3", config_path=str(folder), config_name=command)(job)
            if {"--help", "-h"}.intersection(arguments):
                with suppress(SystemExit), redirect_stdout(StringIO()) as printed:
                    run()
                sys.stdout.write(annotate(printed.getvalue(), folder, command))
            else:
                run()
        except (HydraException, OmegaConfBaseException) as error:
            cause = str(error.__cause__ or "").partition("\n")[0]
            if unknown := re.fullmatch(r"Key '(\w+)' is not in struct", cause):
                cause = f"{cause}. {probable_setting(command, unknown[1])}".strip()
            sys.exit(printable(f"tangent-{command}: {error}" + f"\n{cause}" * bool(cause)))
        finally:
            sys.argv[1:] = typed


def _prepare_process() -> None:
    """Print what the encoding of the output lacks escaped; start no module of this folder."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    # Of all processes that are started, whatever starts them: the working directory is not on their
    # path, as it is not on that of the console scripts.
    os.environ["PYTHONSAFEPATH"] = "1"


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


def report() -> None:
    """``tangent-report <run folders>``: tables and a chart over runs."""
    from tangent_train.cli.report import report as write_report

    _prepare_process()
    with _refusals("report"):
        write_report(sys.argv[1:])


def _run(command: str, config: DictConfig, stored: Any, visible_gpus: str | None) -> Any:
    from hydra.core.hydra_config import HydraConfig
    from omegaconf import OmegaConf

    from tangent_train.cli.command_settings import check_settings
    from tangent_train.cli.run_folder import folder_settings
    from tangent_train.cli.setting_names import check_names, declared_settings
    from tangent_train.cli.sweep import in_sweep, run_job
    from tangent_train.registry import check_arguments

    composed: Any = OmegaConf.to_container(config)
    whole = OmegaConf.to_container(HydraConfig.instance().cfg)
    check_names(command, composed, f"{composed} {whole} {folder_settings}")
    if in_sweep():
        return run_job(command, config, () if stored is None else stored.added, visible_gpus)
    logging.getLogger().handlers.clear()  # Hydra's would print again what Lightning prints
    if "SUBMITIT_EXECUTOR" in os.environ:
        # SLURM warns every process; submitit's ends this one, with SIGTERM, for a last checkpoint.
        signal.signal(signal.SIGUSR2, signal.SIG_IGN)
    name = "import_network" if command == "import" else command  # a word of Python
    settings: Any = OmegaConf.to_container(config, resolve=True)
    settings = {n: value for n, value in settings.items() if n in declared_settings(command)}
    if command == "import" and isinstance(settings["network"], dict):
        network = dict(settings["network"])
        settings["network"] = network if len(network) > 1 else network["name"]
    check_settings(command, settings, HydraConfig.get().overrides.task)
    with elsewhere():
        run = getattr(import_module(f"tangent_train.cli.{name}"), name)
        import_module("datamodules.core.split_module")  # for commands that import no library yet
    for override in HydraConfig.get().overrides.task:
        section = override.lstrip("+").partition(".")[0]
        if override[0] == "+" and section in _NOT_BUILT.get(command, ()):
            check_arguments(settings.get(section), section)
    if command == "transfer":  # its stages keep the references of the config
        return run(config)
    return run(settings) if stored is None else run(*stored.settings(settings))


@contextmanager
def _refusals(command: str) -> Iterator[None]:
    """Exit with a one-line message if a setting or a file cannot be used."""
    try:
        yield
        sys.stdout.flush()
    except BrokenPipeError:  # "| head" has read enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(128 + signal.SIGPIPE)
    except (DataError, SettingError, OSError) as error:
        _refuse(command, error)
    except KeyboardInterrupt as error:
        _end(command, error)
    except SystemExit as error:
        if isinstance(error.__cause__, OSError | SettingError):  # of `RunFolder`
            _refuse(command, error.__cause__)
        # Lightning ends an interrupted run with 1.
        if error.code == 1 and isinstance(error.__context__, KeyboardInterrupt):
            _end(command, error.__context__)
        raise


def _refuse(command: str, error: Exception) -> NoReturn:
    """Exit with one line for an error; raise those that the system did not report."""
    if isinstance(error, OSError):
        if error.errno is None:
            raise error
        path = error.filename if isinstance(error.filename, str) else None
        error = (no_room(Path(path), error) if path else None) or SettingError(
            path or "output",
            found=os.strerror(error.errno).lower(),
            expected="a file or folder that can be read and written",
            remedy="Change its permissions, or choose another one (of a run: hydra.run.dir=…).",
        )
    sys.exit(f"tangent-{command}: {error}")


@contextmanager
def _errors_once() -> Iterator[None]:
    """Print no error of a thread that keeps it, as TensorBoard's do: it is raised here too."""
    before = threading.excepthook

    def print_unless_kept(error: threading.ExceptHookArgs) -> None:
        if getattr(error.thread, "exception", None) is not error.exc_value:
            before(error)

    threading.excepthook = print_unless_kept
    try:
        yield
    finally:
        threading.excepthook = before


def _end(command: str, interrupt: KeyboardInterrupt) -> NoReturn:
    """Exit with the status of a shell; the command has printed how to continue."""
    from tangent_train.cli.processes import SigtermError

    received = signal.SIGTERM if isinstance(interrupt, SigtermError) else signal.SIGINT
    sys.stderr.write(f"tangent-{command}: ended by {received.name}\n")
    sys.exit(128 + received)


if __name__ == "__main__":
    _main(sys.argv[1])
