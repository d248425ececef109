"""Settings that would run, fetch, read or write something if anything interpreted them."""

from __future__ import annotations

import copy
from collections import OrderedDict
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import reduce
from operator import getitem
from pathlib import Path
from typing import Any

import torch

from tangent_train.config import build as registry

CANARY = "attack_canary"
"""A module that only attacks name; it does not exist, and asking for it is seen."""

_NAMES = (
    f"{CANARY}.fire",
    "os.mkdir",
    "antigravity.fly",
    "torch.utils.collect_env.run",
    "torch.load",
    "builtins.eval",
    "models.initialization",
    "models.fcn_resnet.torch.hub.load",
    "tangent_train.files.write_text",
    "datamodules.__builtins__",
    "lightning.LightningModule.load_from_checkpoint",
    "torchvision.models.get_model",
    "segmentation_models_pytorch.from_pretrained",
)


def json_attacks(forbidden: Path) -> Iterator[Any]:
    """Those that JSON and YAML can hold as well.

    Args:
        forbidden: An existing folder that only attacks name.
    """
    command = {"_target_": f"{CANARY}.fire", "path": str(forbidden / "x")}
    for name in _NAMES:
        yield {"_target_": name, "path": str(forbidden / "x")}
    yield command | {"_partial_": True}
    yield [command]
    yield {"inner": command}
    yield {"_target_": "models.UNet", "in_channels": command, "num_classes": 3}
    # Positional arguments.
    yield {"_target_": "timm.create_model", "_args_": ["resnet18", True, {"hf_hub_id": "a/b"}]}
    yield {"_target_": "torch.nn.Sequential", "_args_": [command]}
    yield {"_target_": "torch.nn.Conv2d", "_args_": [3, 3, 1], "_convert_": "all"}
    # Addresses and files.
    yield {"_target_": "timm.create_model", "model_name": f"local-dir:{forbidden}"}
    yield {"_target_": "timm.create_model", "model_name": "hf-hub:a/b", "pretrained": True}
    weights = {"checkpoint_path": str(forbidden / "x")}
    yield {"_target_": "timm.create_model", "model_name": "resnet18", **weights}
    yield {"_target_": "models.FCNResNet", "weights": str(forbidden / "x"), "depth": 50}
    yield {"options": {"cpp.cxx": f"sh -c 'id > {forbidden}/x'"}}
    yield str(forbidden / "x")
    yield "https://example.invalid/x"
    yield "../../x"
    # Interpolations, plain and nested.
    for resolver in ("oc.env:SECRET", "oc.create:" + str(command).replace("'", ""), "bag"):
        yield f"${{{resolver}}}"
        yield f"x ${{ {resolver} }} y"
    yield f"${{oc.${{c}}:{{_target_: {CANARY}.fire}}}}"
    yield {"c": "create", "x": f"${{oc.${{.c}}:{{_target_: {CANARY}.fire}}}}"}
    # Texts where mappings are expected, wrong types.
    yield f"_target_: {CANARY}.fire\npath: x\n"
    yield from ("", 0, -1, 3, True, None, 1e308, 10**30, [], {}, [None], {"": ""}, "nan")
    deep: Any = command
    for _ in range(100):
        deep = [deep]
    yield deep
    yield {"_target_": ["os.mkdir"]}
    yield {"_target_": None}
    yield {"_target_": "", "_partial_": "yes"}


def undeclared_settings(forbidden: Path) -> Iterator[dict[str, Any]]:
    """Settings for a config of transformers that no network declares."""
    quantizer = {"quant_method": "awq", "bits": 4}
    yield {"quantization_config": quantizer}
    for alias in ("x", "hidden_size", "model_type", "attribute_map"):
        yield {"attribute_map": {alias: "quantization_config"}, "x": quantizer}
    yield {"attribute_map": {"x": "_attn_implementation"}, "x": f"{CANARY}/kernel"}
    yield {"attn_implementation": f"{CANARY}/kernel"}
    yield {"_attn_implementation_internal": f"{CANARY}/kernel", "use_kernels": True}
    yield {"auto_map": {"AutoConfig": f"{CANARY}.Config"}, "trust_remote_code": True}
    yield {"sub_configs_defaults": {"x": {"model_type": "timm_backbone", "backbone": "gpt2"}}}
    yield {"backbone": "gpt2", "use_timm_backbone": False, "use_pretrained_backbone": True}
    yield {"name_or_path": str(forbidden), "_name_or_path": str(forbidden)}
    yield {"per_layer_config": {"0": {"quantization_config": quantizer}}}
    yield {"architectures": [CANARY], "transformers_weights": str(forbidden / "x")}


def attacks(forbidden: Path) -> Iterator[Any]:
    """Those of `json_attacks`, and what only a checkpoint can hold."""
    yield from json_attacks(forbidden)
    yield torch.zeros(2)
    yield OrderedDict(_target_=f"{CANARY}.fire")
    yield {1: 2, None: 3}
    yield (1, 2)
    endless: list[Any] = []
    endless.append(endless)
    yield endless


def places(settings: Any, place: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Where something is in nested settings, and one place more in every mapping."""
    inner = settings.items() if isinstance(settings, Mapping) else ()
    for name, value in inner:
        yield (*place, name)
        yield from places(value, (*place, name))
    if isinstance(settings, Mapping):
        yield (*place, "added")


def replaced(content: Any, place: tuple[Any, ...], value: Any) -> Any:
    """A copy with something else at a place."""
    changed = copy.deepcopy(content)
    inside = changed
    for name in place[:-1]:
        inside = inside[name]
    inside[place[-1]] = value
    return changed


def places_of_arguments(settings: Mapping[str, Any]) -> Iterator[tuple[str, ...]]:
    """Where every argument is, or could be, of what the sections of a config name."""
    for name, section in settings.items():
        if isinstance(section, Mapping) and "_target_" in section:
            found = registry._find(section["_target_"])
            assert found is not None
            yield from ((name, argument) for argument in {**section, **found[1]})


def _similar(name: str) -> list[str]:
    """Names that a second reading may take for this one, or for something inside it."""
    full_width = "".join(chr(ord(c) + 0xFEE0) if "!" <= c <= "~" else c for c in name)
    around = [f" {name}", f"{name} ", f"{name}\n", f"{name}\u200b", f"+{name}", f"~{name}"]
    inside = [f"{name}.x", f"{name}._target_", f".{name}", f"{name}.", f"{name}@x", f"'{name}'"]
    return [name.upper(), name.title(), full_width, *around, *inside]


def second_readings(
    settings: Mapping[str, Any], at: Iterable[tuple[str, ...]], forbidden: Path
) -> Iterator[dict[str, Any]]:
    """Settings with a section that would be called, under a name that can be read in two ways.

    At every place the section is the value, and something harmless has a name with dots that means
    the same place, or one that looks like it; and the other way round.

    Args:
        settings: Honest ones.
        at: Places of them.
        forbidden: An existing folder that only attacks name.
    """
    command = {"_target_": f"{CANARY}.fire", "path": str(forbidden / "x")}
    for k, place in enumerate(at):
        section = place[:-1]
        similar = _similar(place[-1])
        names = [((), ".".join(place)), *((place[:n], ".".join(place[n:])) for n in (1, 2))]
        names = [(inside, name) for inside, name in names if "." in name]
        names.append((section, similar[k % len(similar)]))
        for inside, name in names:
            other = (*inside, name)
            yield replaced(replaced(settings, place, command), other, "x")
            yield replaced(settings, other, command)


def named_twice(
    content: Any, place: tuple[Any, ...], value: Any, dump: Callable[[Any], str]
) -> Iterator[str]:
    """Texts in which a name is there twice, its own value before and after another one."""
    *section, name = place
    inside = reduce(getitem, section, content)
    rest = {n: v for n, v in inside.items() if n != name}
    first = {"named-twice": value, name: inside.get(name), **rest}
    last = {**rest, name: inside.get(name), "named-twice": value}
    for mapping in (first, last):
        text = dump(replaced(content, tuple(section), mapping) if section else mapping)
        assert text.count("named-twice") == 1
        yield text.replace("named-twice", name)


def sampled(
    all_attacks: list[Any], all_places: list[tuple[Any, ...]]
) -> Iterator[tuple[tuple[Any, ...], Any]]:
    """Pairs in which every attack and every place occurs."""
    longest = max(len(all_places), len(all_attacks))
    for k in range(longest):
        yield all_places[k % len(all_places)], all_attacks[k % len(all_attacks)]
