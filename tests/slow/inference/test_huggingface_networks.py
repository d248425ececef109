"""Every kind of network of transformers: its library's own scores, from a checkpoint."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from tangent_train.errors import DataError
from tests.inference.photo_networks import huggingface_networks as networks


def test_mobilevit_takes_blue_first(tmp_path: Path) -> None:
    network, processor = networks.saved(networks.mobilevit, tmp_path)
    scores = networks.imported_scores(networks.imported(tmp_path))
    expected = networks.own_scores(network, processor)
    networks.assert_same(scores, expected)


def test_eomt(tmp_path: Path) -> None:
    network, processor = networks.saved(networks.eomt, tmp_path)
    scores = networks.imported_scores(networks.imported(tmp_path))
    expected = networks.own_scores(network, processor)
    networks.assert_same(scores.exp(), expected)


def test_oneformer_is_asked_for_classes(tmp_path: Path) -> None:
    (tmp_path / "classes.json").write_text(
        json.dumps({k: {"name": name, "isthing": 0} for k, name in enumerate(networks.NAMES)})
    )
    own: dict[str, Any] = {"repo_path": str(tmp_path), "class_info_file": "classes.json"}
    network, processor = networks.saved(lambda: networks.oneformer(**own), tmp_path)
    with pytest.raises(DataError, match=r"no tokenizer\.json or vocab\.json; expected the"):
        networks.imported(tmp_path)
    both = networks.transformers.OneFormerProcessor(
        processor, networks.tokenizer(tmp_path), task_seq_length=24
    )
    task = both(networks.photo(), ["semantic"], return_tensors="pt")["task_inputs"]
    scores = networks.imported_scores(networks.imported(tmp_path))
    expected = networks.own_scores(network, processor, task_inputs=task)
    networks.assert_same(scores.exp(), expected)
