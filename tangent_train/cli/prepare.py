"""``tangent-prepare``: generate or check a data set, and fill its cache."""

from __future__ import annotations

from tangent_train.cli import main
from tangent_train.cli.run import open_data
from tangent_train.config.settings import RunSettings
from tangent_train.console import print_text


def prepare(settings: RunSettings) -> None:
    """Generate or check the data set of a run, and fill its cache if it has one.

    Args:
        settings: Settings of the command.
    """
    data = open_data(settings)
    data.prepare_data()
    counts = ", ".join(f"{len(files)} {split}" for split, files in data.splits().items())
    print_text(f"{data.root} is ready. {data.noun.capitalize()}: {counts}.")


if __name__ == "__main__":
    main.prepare()
