"""From one's own photos to one's own panoramas: what is said before the first stage."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.cli.tiny_runs import run_command
from tests.datamodules.folder.folder_format import write_classes, write_data_set
from tests.datamodules.folder.photo_format import write_photo, write_photos

_SETTINGS = (
    "data=folder",
    "data.root=my_rooms",
    "data@photos.data=folder_photos",
    "photos.data.root=my_photos",
    "level=4",
    "network=unet_small",
    "network.widths=[4,8]",
    "data.num_workers=0",
    "photos.data.num_workers=0",
    "trainer.max_epochs=1",
    "trainer.accelerator=cpu",
    "compare=[]",
    "fine_tuning.epochs=[1]",
    "panels=0",
)
_SEED_0 = Path("runs/transfer/transfer/seed_0")


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working folder, with `my_rooms` and `my_photos`, both of five scenes."""
    monkeypatch.chdir(tmp_path)
    write_data_set(tmp_path / "my_rooms", scenes=5)
    write_photos(tmp_path / "my_photos", scenes=5)
    return tmp_path


def test_other_classes_are_refused_with_both_files(
    here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_classes(here / "my_rooms", {"wall": 1, "window": 255, "floor": 2})
    message = (
        r"^tangent-transfer: stage S: data: found window as class 2 in my_rooms/classes\.json; "
        r"expected floor, as in my_photos/classes\.json\. "
    )
    with pytest.raises(SystemExit, match=message):
        run_command(monkeypatch, "transfer", *_SETTINGS)
    write_classes(here / "my_rooms", {"wall": 1, "floor": 2})
    message = r"found nothing as class 3 in my_rooms/classes\.json; expected window, as in my_ph"
    with pytest.raises(SystemExit, match=message):
        run_command(monkeypatch, "transfer", *_SETTINGS)
    assert not _SEED_0.exists()


def test_scenes_in_training_and_test_and_missing_cameras_are_said_before_training(
    here: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (here / "my_rooms" / "test.txt").write_text("scene_3/view.0\n")
    (here / "my_photos" / "train.txt").write_text("scene_3/view.0\nscene_4/view.0\n")
    (here / "my_photos" / "val.txt").write_text("scene_2/view.0\n")
    monkeypatch.setattr("tangent_train.cli.transfer.run_stage", lambda *_: 3)
    with pytest.raises(SystemExit) as ended:
        run_command(monkeypatch, "transfer", *_SETTINGS)
    assert ended.value.code == 3
    note = "Note: P is trained on photos, and S tested on panoramas, of scene_3. If they show the"
    assert note in capsys.readouterr().out
    write_photo(here / "my_photos", "scene_1/new.png", 1, film_mm=None)
    message = r"stage P, in photos: my_photos/images/scene_1/new\.png: found no K in cameras\.json"
    with pytest.raises(SystemExit, match=message):
        run_command(monkeypatch, "transfer", *_SETTINGS)
