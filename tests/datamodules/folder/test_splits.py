from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from datamodules.core.files import SPLITS
from datamodules.folder.labeled import FolderPanoramas
from tangent_train.errors import DataError
from tests.datamodules.data_files import names_of
from tests.datamodules.folder.folder_format import write_data_set


def _all_names(module: FolderPanoramas) -> dict[str, list[str]]:
    return {split: names_of(module, split) for split in SPLITS}


def _together(names: dict[str, list[str]]) -> list[str]:
    """The names in all splits, none of them twice."""
    found = [name for split in names.values() for name in split]
    assert len(set(found)) == len(found)
    return sorted(found)


def test_whole_scenes_are_drawn_by_share_and_seed(tmp_path: Path, erp: Any) -> None:
    root = write_data_set(tmp_path, scenes=20, each=2, height=16)
    names = _all_names(FolderPanoramas(root, erp, seed=5))
    scenes = {split: {name.partition("/")[0] for name in names[split]} for split in SPLITS}
    assert [len(scenes[split]) for split in SPLITS] == [14, 2, 4]
    assert [len(names[split]) for split in SPLITS] == [28, 4, 8]
    assert len(_together(names)) == 40
    assert _all_names(FolderPanoramas(root, erp, seed=6)) == names, "not the run's seed"
    other = _all_names(FolderPanoramas(root, erp, split_seed=1))
    assert other["test"] != names["test"]
    assert other["val"] != names["val"]
    settings: dict[str, Any] = {"test_fraction": 0.5, "val_fraction": 0}
    half = _all_names(FolderPanoramas(root, erp, **settings))
    assert [len(half[split]) for split in SPLITS] == [20, 0, 20]
    assert FolderPanoramas(root, erp, **settings).val_dataloader() == []


def test_lists_of_all_splits(own_root: Path, erp: Any) -> None:
    lists = {
        "train": "\ufeffscene_5/view.1\n\n# the kitchen\nscene_0/view.0.PNG\r\n",
        "val": "scene_1\\view.1",  # as Windows writes it
        "test": "scene_0/view.1\nscene_3/view.0\n",
    }
    for split, text in lists.items():
        (own_root / f"{split}.txt").write_text(text, "utf-8")
    (own_root / "val.txt").rename(own_root / "val.TXT")
    for path in sorted(own_root.glob("labels/*/*.png")):
        path.rename(path.with_suffix(".PNG"))
    module = FolderPanoramas(own_root, erp)
    assert _all_names(module) == {
        "train": ["scene_0/view.0", "scene_5/view.1"],
        "val": ["scene_1/view.1"],
        "test": ["scene_0/view.1", "scene_3/view.0"],
    }
    assert names_of(FolderPanoramas(own_root, erp, val_fraction=0), "val") == []


def test_lists_of_some_splits(own_root: Path, erp: Any) -> None:
    all_names = sorted(f"scene_{scene}/view.{view}" for scene in range(6) for view in range(2))
    (own_root / "test.txt").write_text("scene_2/view.0\n")
    names = _all_names(FolderPanoramas(own_root, erp))
    assert names["test"] == ["scene_2/view.0"]
    assert _together(names) == all_names
    assert len({name.partition("/")[0] for name in names["val"]}) == 1

    (own_root / "test.txt").unlink()
    (own_root / "train.txt").write_text("\n".join(all_names[:8]))
    names = _all_names(FolderPanoramas(own_root, erp))
    assert names["test"] == all_names[8:], "all that are in no list"
    assert sorted(names["train"] + names["val"]) == all_names[:8]

    (own_root / "train.txt").unlink()
    (own_root / "val.txt").write_text("\n".join(all_names[:3]))
    names = _all_names(FolderPanoramas(own_root, erp))
    assert names["val"] == all_names[:3]
    assert len({name.partition("/")[0] for name in names["test"]}) == 1
    assert _together(names) == all_names


def test_data_sets_of_few_scenes_train(tmp_path: Path, erp: Any) -> None:
    two = write_data_set(tmp_path / "two", scenes=2, each=2, height=16)
    with pytest.warns(UserWarning, match="those of val from are in one scene, scene_"):
        names = _all_names(FolderPanoramas(two, erp))
    assert [len(names[split]) for split in SPLITS] == [1, 1, 2]
    one = write_data_set(tmp_path / "one", scenes=1, each=5, height=16)
    with pytest.warns(UserWarning, match="are in one scene, scene_0"):
        names = _all_names(FolderPanoramas(one, erp))
    assert [len(names[split]) for split in SPLITS] == [3, 1, 1]
    assert len(_together(names)) == 5
    least = write_data_set(tmp_path / "least", scenes=2, each=1, height=16)
    names = _all_names(FolderPanoramas(least, erp))
    assert [len(names[split]) for split in SPLITS] == [1, 0, 1]
    single = write_data_set(tmp_path / "single", scenes=1, each=1, height=16)
    with pytest.raises(DataError, match="found no images for test"):
        FolderPanoramas(single, erp).setup()
    every = _all_names(FolderPanoramas(one, erp, test_fraction=1))
    assert [len(every[split]) for split in SPLITS] == [0, 0, 5]


@pytest.mark.parametrize(
    ("lists", "message"),
    [
        (
            {"test": "scene_9/view.0"},
            r"test\.txt: found 'scene_9/view\.0'; expected names of files",
        ),
        ({"test": "scene_0/view.0", "train": "scene_0/view.0"}, r"test\.txt: found .* each once"),
        ({"test": ""}, r"found no images for test; .* name some in test\.txt"),
    ],
)
def test_lists_that_cannot_be_used(
    own_root: Path, erp: Any, lists: dict[str, str], message: str
) -> None:
    for split, text in lists.items():
        (own_root / f"{split}.txt").write_text(text)
    with pytest.raises(DataError, match=message):
        FolderPanoramas(own_root, erp).setup()
