"""Entry points of the console scripts.

Nothing heavy is imported before Hydra has composed the settings: ``--help`` and a misspelled
override return immediately. ``python -m tangent_train.cli.main train …`` is ``tangent-train …``.
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
    "prepare": ("network", "optimizer", "task", "trainer"),
}
"""Sections that a command does not build; settings that the user adds to them are still checked."""


def _main(command: str) -> None:
    """Compose ``<command>.yaml`` with the command line and run the command with the result."""
    _prepare_process()
    import hydra
    from hydra.errors import HydraException
    from omegaconf.errors import OmegaConfBaseException

    from tangent_train.cli.compose import literal_paths, overrides_first
    from tangent_train.cli.help import annotate
    from tangent_train.cli.processes import end_with_first_process, ended_by_sigterm
    from tangent_train.cli.run_folder import folders
    from tangent_train.cli.setting_names import probable_name
    from tangent_train.cli.stored import stored_run
    from tangent_train.files import config_folder

    end_with_first_process()
    typed_arguments = sys.argv[1:]
    arguments = typed_arguments[1:] if __name__ == "__main__" else typed_arguments
    visible_gpus = os.environ.get("CUDA_VISIBLE_DEVICES")
    with _errors_as_messages(command), _thread_errors_once(), ended_by_sigterm(), folders:
        stored = stored_run(command, arguments)

        def job(config: DictConfig) -> float | None:
            # Lightning starts further processes with this command line: it must be the user's.
            sys.argv[1:] = typed_arguments
            with _errors_as_messages(command):
                return _run(command, config, stored, visible_gpus)

        if stored is not None:
            arguments = stored.arguments
        folder = config_folder()
        arguments = ["logger=none" if a == "logger=null" else a for a in arguments]
        if command == "import":
            # As a mapping, Hydra reads it as a setting instead of an option of the group network.
            arguments = [re.sub("^network=(.+)", r"network={name:\1}", a) for a in arguments]
        for k, argument in enumerate(arguments):  # Hydra refuses null for a group on a command line
            group = re.fullmatch(r"(\w+)(@[\w.]+)?=null", argument)
            if group is not None and (folder / group[1]).is_dir():
                arguments[k] = f"~{argument.removesuffix('=null')}"
        sys.argv[1:] = literal_paths(command, overrides_first(arguments))
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
            cause = f"{cause}. {probable_name(command, str(error))}".strip(". ")
            sys.exit(printable(f"tangent-{command}: {error}" + f"\n{cause}" * bool(cause)))
        finally:
            sys.argv[1:] = typed_arguments


def _prepare_process() -> None:
    """Escape characters that the output cannot encode; never import from the working directory."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    # Console scripts do not have the working directory on their path; nor do processes they start.
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
    """Run ``tangent-report <run folders>``: write tables and a chart over runs."""
    from tangent_train.cli.report import report as write_report

    _prepare_process()
    with _errors_as_messages("report"):
        write_report(sys.argv[1:])


def _run(command: str, config: DictConfig, stored: Any, visible_gpus: str | None) -> Any:
    from hydra.core.hydra_config import HydraConfig
    from omegaconf import OmegaConf

    from tangent_train.cli.command_settings import check_settings
    from tangent_train.cli.run_folder import folder_settings
    from tangent_train.cli.setting_names import check_names, declared_settings
    from tangent_train.cli.sweep import in_sweep, run_job
    from tangent_train.config.build import check_arguments
    from tangent_train.config.settings import validate

    composed: Any = OmegaConf.to_container(config)
    hydra_settings = OmegaConf.to_container(HydraConfig.instance().cfg)
    check_names(command, composed, f"{composed} {hydra_settings} {folder_settings}")
    if in_sweep():
        return run_job(command, config, () if stored is None else stored.added, visible_gpus)
    logging.getLogger().handlers.clear()  # with Hydra's handlers, messages are printed twice
    if "SUBMITIT_EXECUTOR" in os.environ:
        # SLURM signals every process. submitit's then sends SIGTERM here, for a last checkpoint.
        signal.signal(signal.SIGUSR2, signal.SIG_IGN)
    name = "import_network" if command == "import" else command  # import is a keyword
    settings: Any = OmegaConf.to_container(config, resolve=True)
    settings = {n: value for n, value in settings.items() if n in declared_settings(command)}
    if command == "import" and isinstance(settings["network"], dict):
        network = dict(settings["network"])
        settings["network"] = network if len(network) > 1 else network["name"]
    check_settings(command, settings, HydraConfig.get().overrides.task)
    with elsewhere():
        run = getattr(import_module(f"tangent_train.cli.{name}"), name)
        import_module("datamodules.core.split_module")  # some commands have not imported it yet
    for override in HydraConfig.get().overrides.task:
        section = override.lstrip("+").partition(".")[0]
        if override[0] == "+" and section in _NOT_BUILT.get(command, ()):
            check_arguments(settings.get(section), section)
    if command in ("export", "keypoints", "render"):
        return run(validate(command, settings))
    if command == "transfer":  # its stages need the config with its references
        return run(config)
    return run(settings) if stored is None else run(*stored.settings(settings))


@contextmanager
def _errors_as_messages(command: str) -> Iterator[None]:
    """Exit with a one-line message if a setting or a file cannot be used."""
    try:
        yield
        sys.stdout.flush()
    except BrokenPipeError:  # the reader has closed the pipe, e.g. "| head"
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(128 + signal.SIGPIPE)
    except (DataError, SettingError, OSError) as error:
        _exit_with_message(command, error)
    except KeyboardInterrupt as error:
        _exit_interrupted(command, error)
    except SystemExit as error:
        if isinstance(error.__cause__, OSError | SettingError):  # raised by `RunFolder`
            _exit_with_message(command, error.__cause__)
        # Lightning ends an interrupted run with 1.
        if error.code == 1 and isinstance(error.__context__, KeyboardInterrupt):
            _exit_interrupted(command, error.__context__)
        raise


def _exit_with_message(command: str, error: Exception) -> NoReturn:
    """Exit with one line for an error; re-raise an `OSError` without an error number."""
    if isinstance(error, OSError):
        if error.errno is None:
            raise error
        path = error.filename if isinstance(error.filename, str) else None
        error = (no_room(Path(path), error) if path else None) or SettingError(
            path or "output",
            found=os.strerror(error.errno).lower(),
            expected="a file or folder that can be read and written",
            remedy="Change its permissions, or choose another one (for a run: hydra.run.dir=…).",
        )
    sys.exit(f"tangent-{command}: {error}")


@contextmanager
def _thread_errors_once() -> Iterator[None]:
    """Do not print errors that a thread stores (e.g. TensorBoard's): they are raised here too."""
    before = threading.excepthook

    def print_unless_stored(error: threading.ExceptHookArgs) -> None:
        if getattr(error.thread, "exception", None) is not error.exc_value:
            before(error)

    threading.excepthook = print_unless_stored
    try:
        yield
    finally:
        threading.excepthook = before


def _exit_interrupted(command: str, interrupt: KeyboardInterrupt) -> NoReturn:
    """Exit with a shell's status for the signal; the command has printed how to continue."""
    from tangent_train.cli.processes import SigtermError

    received = signal.SIGTERM if isinstance(interrupt, SigtermError) else signal.SIGINT
    sys.stderr.write(f"tangent-{command}: ended by {received.name}\n")
    sys.exit(128 + received)


if __name__ == "__main__":
    _main(sys.argv[1])
