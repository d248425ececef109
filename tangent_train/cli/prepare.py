"""``tangent-prepare``: generate or check a data set, and fill its cache."""

from __future__ import annotations

from tangent_train.cli import main
from tangent_train.cli.run import open_data
from tangent_train.config.settings import PrepareSettings
from tangent_train.console import print_text
from tangent_train.manifest import Shard


def prepare(settings: PrepareSettings) -> None:
    """Generate or check the data set of a run, and fill its cache if it has one.

    Args:
        settings: Settings of the command.
    """
    data, shard = open_data(settings), Shard.parse(settings.shard)
    data.refuse("cache", settings.shard and data.cache is None, "a folder that shard= fills partly")
    count = data.prepare(shard)
    if settings.shard is not None:
        print_text(f"Shard {shard}: {count} {data.noun} are in {data.cache}.")
    else:
        counts = ", ".join(f"{len(files)} {split}" for split, files in data.splits().items())
        print_text(f"{data.root} is ready. {data.noun.capitalize()}: {counts}.")


if __name__ == "__main__":
    main.prepare()
