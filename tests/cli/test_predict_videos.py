"""`tangent-predict` on videos: labels of their frames, and videos of these."""

from __future__ import annotations

import csv
import re
from fractions import Fraction
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image
from PIL.PngImagePlugin import PngInfo

import tangent_train as tt
from tangent_train.io.gpano import PART_TAGS, Eye
from tangent_train.io.palette import class_colors
from tangent_train.io.videos import read_frames
from tests.cli.tiny_runs import Predict, predicted
from tests.datamodules.data_files import (
    gpano_xmp,
    insert_boxes,
    projection_boxes,
    read_png,
    stereo_box,
)
from tests.inference.trained import CLASS_NAMES, sphere
from tests.running import Capture, Patch

av: Any = pytest.importorskip("av")

TIMES = [0, 1, 2, 4, 5, 9, 10]
"""Of the frames, in sixteenths of a second: the rate varies."""


def _write_video(path: Path, shape: tuple[int, int] = (32, 64), quarters: int = 0) -> Path:
    """A video, perhaps stored rotated clockwise by quarter quarters."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w") as output:
        stream = output.add_stream("mpeg4", rate=16)
        stream.height, stream.width = shape[::-1] if quarters % 2 else shape
        if quarters:
            stream.set_display_rotation(90 * quarters)
        stream.codec_context.time_base = Fraction(1, 16)
        for number, time in enumerate(TIMES):
            rgb = np.roll(sphere(shape[0]), 5 * number, axis=1)[:, : shape[1]]
            stored = np.ascontiguousarray(np.rot90(rgb, -quarters))
            frame = av.VideoFrame.from_ndarray(stored, format="rgb24")
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


@pytest.mark.parametrize("quarters", [0, 1])
def test_frames_get_the_labels_of_images_and_pictures_are_a_video(
    tmp_path: Path, predict: Predict, quarters: int
) -> None:
    """Upright, beside a folder of images that has the video's name."""
    video = _write_video(tmp_path / "in" / "walk.mp4", quarters=quarters)
    stored, times = _decoded(video)
    frames = np.rot90(stored, quarters, axes=(1, 2))
    (tmp_path / "in" / "walk").mkdir()
    for number, rgb in enumerate(frames):
        cv2.imwrite(
            str(tmp_path / "in" / "walk" / f"{number:06d}.png"),
            np.ascontiguousarray(rgb[..., ::-1]),
        )
    predict()
    of_images = _labels(tmp_path / "out" / "labels" / "walk")
    of_frames = _labels(tmp_path / "out" / "labels" / "walk.mp4")
    assert sorted(of_frames) == [f"{number:06d}" for number in range(len(TIMES))]
    for name, labels in of_frames.items():
        np.testing.assert_array_equal(labels, of_images[name])
    palette = class_colors(tuple(CLASS_NAMES)).astype(float)
    colors = palette[np.stack(list(of_frames.values()))]
    light = frames @ np.array([[0.299], [0.587], [0.114]])
    for kind, expected in (("color", colors), ("overlay", (colors + light) / 2)):
        path = tmp_path / "out" / kind / "walk.mp4.mp4"
        made, made_times = _decoded(path)
        assert (np.stack([frame() for frame in read_frames(path)]) == made).all(), "not rotated"
        assert made.shape == frames.shape
        assert made_times == pytest.approx(times)
        assert np.abs(made - expected).mean() < 10  # compressed, with colors at half resolution
    entries = predicted(tmp_path / "out")
    assert len(entries) == 2 * len(TIMES)
    with (tmp_path / "out" / "summary.csv").open(encoding="utf-8") as file:
        rows = {row["name"]: row for row in csv.DictReader(file)}
    for number, time in enumerate(TIMES):
        row = rows[f"walk.mp4/{number:06d}"]
        assert (int(row["frame"]), float(row["time_s"])) == (number, time / 16)
    assert rows["walk/000003"]["frame"] == rows["walk/000003"]["time_s"] == ""
    assert entries["walk.mp4/000003"]["classes"] == entries["walk/000003"]["classes"]


def test_an_interrupted_video_is_resumed(
    tmp_path: Path, predict: Predict, monkeypatch: Patch, capsys: Capture
) -> None:
    video = _write_video(tmp_path / "in" / "walk.mp4")

    def interrupted(path: Path, *settings: Any) -> Any:
        for number, frame in enumerate(read_frames(path, *settings)):
            if number == 4:
                raise KeyboardInterrupt
            yield frame

    monkeypatch.setattr("tangent_train.io.jobs.read_frames", interrupted)
    with pytest.raises(SystemExit) as stopped:
        predict(input=video)
    assert stopped.value.code == 130
    assert not (tmp_path / "out" / "overlay").exists()
    monkeypatch.setattr("tangent_train.io.jobs.read_frames", read_frames)
    before = (tmp_path / "out" / "labels" / "walk" / "000003.png").stat().st_mtime_ns
    predict(input=video)
    assert (tmp_path / "out" / "labels" / "walk" / "000003.png").stat().st_mtime_ns == before
    assert "7 images, 4 done already" in capsys.readouterr().out
    assert len(predicted(tmp_path / "out")) == 7
    assert len(_decoded(tmp_path / "out" / "overlay" / "walk.mp4")[0]) == len(TIMES)
    predict(input=video)
    predict(input=video, output="again")
    first, second = (_labels(tmp_path / name / "labels") for name in ("out", "again"))
    assert first.keys() == second.keys()
    assert all((first[name] == second[name]).all() for name in first)


def _without_pictures(video: Path) -> bytes:
    with av.open(str(video)) as container:
        packets = [(packet.pos, packet.size) for packet in container.demux(video=0) if packet.size]
    content = bytearray(video.read_bytes())
    for start, size in packets:
        content[start : start + size] = bytes(size)
    return bytes(content)


def test_videos_that_cannot_be_used(
    tmp_path: Path, predict: Predict, capsys: Capture, monkeypatch: Patch
) -> None:
    """Each is named, and the others are labeled."""
    folder = tmp_path / "in"
    good = _write_video(folder / "good.mp4")
    _write_video(folder / "narrow.mp4", (32, 48))
    (folder / "broken.mp4").write_bytes(b"nothing" * 100)
    (folder / "cut.avi").write_bytes(_write_video(folder / "cut.avi").read_bytes()[:-900])
    (folder / "gray.mp4").write_bytes(_without_pictures(good))
    with av.open(str(folder / "sound.mp4"), "w") as output:
        stream = output.add_stream("aac", rate=44100)
        sound = av.AudioFrame.from_ndarray(np.zeros((1, 1024), np.float32), "fltp", "mono")
        sound.sample_rate = 44100
        output.mux(stream.encode(sound))
        output.mux(stream.encode(None))
    with pytest.raises(SystemExit, match="11 of 18 images could not be used"):
        predict(write="[labels]")
    printed = " ".join(capsys.readouterr().out.split())
    for name, message in (
        ("broken", "cannot be decoded"),
        ("cut", "cannot be decoded"),
        ("gray", "cannot be decoded"),
        ("narrow", "a whole panorama, twice"),
        ("sound", "no video stream"),
    ):
        assert re.search(rf"{name}\.\w+: ", printed)
        frame = f"{name}/000000" if name == "narrow" else name
        assert message in predicted(tmp_path / "out")[frame]["error"]
    with pytest.raises(SystemExit, match="1 of 1 images could not be used"):
        predict(input=folder / "gray.mp4", output="other", write="[labels]")
    monkeypatch.setitem(__import__("sys").modules, "av", None)
    with pytest.raises(SystemExit, match="1 of 1 images"):
        predict(input=good, output="good")
    assert "pip install -e '.[video]'" in " ".join(capsys.readouterr().out.split())


_TILE = projection_boxes(b"equi", cropped=(0.25, 0, 0.25, 0.25))


def _stereo(folder: Path, axis: int, area: Any, boxes: bytes) -> Any:
    """Write a stereo video, and its first frame as a picture; return the halves."""
    rgb = np.concatenate([sphere(32)[area], sphere(32)[area][:, ::-1]], axis)
    with av.open(str(folder / "video.mp4"), "w") as output:
        stream = output.add_stream("mpeg4", rate=16)
        stream.height, stream.width = rgb.shape[:2]
        for number in range(2):
            frame = av.VideoFrame.from_ndarray(np.roll(rgb, number, axis=-1), format="rgb24")
            output.mux(stream.encode(frame))
        output.mux(stream.encode(None))
    insert_boxes(folder / "video.mp4", boxes)
    frames = _decoded(folder / "video.mp4")[0]
    cv2.imwrite(str(folder / "picture.png"), np.ascontiguousarray(frames[0][..., ::-1]))
    return np.split(frames, 2, axis + 1)


_WHOLE = np.s_[:, :]
_PART = np.s_[8:32, 16:48]  # cropped as in the boxes
_PART_AREA = [-90, 90, -90, 45]


@pytest.mark.parametrize(
    ("boxes", "axis", "shown", "area"),
    [
        (b"", 0, _WHOLE, None),
        (b"", 1, _WHOLE, None),
        (b"", 1, _PART, _PART_AREA),
        (stereo_box(1) + projection_boxes(b"equi"), 0, _WHOLE, None),
        (stereo_box(2) + _TILE, 1, _PART, None),
    ],
)
def test_each_eye_of_stereo_gets_the_labels_of_its_picture_alone(
    tmp_path: Path,
    predict: Predict,
    capsys: Capture,
    boxes: bytes,
    axis: int,
    shown: Any,
    area: list[float] | None,
) -> None:
    """Top-bottom, side by side, and half a sphere; by size and by metadata."""
    (tmp_path / "in").mkdir()
    first, second = _stereo(tmp_path / "in", axis, shown, boxes)
    network = tt.load(tmp_path / "model.ckpt", device="cpu")
    angles = _PART_AREA if shown == _PART else None
    given = {} if area is None else {"area": area}
    eyes: dict[Eye, Any] = {"left": first, "right": second}
    for eye, frames in eyes.items():
        predict(eye=eye, input=tmp_path / "in" / "video.mp4", output=tmp_path / eye, **given)
        found = _labels(tmp_path / eye / "labels")
        for number, rgb in enumerate(frames):
            expected = network.labels(rgb, area=angles)
            np.testing.assert_array_equal(found[f"{number:06d}"], expected)
        entry = predicted(tmp_path / eye)["video/000000"]
        assert (entry["eye"], entry["rows"]) == (eye, len(frames[0]))
        made, _ = _decoded(tmp_path / eye / "overlay" / "video.mp4")
        assert made.shape == np.shape(frames)
        picture = network.labels(tmp_path / "in" / "picture.png", eye=eye, area=angles)
        expected = network.labels(frames[0], area=angles)
        np.testing.assert_array_equal(picture, expected)
    with pytest.raises(SystemExit):
        predict(output=tmp_path / "none", **given)
    printed = " ".join(capsys.readouterr().out.split())
    assert printed.count("eye=left or eye=right") >= 2


def test_pose_and_area_of_a_video_are_used_as_those_of_a_picture(
    tmp_path: Path, predict: Predict
) -> None:
    video, angles = _write_video(tmp_path / "in" / "walk.mp4", (24, 32)), (40.0, 30.0, -20.0)
    insert_boxes(video, projection_boxes(b"equi", angles, (0.25, 0, 0.25, 0.25)))
    sizes = dict(zip(PART_TAGS, (64, 32, 32, 24, 16, 8), strict=True))
    tags = sizes | {"PosePitchDegrees": 30, "PoseRollDegrees": -20}
    frames, _ = _decoded(video)
    for number, rgb in enumerate(frames):
        text = PngInfo()
        text.add_itxt("XML:com.adobe.xmp", gpano_xmp(tags).decode())
        Image.fromarray(rgb).save(tmp_path / f"{number:06d}.png", pnginfo=text)
    predict(input=video, upright="pose")
    network = tt.load(tmp_path / "model.ckpt", device="cpu")
    for name, labels in _labels(tmp_path / "out" / "labels").items():
        expected = network.labels(tmp_path / f"{name}.png", upright="pose")
        np.testing.assert_array_equal(labels, expected)
        assert (network.labels(tmp_path / f"{name}.png") != expected).any()
    assert predicted(tmp_path / "out")["walk/000000"]["tilt_deg"] > 30
