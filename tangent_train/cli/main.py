"""Entry points of the console scripts: compose the settings, validate them, run the command.

Nothing heavy is imported before Hydra has composed the settings, so that ``--help`` and a
misspelled override return immediately.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout, suppress
from functools import partial
from importlib import import_module
from io import StringIO
from typing import Any

from tangent_train.errors import DataError, SettingError, nearest, printable


@contextmanager
def _errors_as_messages(command: str) -> Iterator[None]:
    """Exit with one line for an error of the user's settings or files."""
    from hydra.errors import HydraException
    from omegaconf.errors import OmegaConfBaseException

    try:
        yield
    except (DataError, SettingError, HydraException, OmegaConfBaseException, OSError) as error:
        known = getattr(error.__cause__, "parent_node", None)  # of an override without a setting
        remedy = nearest(str(getattr(error.__cause__, "key", "")), map(str, known or ()))
        sys.exit(printable(f"tangent-{command}: {error}\n{remedy}".rstrip()))
    except KeyboardInterrupt:
        sys.exit(130)


def _main(command: str) -> None:
    """Run a command with the settings that Hydra composes from the command line."""
    import hydra

    from tangent_train.cli.processes import in_sweep, run_job
    from tangent_train.config.help import annotate
    from tangent_train.config.settings import config_name, validate
    from tangent_train.files import config_folder

    def job(config: Any) -> Any:
        if in_sweep():  # outside the block: the other jobs go on
            return run_job(command)
        with _errors_as_messages(command):  # inside: Hydra prints a line for other exceptions
            settings = validate(command, config)
            name = {"import": "import_network"}.get(command, command)  # import is a keyword
            return getattr(import_module(f"tangent_train.cli.{name}"), name)(settings)

    os.environ["HYDRA_FULL_ERROR"] = "1"  # errors are raised here, not printed by Hydra
    with _errors_as_messages(command):
        name = config_name(command, sys.argv[1:])
        run = hydra.main(version_base="1.3", config_path=str(config_folder()), config_name=name)
        if {"--help", "-h"}.isdisjoint(sys.argv):
            run(job)()
            return
        with suppress(SystemExit), redirect_stdout(StringIO()) as printed:
            run(job)()
        sys.stdout.write(annotate(printed.getvalue(), command))


def report() -> None:
    """Run ``tangent-report <run folders>``: write tables and a chart over runs."""
    from tangent_train.cli.report import report as write_report

    with _errors_as_messages("report"):
        write_report(sys.argv[1:])


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
