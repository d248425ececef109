"""Videos as PyAV writes them, whole, rotated, cut and damaged; edited boxes are written by hand."""

from __future__ import annotations

import socket
import struct
from collections.abc import Callable, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from tangent_train.errors import DataError
from tangent_train.io.gpano import PART_TAGS, read_area
from tangent_train.io.videos import read_frames, read_video_size, read_video_tags, write_video
from tests.datamodules.data_files import (
    hide_start,
    insert_boxes,
    projection_boxes,
    spherical_v1,
    stereo_box,
)

av: Any = pytest.importorskip("av")

_RATE = 10
_COUNT = 12
_UNEVEN = (0, 1, 2, 4, 5, 9, 10, 30, 31, 32, 60, 100)
_X264 = ("libx264", "yuv420p", {"bf": "2", "g": "6"})
_CODECS: dict[str, tuple[str, str, dict[str, str]]] = {
    "x264": _X264,
    "forward": ("libx264", "yuv420p", {"bf": "0", "g": "6"}),
    "mpeg4": ("mpeg4", "yuv420p", {"bf": "2"}),
    "mjpeg": ("mjpeg", "yuvj420p", {}),
    "prores": ("prores_ks", "yuv422p10le", {}),
    "vp8": ("libvpx", "yuv420p", {"lag-in-frames": "16", "auto-alt-ref": "1"}),
    "vp9": ("libvpx-vp9", "yuv420p", {"lag-in-frames": "16"}),
    "av1": ("libsvtav1", "yuv420p", {"preset": "12"}),
    "opengop": ("libx264", "yuv420p", {"g": "6", "x264-params": "open-gop=1:scenecut=0"}),
    "lossless": ("libx264rgb", "rgb24", {"crf": "0"}),
}


def _pictures(count: int = _COUNT) -> list[NDArray[np.uint8]]:
    blocks = np.random.default_rng(0).integers(0, 256, (8, 16, 3), np.uint8)
    picture = np.kron(blocks, np.ones((8, 8, 1), np.uint8))
    return [np.ascontiguousarray(np.roll(picture, 3 * k, axis=1)) for k in range(count)]


def _write(
    path: Path,
    codec: str = "x264",
    frames: Sequence[NDArray[np.uint8]] | None = None,
    times: Sequence[int] | None = None,
    sound: int = 0,
    setup: Callable[[Any], object] = id,
    **container: str,
) -> Path:
    """Write a video, perhaps with seconds of sound."""
    name, pixels, options = _CODECS[codec]
    frames = _pictures() if frames is None else frames
    with av.open(str(path), "w", container_options=container) as output:
        stream = output.add_stream(name, rate=_RATE, options=options)
        stream.height, stream.width = frames[0].shape[:2]
        stream.pix_fmt = pixels
        stream.codec_context.time_base = Fraction(1, _RATE)
        setup(stream)
        audio: Any = output.add_stream("aac", rate=44100) if sound else None
        for number, rgb in enumerate(frames):
            frame = av.VideoFrame.from_ndarray(rgb, format="rgb24").reformat(format=pixels)
            frame.pts, frame.time_base = (times or range(99))[number], Fraction(1, _RATE)
            output.mux(stream.encode(frame))
        output.mux(stream.encode(None))
        for number in range(43 * sound):
            silence = av.AudioFrame.from_ndarray(np.zeros((1, 1024), np.float32), "fltp", "mono")
            silence.sample_rate, silence.pts = 44100, 1024 * number
            output.mux(audio.encode(silence))
        if audio is not None:
            output.mux(audio.encode(None))
    return path


def _decoded(path: Path) -> list[NDArray[np.uint8]]:
    with av.open(str(path)) as container:
        return [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]


def _read(path: Path) -> list[NDArray[np.uint8]]:
    return [frame() for frame in read_frames(path)]


_WHOLE = [
    ("x264.mp4", {}),
    ("x264.mov", {"times": _UNEVEN}),
    ("x264.avi", {"sound": 3}),
    ("x264.mp4", {"movflags": "frag_keyframe+empty_moov"}),
    ("x264.mkv", {"live": "1"}),
    ("opengop.mkv", {}),
    ("mpeg4.avi", {"times": _UNEVEN}),
    ("mjpeg.mov", {}),
    ("prores.mov", {}),
    ("vp9.webm", {"times": _UNEVEN}),
    ("av1.mp4", {"times": _UNEVEN}),
]


@pytest.mark.parametrize(("name", "settings"), _WHOLE, ids=[name for name, _ in _WHOLE])
def test_whole_videos_are_read(tmp_path: Path, name: str, settings: dict[str, Any]) -> None:
    """Varying rate, longer sound, late start, one frame."""
    path = _write(tmp_path / name, name.partition(".")[0], **settings)
    count = len(settings.get("frames", range(_COUNT)))
    assert read_video_size(path) == (count, 64, 128)
    np.testing.assert_array_equal(_read(path), _decoded(path))
    every = [frame() for frame in read_frames(path, count, 5)]
    np.testing.assert_array_equal(every, _decoded(path)[::5])


@pytest.mark.parametrize("codec", ["x264", "mjpeg", "opengop"])
@pytest.mark.parametrize("hidden", [1, 11])
def test_frames_that_an_edit_list_hides_do_not_count(
    tmp_path: Path, codec: str, hidden: int
) -> None:
    """At the start, and at the end as PyAV leaves them out."""
    path = _write(tmp_path / "cut.mp4", codec)
    whole, data = _decoded(path), bytearray(path.read_bytes())
    hide_start(path, hidden / _RATE)
    assert read_video_size(path)[0] == _COUNT - hidden
    np.testing.assert_array_equal(_read(path), whole[hidden:])
    place = data.index(b"elst") + 12
    (ticks,) = struct.unpack_from(">I", data, place)
    struct.pack_into(">I", data, place, ticks * (_COUNT - hidden) // _COUNT)
    path.write_bytes(data)
    kept = _read(path)
    assert 0 < len(kept) == read_video_size(path)[0] < _COUNT
    np.testing.assert_array_equal(kept, _decoded(path))
    np.testing.assert_array_equal(kept, whole[: len(kept)])


@pytest.mark.parametrize("suffix", [".mkv", ".mp4"])
def test_frames_that_need_what_was_cut_off_do_not_count(tmp_path: Path, suffix: str) -> None:
    """A cut without encoding at a key frame that others before it refer to."""
    path, whole = tmp_path / f"cut{suffix}", _write(tmp_path / "whole.mkv", "opengop")
    with av.open(str(whole)) as source, av.open(str(path), "w") as output:
        stream = output.add_stream_from_template(source.streams.video[0])
        keys = 0
        for packet in source.demux(video=0):
            keys += packet.is_keyframe
            if keys > 1 and packet.size:
                packet.stream = stream
                output.mux(packet)
    assert 0 < len(_decoded(path)) < _COUNT
    np.testing.assert_array_equal(_read(path), _decoded(path))


def _hide(path: Path, number: int) -> None:
    """Make a frame of VP8 one that is not shown: bit 4 of its first byte (RFC 6386, 9.1)."""
    with av.open(str(path)) as container:
        packet = [bytes(packet) for packet in container.demux(video=0)][number]
    hidden = bytes([packet[0] & ~0x10]) + packet[1:]
    path.write_bytes(path.read_bytes().replace(packet, hidden))


def test_reference_frames_of_vp8_do_not_count(tmp_path: Path) -> None:
    path = _write(tmp_path / "a.mkv", "vp8")
    _hide(path, 5)
    assert len(_decoded(path)) == _COUNT - 1
    np.testing.assert_array_equal(_read(path), _decoded(path))


@pytest.mark.parametrize(
    ("suffix", "quarter_turns", "mirrored"),
    [(".mp4", 1, ""), (".mkv", 3, ""), (".mp4", 0, "hflip"), (".mkv", 1, "vflip")],
)
def test_frames_are_upright(tmp_path: Path, suffix: str, quarter_turns: int, mirrored: str) -> None:
    """Counterclockwise by quarter quarter_turns, and then mirrored."""

    def rotate(stream: Any) -> None:
        stream.set_display_rotation(90 * quarter_turns, **({mirrored: True} if mirrored else {}))

    stored = _pictures(2)
    path = _write(tmp_path / f"a{suffix}", "lossless", stored, setup=rotate)
    flip: Any = {"": lambda a: a, "hflip": np.fliplr, "vflip": np.flipud}[mirrored]
    shown = [flip(np.rot90(rgb, quarter_turns)) for rgb in stored]
    assert read_video_size(path) == (2, *shown[0].shape[:2])
    np.testing.assert_array_equal(_read(path), shown)
    seen: dict[int, NDArray[np.uint8]] = {}
    size = (2, *shown[0].shape[:2])
    write_video(tmp_path / "b.mp4", path, size, seen.setdefault)
    np.testing.assert_array_equal([seen[0], seen[1]], shown)
    again = np.array(_decoded(tmp_path / "b.mp4"), float)
    assert again.shape == np.shape(shown)
    assert np.abs(again - shown).mean() < 20  # compressed, with colors at half resolution


def test_other_rotations_are_refused(tmp_path: Path) -> None:
    path = _write(tmp_path / "a.mp4", setup=lambda stream: stream.set_display_rotation(30))
    with pytest.raises(DataError, match=r"a\.mp4: found a rotation by 30°"):
        read_video_size(path)


@pytest.mark.parametrize(
    ("suffix", "quarter_turns", "stored", "aspect", "shown"),
    [
        (".mp4", 0, (64, 64), (2, 1), (64, 128)),
        (".mkv", 1, (64, 128), (1, 2), (128, 128)),
        (".mp4", 1, (64, 96), (4, 3), (64, 128)),
        (".mkv", 0, (64, 128), (1001, 1000), (64, 128)),
    ],
)
def test_the_display_size_decides(
    tmp_path: Path,
    suffix: str,
    quarter_turns: int,
    stored: tuple[int, int],
    aspect: tuple[int, int],
    shown: tuple[int, int],
) -> None:
    """The pixel aspect is that of stored pixels, before they are rotated."""

    def setup(stream: Any) -> None:
        stream.codec_context.sample_aspect_ratio = Fraction(*aspect)
        stream.set_display_rotation(90 * quarter_turns)

    rows, columns = (np.arange(n) for n in shown)
    ramp = np.stack(np.broadcast_arrays(columns, 2 * rows[:, None], 0), axis=-1).astype(np.uint8)
    picked = np.ix_(*((np.arange(n) + 0.5) * m / n for n, m in zip(stored, shown, strict=True)))
    squeezed = np.ascontiguousarray(ramp[picked[0].astype(int), picked[1].astype(int)])
    path = _write(tmp_path / f"a{suffix}", "lossless", [squeezed], setup=setup)
    expected = np.rot90(ramp, quarter_turns)
    assert read_video_size(path) == (1, *expected.shape[:2])
    inner = np.s_[2:-2, 2:-2]
    difference = np.abs(np.subtract(_read(path)[0], expected, dtype=float))[inner]
    assert difference.max() <= 2, "half a pixel of the ramps, and rounding"


_FLAT = projection_boxes(b"equi")
_TILE = projection_boxes(b"equi", (0, -24.5, 8.75), (0.25, 0, 0.125, 0.5))
_POSE = {"PosePitchDegrees": "-24.5", "PoseRollDegrees": "8.75"}
_PART = dict(zip(PART_TAGS, ("2", "1", "0.75", "0.75", "0.25", "0.25"), strict=True))


@pytest.mark.parametrize(
    ("boxes", "tags"),
    [
        (b"", {}),
        (_FLAT, dict.fromkeys(_POSE, "0.0")),
        (_TILE, _POSE | _PART),
        (stereo_box(0), {}),
        (stereo_box(1), {"StereoMode": "top-bottom"}),
        (stereo_box(2) + _TILE, {"StereoMode": "left-right"} | _POSE | _PART),
        (stereo_box(4), {"StereoMode": "right-left"}),
        (stereo_box(3), "stereo of mode 3"),
        (projection_boxes(b"mshp"), "the projection mshp"),
        (projection_boxes(b"cyli"), "the projection cyli"),
        (projection_boxes(b"cbmp"), "a cube map"),
    ],
)
def test_layouts_that_the_metadata_state(
    tmp_path: Path, boxes: bytes, tags: dict[str, str] | str
) -> None:
    """Boxes of Google's Spherical Video V2: angles of 16.16 and shares of 0.32 bits."""
    path = _write(tmp_path / "a.mp4")
    insert_boxes(path, boxes)
    if not isinstance(tags, str):
        assert read_video_size(path) == (_COUNT, 64, 128)
        assert read_video_tags(path) == next(read_frames(path)).tags
        assert read_video_tags(path) == tags
        return
    with pytest.raises(DataError, match=f"found a video with {tags}"):
        read_video_size(path)


_HALF = dict(zip(PART_TAGS, ("256", "128", "128", "64", "64", "32"), strict=True))
_STATED = {"Spherical": "true", "Stitched": "true", "ProjectionType": "equirectangular"}


@pytest.mark.parametrize(
    ("tags", "error"),
    [
        (_STATED | {"InitialViewPitchDegrees": "20"}, None),
        (_STATED | _HALF, None),
        (_STATED | {"StereoMode": "top-bottom"}, None),
        (_STATED | {"StereoMode": "custom"}, "stereo of custom"),
        (_STATED | {"Stitched": "false"}, "pictures that are not stitched"),
    ],
)
def test_spherical_video_v1(tmp_path: Path, tags: dict[str, str], error: str | None) -> None:
    """The first look of V1 is not the pose of the camera."""
    path = _write(tmp_path / "a.mp4")
    insert_boxes(path, spherical_v1(tags), (b"moov", b"trak"))
    if error is None:
        assert read_video_tags(path) == tags
        area = read_area(path, (64, 128), tags=tags)
        assert area.full_shape == ((128, 256) if _HALF.items() <= tags.items() else (64, 128))
        return
    with pytest.raises(DataError, match=f"found a video with {error}"):
        read_video_size(path)


@pytest.mark.parametrize("mode", ["left-right", "right-left", "top-bottom", "bottom-top"])
def test_the_eyes_of_matroska(tmp_path: Path, mode: str) -> None:
    def setup(stream: Any) -> None:
        stream.metadata["stereo_mode"] = mode.replace("-", "_")

    assert read_video_tags(_write(tmp_path / "a.mkv", setup=setup)) == {"StereoMode": mode}


def _pq_nits(signal: NDArray[np.float64]) -> NDArray[np.float64]:
    """Display light in cd/m² (SMPTE ST 2084)."""
    power = signal ** (32 / 2523)
    return 1e4 * (np.maximum(power - 107 / 128, 0) / (2413 / 128 - 2392 / 128 * power)) ** (
        8192 / 1305
    )


def _hlg_nits(signal: NDArray[np.float64]) -> NDArray[np.float64]:
    """Display light in cd/m² of a display of 1000 cd/m² (Rec. ITU-R BT.2100)."""
    high = (np.exp((signal - 0.55991073) / 0.17883277) + 0.28466892) / 12
    return 1000 * np.where(signal <= 0.5, signal**2 / 3, high) ** 1.2


@pytest.mark.parametrize(("transfer", "nits"), [(16, _pq_nits), (18, _hlg_nits)])
def test_high_dynamic_range_becomes_srgb(
    tmp_path: Path, transfer: int, nits: Callable[[Any], Any]
) -> None:
    """A gray ramp; white is 203 cd/m² (Rec. ITU-R BT.2408)."""

    def setup(stream: Any) -> None:
        context = stream.codec_context
        context.color_trc, context.color_primaries, context.colorspace = transfer, 9, 0

    signal = np.tile(np.linspace(0, 1, 128), (64, 1))
    gray = np.repeat(np.rint(255 * signal).astype(np.uint8)[..., None], 3, axis=-1)
    path = _write(tmp_path / "a.mkv", "lossless", [gray], setup=setup)
    light = np.minimum(nits(np.rint(255 * signal) / 255) / 203, 1)
    srgb = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    shown = _read(path)[0].astype(float)
    assert np.ptp(shown, axis=-1).max() <= 2, "gray remains gray"
    assert np.abs(shown[..., 1] - 255 * srgb).max() <= 6


@pytest.mark.parametrize(
    ("name", "settings"),
    [
        ("x264.mp4", {"movflags": "faststart"}),
        ("vp9.webm", {}),
        ("mpeg4.avi", {}),
    ],
)
def test_truncated_videos_are_an_error_after_their_frames(
    tmp_path: Path, name: str, settings: Any
) -> None:
    path = _write(tmp_path / name, name.partition(".")[0], **settings)
    whole, data = _decoded(path), path.read_bytes()
    for part in (0.2, 0.4, 0.6):
        path.write_bytes(data[: round(part * len(data))])
        kept = []
        with pytest.raises(DataError, match=rf"{name}: found"):  # noqa: PT012
            for frame in read_frames(path):
                kept.append(frame())  # noqa: PERF401 - those before the error
        assert len(kept) < _COUNT
        np.testing.assert_array_equal(kept[:-1], whole[: len(kept)][:-1])


def _packets(path: Path) -> list[tuple[int, int]]:
    """Place and size of the packets in a file."""
    with av.open(str(path)) as container:
        return [(packet.pos, packet.size) for packet in container.demux(video=0) if packet.size]


@pytest.mark.parametrize("name", ["forward.mp4", "forward.mkv", "av1.webm"])
def test_a_damaged_frame_is_an_error_after_those_before(tmp_path: Path, name: str) -> None:
    path = _write(tmp_path / name, name.partition(".")[0])
    whole, data = _decoded(path), bytearray(path.read_bytes())
    start, size = _packets(path)[7]
    data[start + 12 : start + size] = b"\x55" * (size - 12)
    path.write_bytes(data)
    kept = []
    with pytest.raises(DataError, match=r"found a (truncated or damaged|video that cannot)"):  # noqa: PT012
        for frame in read_frames(path):
            kept.append(frame())  # noqa: PERF401 - those before the error
    assert 0 < len(kept) < _COUNT
    np.testing.assert_array_equal(kept, whole[: len(kept)])


def test_a_video_without_a_frame_and_another_number_of_frames(tmp_path: Path) -> None:
    path = _write(tmp_path / "a.mkv", "vp8", _pictures(1))
    _hide(path, 0)
    with pytest.raises(DataError, match=r"a\.mkv: found no frame that can be decoded"):
        read_video_size(path)
    with pytest.raises(DataError, match="12 of 13 frames"):
        list(read_frames(_write(tmp_path / "b.mkv"), _COUNT + 1))


def test_names_and_contents_open_nothing_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    whole = _write(tmp_path / "neighbor.mp4")
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(0.2)
        port = server.getsockname()[1]
        for name in (f"tcp:127.0.0.1:{port}.mp4", f"http:127.0.0.1:{port}.mkv", "a%03d.mp4"):
            Path(name).write_bytes(whole.read_bytes())
            assert read_video_size(Path(name)) == (_COUNT, 64, 128)
        written = Path(f"tcp:127.0.0.1:{port}") / "a.mp4"
        write_video(written, whole, (_COUNT, 64, 128), lambda _, rgb: rgb)
        assert len(_decoded(tmp_path / written)) == _COUNT
        texts = (
            "ffconcat version 1.0\nfile neighbor.mp4\n",
            f"#EXTM3U\n#EXT-X-TARGETDURATION:9\n#EXTINF:9,\nhttp://127.0.0.1:{port}/a.ts\n",
            "#EXTM3U\n#EXT-X-TARGETDURATION:9\n#EXTINF:9,\nneighbor.mp4\n#EXT-X-ENDLIST\n",
            f"v=0\no=- 0 0 IN IP4 127.0.0.1\ns=x\nc=IN IP4 127.0.0.1\nm=video {port} RTP/AVP 96\n",
        )
        for suffix in (".mp4", ".mkv", ".avi"):
            for text in texts:
                path = tmp_path / f"x{suffix}"
                path.write_text(text)
                with pytest.raises(DataError, match="found a video that cannot be decoded"):
                    read_video_size(path)
        with pytest.raises(TimeoutError):
            server.accept()


def test_texts_that_are_not_utf_8_do_not_matter(tmp_path: Path) -> None:
    path = _write(tmp_path / "a.avi", "mpeg4")
    data = path.read_bytes()
    assert b"Lavf" in data
    path.write_bytes(data.replace(b"Lavf", b"L\xe4vf"))
    assert read_video_size(path)[0] == _COUNT
