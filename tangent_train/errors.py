"""The two user errors: an invalid setting, and an unusable file."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from difflib import get_close_matches
from itertools import takewhile
from numbers import Integral
from typing import Any

_LONGEST = 450
"""Largest number of characters of the values found and expected, which may come from a file."""

_CONTROL = re.compile(r"[^\n\t -~\xa0-\U0010ffff]")
"""Characters that terminals interpret as commands."""


_UNKNOWN = "a known setting"
_EXPECTED = {
    "extra_forbidden": _UNKNOWN,
    "unexpected_keyword_argument": _UNKNOWN,
    "path_not_file": "an existing file",
    "path_not_directory": "an existing folder",
}
"""Texts for errors of pydantic whose messages name no value."""

_SIMILAR = 0.7
"""Least similarity of a name that is suggested, from 0 to 1."""

_ALIASES = {
    alias: settings.split()
    for aliases, settings in {
        "checkpoint checkpoint_path ckpt ckpt_path load_from restore resume_from "
        "resume_from_checkpoint resume": "resume init_from checkpoint weights file",
        "init_from model_path pretrained weights": "init_from checkpoint weights",
        "arch architecture backbone model model_name net": "network checkpoint model",
        "data_dir data_path data_root dataset_path root root_dir": "data.root input",
        "data datamodule dataset": "data input",
        "dir folder image image_dir images img input input_dir source src": "input data.root",
        "path": "input data.root file model",
        "onnx": "file",
        "hub name repo repo_id url": "model",
        "azimuth heading": "yaw",
        "elevation": "pitch",
        "default_root_dir dst out out_dir output_dir output_path outputs save_dir save_path target "
        "work_dir log_dir run_dir": "output hydra.run.dir",
        "batch batch_size batchsize bs train_batch_size": "data.batch_size view_batch_size",
        "n_workers num_worker num_workers workers": "data.num_workers",
        "epoch epochs n_epochs num_epochs num_train_epochs": "trainer.max_epochs",
        "iterations max_iters max_iterations num_steps steps": "trainer.max_steps",
        "base_lr learning_rate lr lr0": "optimizer.lr",
        "wd weight_decay": "optimizer.weight_decay",
        "optim": "optimizer",
        "lr_schedule lr_scheduler sched": "scheduler",
        "device devices gpu gpu_ids gpus n_gpu n_gpus num_gpu num_gpus": "trainer.devices device",
        "amp dtype fp16 half": "trainer.precision",
        "grad_clip gradient_clip max_grad_norm": "trainer.gradient_clip_val",
        "accumulate gradient_accumulation_steps": "trainer.accumulate_grad_batches",
        "random_seed random_state seed_everything": "seed",
        "height image_size img_size imgsz input_size level levels resolution width": "level levels "
        "image_size size",
        "config config_file exp": "experiment",
        "exp_name experiment_name run_name": "name",
        "loss_weights weight_classes": "task.head.class_weights",
        "criterion loss loss_fn": "task.head.loss task.head",
        "conf conf_thres confidence threshold": "min_confidence",
        "projection representation view views": "views representation",
        "tensorboard wandb": "logger",
        "early_stop early_stopping patience": "callbacks",
        "force": "overwrite",
    }.items()
    for alias in aliases.split()
}
"""Settings by their names in other frameworks and commands; those of the command are suggested."""


def printable(text: str) -> str:
    r"""Escape terminal control sequences in lines of text.

    >>> print(printable("sofa\x1b[2J"))
    sofa\x1b[2J
    """
    return _CONTROL.sub(lambda match: repr(match[0])[1:-1], text)


def counted(count: int, plural: str) -> str:
    """Return a number with its noun, whose plural ends in s.

    >>> counted(1, "panoramas"), counted(20, "photos")
    ('1 panorama', '20 photos')
    """
    return f"{count} {plural.removesuffix('s') if count == 1 else plural}"


def listed(names: Sequence[object], most: int = 25) -> str:
    """Return names for a message: the first ones, and the number of the others.

    >>> listed(["wall", "floor"]), listed(range(150), 3)
    ('wall, floor', '0, 1, 2, … 147 more')
    """
    more = f", … {len(names) - most} more" if len(names) > most else ""
    return ", ".join(map(str, names[:most])) + more


def first_line(error: object) -> str:
    """Return the first line of an error's message: messages of other libraries may be long."""
    return str(error).strip().partition("\n")[0]


def width_height(size: Sequence[float]) -> str:
    """Return the size of an image as text.

    Args:
        size: Rows and columns of the image.

    >>> width_height((1024, 2048))
    '2048 × 1024 (width × height)'
    """
    return f"{size[1]:.10g} × {size[0]:.10g} (width × height)"


class _ExplainedError(ValueError):
    """An error with its subject, the value found, the values expected and the remedy.

    Args:
        subject: Setting, file or folder. Without `found`, it is the whole message, e.g. when the
            error is unpickled in another process.
        found: Value found.
        expected: Allowed values.
        remedy: Remedy, one sentence.
    """

    def __init__(
        self, subject: object, *, found: object = None, expected: object = None, remedy: str = ""
    ) -> None:
        message = finding = str(subject)
        if found is not None:
            # For an OSError, only its reason: the path is the subject.
            texts = (str(t) for t in (getattr(found, "strerror", None) or found, expected))
            shown = [text if len(text) <= _LONGEST else text[:_LONGEST] + "…" for text in texts]
            finding = "; expected ".join(shown)
            message = f"{subject}: found {finding}. {remedy}".rstrip()
        super().__init__(printable(message))
        self.finding = printable(finding)
        self.subject = subject
        self.found = found
        self.expected = expected
        self.remedy = remedy


class SettingError(_ExplainedError):
    """An invalid setting, named as in the config."""


class DataError(_ExplainedError):
    """A file or folder that cannot be used."""


def nearest(name: str, known: Iterable[str]) -> str:
    """Return a remedy that names known settings of the same meaning or spelling, or nothing.

    Args:
        name: Name that is not known, e.g. ``lr`` or ``data.batchsize``.
        known: Full names of known settings.

    >>> nearest("levl", ["level", "seed"])
    'Did you mean level?'
    >>> nearest("ckpt_path", ["init_from", "optimizer.lr", "resume"])
    'Did you mean resume or init_from?'
    >>> nearest("learning_rate", ["init_from", "optimizer.lr"])
    'Did you mean optimizer.lr?'
    """
    last, known = name.rpartition(".")[2].lower(), [*known]
    meant = [one for one in _ALIASES.get(last, ()) if one in known]
    meant = meant or [one for one in known if one.rpartition(".")[2] == last]
    meant = meant or get_close_matches(name, known, 1, _SIMILAR)
    ends = {one.rpartition(".")[2]: one for one in reversed(known)}
    meant = meant or [ends[one] for one in get_close_matches(last, ends, 1, _SIMILAR)]
    return f"Did you mean {' or '.join(meant[:3])}?" if meant else ""


def wrong_setting(error: Any, known: Iterable[str] = (), prefix: str = "") -> SettingError:
    """Return the first error of a validation; errors of a setting's alternatives are joined.

    Args:
        error: pydantic's ValidationError.
        known: Names of the known settings.
        prefix: Prefix of the setting's name in the message.
    """
    # An unknown name first: other errors may follow from it.
    first = min(error.errors(), key=lambda one: _EXPECTED.get(one["type"]) != _UNKNOWN)
    cause = first.get("ctx", {}).get("error")
    if not first["loc"] and isinstance(cause, SettingError):  # of several settings together
        return cause
    same = [one for one in error.errors() if one["loc"][:1] == first["loc"][:1]]
    parts = zip(*(one["loc"] for one in same), strict=False)
    common = takewhile(lambda part: len({*part}) == 1 and isinstance(part[0], str), parts)
    name = ".".join(part[0] for part in common)
    if first["type"].startswith("missing"):
        return SettingError(prefix + name, found="nothing", expected="a value")
    texts = (_EXPECTED.get(one["type"]) or one.get("ctx", {}).get("error") for one in same)
    messages = (re.sub("^Input should be |, unable to .*", "", one["msg"]) for one in same)
    expected = dict.fromkeys(str(text or m) for text, m in zip(texts, messages, strict=True))
    names = [prefix + one for one in known if one != name]
    return SettingError(
        prefix + name,
        found="null" if first["input"] is None else first["input"],
        expected=" or ".join(expected),
        remedy=nearest(prefix + name, names) if _UNKNOWN in expected else "",
    )


def wrong_field(error: Any) -> str:
    """Return the first error of a validation of a file's content, for a message."""
    wrong = wrong_setting(error)
    return f"{wrong.subject}={wrong.found}, not {wrong.expected}"


def at_least(name: str, value: object, least: int, most: int | None = None) -> int:
    """Return a setting that has to be an integer, also of NumPy, from `least` to `most`.

    Raises:
        SettingError: The value is not such an integer.
    """
    is_integer = isinstance(value, Integral) and not isinstance(value, bool)
    if not is_integer or not least <= value <= (most or value):  # type: ignore[operator]
        bounds = f"of {least} or more" if most is None else f"from {least} to {most}"
        raise SettingError(name, found=repr(value), expected=f"an integer {bounds}")
    return int(value)  # type: ignore[call-overload]


def check_type(name: str, value: object, kinds: type | tuple[type, ...], expected: str) -> None:
    """Raise TypeError unless an argument of the Python API is of one of some types."""
    if not isinstance(value, kinds):
        raise TypeError(f"{name}: found {type(value).__name__}; expected {expected}.")


def check_choice(name: str, value: str, allowed: tuple[str, ...]) -> None:
    """Raise SettingError unless a value is one of those allowed."""
    if value not in allowed:
        raise SettingError(name, found=repr(value), expected=" or ".join(map(repr, allowed)))


@contextmanager
def of_extra(extra: str, subject: object, remedy: str = "") -> Iterator[None]:
    """Explain a missing package in a block that imports packages of an extra of tangent-train.

    Args:
        extra: Name of the extra.
        subject: Setting or file that needs these packages.
        remedy: Further remedy.

    Raises:
        SettingError: A package is not installed.
    """
    try:
        yield
    except ImportError as error:
        raise SettingError(
            subject,
            found=f"a missing package ({error})",
            expected=f"the packages of the extra {extra}",
            remedy=f"Run in the checkout: pip install -e '.[{extra}]'. {remedy}".rstrip(),
        ) from error
