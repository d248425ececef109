"""``tangent-prepare``: generate or check a data set, and its prepared store if set."""

from __future__ import annotations

from tangent_train.cli.build import Settings
from tangent_train.cli.each import Shard
from tangent_train.registry import make
from tangent_train.say import say


def prepare(settings: Settings) -> None:
    """Generate or check the data set.

    Args:
        settings: The composed ``prepare.yaml``.
    """
    shard = Shard.of(settings["shard"])
    representation = make(settings["representation"], "representation")
    data = make(settings["data"], "data", representation=representation)
    if shard is not None:
        count = data.prepare_part(shard.part)
        say(f"Shard {shard}: {count} {data.noun} are in {data.store}.")
    else:
        data.prepare_data()
        data.setup()
        counts = ", ".join(f"{len(data.found().splits[s])} {s}" for s in ("train", "val", "test"))
        say(f"{data.root} is ready. {data.noun.capitalize()}: {counts}.")
