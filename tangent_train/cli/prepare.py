"""``tangent-prepare``: generate or check a data set, and fill its cache."""

from __future__ import annotations

from tangent_train.cli.run import open_data
from tangent_train.config.settings import PrepareSettings
from tangent_train.console import print_text
from tangent_train.manifest import Shard


def prepare(settings: PrepareSettings) -> None:
    """Generate or check the data set of a run, and fill its cache if it has one.

    Args:
        settings: Settings of the command.
    """
    data = open_data(settings)
    if settings.shard is not None:
        shard = Shard.parse(settings.shard)
        count = data.fill_cache(shard.part)
        print_text(f"Shard {shard}: {count} {data.noun} are in {data.cache}.")
    else:
        data.prepare_data()
        data.setup()
        counts = ", ".join(f"{len(data.splits()[s])} {s}" for s in ("train", "val", "test"))
        print_text(f"{data.root} is ready. {data.noun.capitalize()}: {counts}.")
