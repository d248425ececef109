"""Entry points of the console scripts.

Nothing heavy is imported before the settings are known to be right: ``--help`` and a misspelt
override answer at once.
"""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

from tangent_train.errors import DataError, SettingError

if TYPE_CHECKING:
    from omegaconf import DictConfig

__all__ = ["evaluate", "prepare", "train"]


def train() -> None:
    """``tangent-train``: train a network, then evaluate it."""
    _main("train")


def evaluate() -> None:
    """``tangent-evaluate checkpoint=…``: evaluate a checkpoint."""
    _main("evaluate")


def prepare() -> None:
    """``tangent-prepare data=…``: make or check a data set."""
    _main("prepare")


def _main(command: str) -> None:
    typed = sys.argv[1:]
    try:
        _compose_and_run(command, typed)
    except (DataError, SettingError) as error:
        sys.exit(f"tangent-{command}: {error}")
    finally:
        sys.argv[1:] = typed


def _compose_and_run(command: str, typed: list[str]) -> None:
    import hydra
    from hydra.errors import InstantiationException

    from tangent_train.cli.compose import check_overrides, config_folder, with_stored_config

    config_name, arguments = with_stored_config(command, typed)
    check_overrides(config_name, arguments)

    def job(config: DictConfig) -> None:
        # Lightning starts further processes with this command line: it must be the typed one.
        sys.argv[1:] = typed
        from tangent_train.cli import run

        try:
            getattr(run, command)(config)
        except (DataError, SettingError) as error:
            sys.exit(f"tangent-{command}: {error}")
        except InstantiationException as error:
            if isinstance(error.__cause__, DataError | SettingError):
                sys.exit(f"tangent-{command}: {error.__cause__}")
            raise

    # Lightning prints its own messages: Hydra's handlers would print them again. argparse wants all
    # overrides in one place.
    quiet = ["hydra/job_logging=none", "hydra/hydra_logging=none"]
    place = next((i for i, a in enumerate(arguments) if "=" in a and a[0] != "-"), len(arguments))
    sys.argv[1:] = [*arguments[:place], *quiet, *arguments[place:]]
    hydra.main(version_base="1.3", config_path=str(config_folder()), config_name=config_name)(job)()
