"""`tangent-predict` on videos: labels of their frames, and videos of these."""

from __future__ import annotations

import json
from fractions import Fraction
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from datamodules.images.palette import class_colors
from datamodules.images.videos import read_frames
from tests.cli.tiny_runs import Predict, predicted
from tests.datamodules.data_files import read_png
from tests.inference.trained import CLASS_NAMES, sphere

av: Any = pytest.importorskip("av")

TIMES = [0, 1, 2, 4, 5, 9, 10]
"""Of the frames, in sixteenths of a second: the rate varies."""


def _write_video(path: Path, shape: tuple[int, int] = (32, 64)) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w") as output:
        stream = output.add_stream("mpeg4", rate=16)
        stream.height, stream.width = shape
        stream.codec_context.time_base = Fraction(1, 16)
        for number, time in enumerate(TIMES):
            rgb = np.roll(sphere(shape[0]), 5 * number, axis=1)[:, : shape[1]]
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(rgb), format="rgb24")
            frame.pts, frame.time_base = time, Fraction(1, 16)
            output.mux(stream.encode(frame))
        output.mux(stream.encode(None))
    return path


def _decoded(path: Path) -> tuple[NDArray[np.uint8], list[float]]:
    with av.open(str(path)) as container:
        frames = list(container.decode(video=0))
    return np.stack([frame.to_ndarray(format="rgb24") for frame in frames]), [
        frame.time for frame in frames
    ]


def _labels(folder: Path) -> dict[str, NDArray[np.uint8]]:
    return {path.stem: read_png(path) for path in sorted(folder.rglob("*.png"))}


def test_frames_get_the_labels_of_images_and_pictures_are_a_video(
    tmp_path: Path, predict: Predict
) -> None:
    """Beside a folder of images that has the video's name."""
    video = _write_video(tmp_path / "in" / "walk.mp4")
    frames, times = _decoded(video)
    (tmp_path / "in" / "walk").mkdir()
    for number, rgb in enumerate(frames):
        cv2.imwrite(str(tmp_path / "in" / "walk" / f"{number:06d}.png"), rgb[..., ::-1])
    predict()
    of_images = _labels(tmp_path / "out" / "labels" / "walk")
    of_frames = _labels(tmp_path / "out" / "labels" / "walk.mp4")
    assert sorted(of_frames) == [f"{number:06d}" for number in range(len(TIMES))]
    for name, labels in of_frames.items():
        np.testing.assert_array_equal(labels, of_images[name])
    palette = class_colors(len(CLASS_NAMES)).astype(float)
    colors = palette[np.stack(list(of_frames.values()))]
    light = frames @ np.array([[0.299], [0.587], [0.114]])
    for kind, expected in (("color", colors), ("overlay", (colors + light) / 2)):
        made, made_times = _decoded(tmp_path / "out" / kind / "walk.mp4.mp4")
        assert made.shape == frames.shape
        assert made_times == pytest.approx(times)
        assert np.abs(made - expected).mean() < 8  # compressed, with colours at half resolution
    entries = predicted(tmp_path / "out")
    assert len(entries) == 2 * len(TIMES)
    assert entries["walk.mp4/000003"]["classes"] == entries["walk/000003"]["classes"]


def test_an_interrupted_video_is_resumed(
    tmp_path: Path,
    predict: Predict,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    video = _write_video(tmp_path / "in" / "walk.mp4")

    def interrupted(path: Path, *settings: int) -> Any:
        for number, frame in enumerate(read_frames(path, *settings)):
            if number == 4:
                raise KeyboardInterrupt
            yield frame

    monkeypatch.setattr("tangent_train.cli.input_files.read_frames", interrupted)
    with pytest.raises(SystemExit) as stopped:
        predict(input=video)
    assert stopped.value.code == 130
    assert "4 of 7 images are done. resume=true" in capsys.readouterr().out
    assert len(predicted(tmp_path / "out")) == 4
    assert not (tmp_path / "out" / "overlay").exists()
    monkeypatch.setattr("tangent_train.cli.input_files.read_frames", read_frames)
    before = (tmp_path / "out" / "labels" / "walk" / "000003.png").stat().st_mtime_ns
    predict(input=video, resume="true")
    assert (tmp_path / "out" / "labels" / "walk" / "000003.png").stat().st_mtime_ns == before
    assert [entry["frame"] for entry in predicted(tmp_path / "out").values()] == list(range(7))
    assert len(_decoded(tmp_path / "out" / "overlay" / "walk.mp4")[0]) == len(TIMES)
    predict(input=video, resume="true")
    predict(input=video, output="again")
    first, second = (_labels(tmp_path / name / "labels") for name in ("out", "again"))
    assert first.keys() == second.keys()
    assert all((first[name] == second[name]).all() for name in first)


def test_videos_that_cannot_be_used(
    tmp_path: Path,
    predict: Predict,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Each is named once, and the others are labelled."""
    folder = tmp_path / "in"
    good = _write_video(folder / "good.mp4")
    _write_video(folder / "narrow.mp4", (32, 48))
    (folder / "broken.mp4").write_bytes(b"nothing" * 100)
    (folder / "cut.mp4").write_bytes(good.read_bytes()[:900])
    with av.open(str(folder / "sound.mp4"), "w") as output:
        stream = output.add_stream("aac", rate=44100)
        sound = av.AudioFrame.from_ndarray(np.zeros((1, 1024), np.float32), "fltp", "mono")
        sound.sample_rate = 44100
        output.mux(stream.encode(sound))
        output.mux(stream.encode(None))
    with pytest.raises(SystemExit, match="4 of 11 images could not be used"):
        predict(write="[labels]")
    said = " ".join(capsys.readouterr().out.split())
    for name, message in (
        ("broken", "cannot be decoded"),
        ("cut", "found no frames"),
        ("narrow", "expected a whole panorama"),
        ("sound", "no video stream"),
    ):
        assert said.count(f"{name}.mp4: found") == 1
        assert message in predicted(tmp_path / "out")[name]["error"]
    with pytest.raises(SystemExit, match="write: found color of a video without labels"):
        predict(write="[color]", output="other")
    monkeypatch.setitem(__import__("sys").modules, "av", None)
    with pytest.raises(SystemExit, match="1 of 1 images"):
        predict(input=good, output="other")
    assert "pip install 'tangent-train[video]'" in " ".join(capsys.readouterr().out.split())


def test_a_shard_has_whole_videos(tmp_path: Path, predict: Predict) -> None:
    for name in ("a", "c"):
        _write_video(tmp_path / "in" / f"{name}.mp4")
    cv2.imwrite(str(tmp_path / "in" / "b.png"), sphere(32))
    (tmp_path / "in" / "d.mp4").write_bytes(b"broken")
    settings = {"blend": "nearest", "write": "[labels,color]", "mask": -45}
    for output, shard in (("whole", "null"), ("out", "2/2"), ("out", "1/2")):
        try:
            predict(**settings, output=output, shard=shard)
        except SystemExit as ended:
            assert "1 of " in str(ended.code)  # noqa: PT017 - the shard of the broken one
    out, whole = tmp_path / "out", tmp_path / "whole"
    for name in ("summary.json", "summary.csv", "labels/b.png", "labels/c/000006.png"):
        assert (out / name).read_bytes() == (whole / name).read_bytes()
    for name in ("color/a.mp4", "color/c.mp4"):
        found, expected = (_decoded(folder / name)[0].astype(int) for folder in (out, whole))
        assert np.abs(found - expected).mean() < 2  # encoding does not repeat itself exactly
    assert not _labels(out / "labels" / "a")["000003"][24:].any()
    of_shard = json.loads((out / "shards" / "1-of-2.json").read_text())["images"]
    assert {entry["name"].partition("/")[0] for entry in of_shard} == {"a", "c"}
