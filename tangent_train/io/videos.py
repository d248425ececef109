"""Videos: reading frames, and writing videos with the frame times of another video."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from itertools import count, takewhile
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tangent_train.errors import DataError, of_extra
from tangent_train.files import atomic_path, checked_file
from tangent_train.io.gpano import PART_TAGS, tags_of
from tangent_train.io.mp4_boxes import spherical_boxes
from tangent_train.threads import in_threads

_READERS = "mov,matroska,avi"
"""FFmpeg's demuxers of these formats. Other demuxers read playlists, scripts and further files."""

_MICROSECONDS = 10**6
_MISSING_S = 0.5
"""Part of the declared duration that a whole video may lack: frames are not always as long."""

_SHOWN_VP8 = 0x10
_UPRIGHT_SIGNS = np.eye(2, dtype=np.int64)
_SKEW = 0.02
"""Entries of a display matrix may differ from a quarter turn by this: one degree."""
_SQUARE = 0.01
"""Pixels are square up to this rounding of their aspect ratio."""
_PQ, _HLG = 16, 18  # transfer functions of Rec. ITU-R BT.2100
_SRGB: dict[str, Any] = {"dst_color_trc": 13, "dst_color_primaries": 1}
_PROJECTIONS = {1: "a cube map", 3: "half a sphere", 5: "a fisheye picture"}
_TILE = 2
_STEREO = dict.fromkeys(range(3, 8), "interleaved pictures of two eyes (stereo)")
"""Values of FFmpeg's side data, ``AVSphericalProjection`` and ``AVStereo3DType``."""
_HALVES = {(1, 0): "left-right", (1, 1): "right-left", (2, 0): "top-bottom", (2, 1): "bottom-top"}
"""`StereoMode` by ``AVStereo3DType`` and inversion: the half of the left eye is named first."""
_MODES = ("mono", *_HALVES.values())
_WHOLE = (slice(None), slice(None))
_AHEAD = 2
_USUAL_RATE = 30
_ENCODER = "libx264"
_QUALITY = {"crf": "18", "preset": "veryfast"}
_BT709 = 1  # of the matrix, primaries and transfer: what players assume of large videos


class _Display(NamedTuple):
    """How the frames of a video are shown.

    Attributes:
        signs: ``(2, 2)`` signs of the transposed display matrix.
        options: Arguments of PyAV's ``reformat``: a size of square pixels, colors of sRGB.
        tags: See `read_video_tags`.
    """

    signs: NDArray[np.int64] = _UPRIGHT_SIGNS
    options: dict[str, Any] = {}  # noqa: RUF012 - never changed
    tags: dict[str, str] = {}  # noqa: RUF012 - never changed


@dataclass(frozen=True)
class Frame:
    """A decoded frame; call it to convert it to upright RGB, ``(H, W, 3)`` uint8.

    Attributes:
        number: Number in the video, from 0.
        time_s: Presentation time in seconds.
        picture: Frame of PyAV.
        display: How it is shown.
        half: Rows and columns that are used: those of one eye.
    """

    number: int
    time_s: float
    picture: Any
    display: _Display
    half: tuple[slice, slice] = _WHOLE

    def __call__(self) -> NDArray[np.uint8]:
        """Return upright RGB with square pixels, ``(H, W, 3)``."""
        return np.ascontiguousarray(_upright(self.picture, self.display)[self.half])

    @property
    def tags(self) -> dict[str, str]:
        """See `read_video_tags`."""
        return self.display.tags


def read_video_size(path: Path) -> tuple[int, int, int]:
    """Return the number of frames that a video declares, and rows and columns of an upright frame.

    All packets are read; only the first frame is decoded.

    Raises:
        DataError: The video cannot be read, or has no frames.
        SettingError: PyAV is missing.
    """
    first, times, packets, end_s = None, [], 0, 0.0
    with open_video(path) as (container, stream):
        for packet in container.demux():
            if packet.pts is not None:
                end = (packet.pts + (packet.duration or 0)) * packet.time_base
                end_s = max(end_s, float(end))
            if packet.stream == stream:
                packets += packet.size > 0
                times += [packet.pts] if packet.size and _is_shown(packet) else []
                first = first or next(iter(packet.decode()), None)
        if first is None:
            raise DataError(path, found="no frame that can be decoded", expected="a whole video")
        shape = _upright(first, _display(path, stream, first)).shape
        indexed = sum(entry.size > 0 for entry in stream.index_entries)
        # MP4 files have an index of all frames, the others a duration.
        is_cut = (container.duration or 0) / _MICROSECONDS - end_s > _MISSING_S
        is_cut &= "mov" not in container.format.name
    # Cutting without encoding leaves frames at the start that refer to missing ones.
    early = sum(None not in (time, first.pts) and time < first.pts for time in times)
    declared = max(indexed, packets + is_cut) - (packets - len(times)) - early
    return declared, shape[0], shape[1]


def read_video_tags(path: Path) -> dict[str, str]:
    """Return the spherical metadata of a video as GPano tags, see `tangent_train.io.gpano`.

    Returns:
        Pose, area and `StereoMode`, as far as they are stated.

    Raises:
        DataError: They name a layout that cannot be used, or the video cannot be decoded.
    """
    with open_video(path) as (container, stream):
        return _tags(path, next(container.decode(stream)))


def read_frames(
    path: Path,
    frames: int | None = None,
    every: int = 1,
    half: tuple[slice, slice] = _WHOLE,
) -> Generator[Frame]:
    """Yield the first and then every n-th frame of a video, decoded in a thread a few ahead.

    Args:
        path: Video file.
        frames: Number of frames, see `read_video_size`; None to read it.
        every: Step n between frames.
        half: Rows and columns of each frame that are used.

    Yields:
        Frames, which convert themselves to RGB when they are called.

    Raises:
        DataError: A frame is damaged, or the video ends before its declared length: after the
            frames that were read.
    """
    expected = read_video_size(path)[0] if frames is None else frames

    def decoded() -> Generator[Frame]:
        number, display = 0, _Display()
        with open_video(path) as (container, stream):
            for picture in container.decode(stream):
                if picture.is_corrupt:  # and frames before that refer to it
                    break
                # Within an H.264 stream, only the first frame may have the matrix.
                display = _display(path, stream, picture) if number == 0 else display
                if number % every == 0:
                    late = float(number / (stream.average_rate or _USUAL_RATE))
                    time_s = late if picture.pts is None else picture.time
                    yield Frame(number, time_s, picture, display, half)
                number += 1
        if number != expected:
            raise DataError(
                path,
                found=f"a truncated or damaged video ({number} of {expected} frames)",
                expected="a whole one",
                remedy="Copy or export it again. To use what is left of it, repair it, for example "
                "with ffmpeg -i <video> -c copy <repaired>.",
            )

    source = decoded()
    with closing(in_threads(lambda _: next(source, None), count(), 1, _AHEAD)) as read:
        yield from takewhile(lambda frame: frame is not None, read)


@contextmanager
def open_video(path: Path) -> Iterator[tuple[Any, Any]]:
    """Return a context with a container and its video stream; its errors name the file."""
    with of_extra("video", path):
        import av
    options = {"format_whitelist": _READERS, "protocol_whitelist": "file"}
    try:
        with av.open(
            _file_url(checked_file(path)), container_options=options, metadata_errors="replace"
        ) as container:
            stream: Any = container.streams.best("video")
            if stream is None or stream.codec_context is None:
                expected = "a video stream of a codec that FFmpeg has"
                raise DataError(path, found="no video stream", expected=expected)
            stream.thread_type = "AUTO"
            yield container, stream
    except (av.FFmpegError, OSError) as error:
        raise DataError(
            path,
            found=f"a video that cannot be decoded ({error.strerror})",
            expected="a whole MP4, QuickTime, Matroska, WebM or AVI file",
            remedy="Copy or export it again.",
        ) from error


def _file_url(path: Path) -> str:
    # A bare name may select another protocol, e.g. "http:…".
    return f"file:{path.absolute()}"


def _is_shown(packet: Any) -> bool:
    """Return False for packets that an edit list hides and VP8 reference frames (RFC 6386, 9.1)."""
    hidden = packet.stream.codec_context.name == "vp8" and not bytes(packet)[0] & _SHOWN_VP8
    return not (packet.is_discard or hidden)


def _display(path: Path, stream: Any, frame: Any) -> _Display:
    """Return how the frames of a video are shown, by its first frame.

    The matrix M of ISO 14496-12 maps a stored pixel [x y 1] to the displayed pixel [x y 1] M. PQ
    and HLG are converted to sRGB, where white is 203 cd/m² (Rec. ITU-R BT.2408).

    Raises:
        DataError: It is rotated by other angles than quarter turns.
    """
    signs, options, data = _UPRIGHT_SIGNS, {}, frame.side_data.get("DISPLAYMATRIX")
    if data is not None:
        # Its rows give the column and the row of a displayed pixel.
        matrix = np.frombuffer(bytes(data), np.int32).reshape(3, 3)[:2, :2].T.astype(float)
        matrix /= np.maximum(np.hypot(*matrix.T)[:, None], 1)
        signs = np.rint(matrix).astype(np.int64)
        if np.abs(matrix - signs).max() > _SKEW or abs(np.linalg.det(signs)) != 1:
            raise DataError(
                path,
                found=f"a rotation by {np.degrees(np.arctan2(*matrix[0, ::-1])):.3g}°",
                expected="a video that is shown rotated by 0, 90, 180 or 270°",
                remedy="Export it again without rotation.",
            )
    aspect = float(stream.sample_aspect_ratio or 1)
    if abs(aspect - 1) > _SQUARE:
        options["width"] = round(frame.width * max(aspect, 1))
        options["height"] = round(frame.height / min(aspect, 1))
    options |= _SRGB if frame.color_trc in (_PQ, _HLG) else {}
    return _Display(signs, options, _tags(path, frame))


def _tags(path: Path, frame: Any) -> dict[str, str]:
    """Return the tags of `read_video_tags`, from side data of the first frame, and boxes."""
    data = {kind: frame.side_data.get(kind) for kind in ("SPHERICAL", "STEREO3D")}
    sphere, stereo = (
        np.frombuffer(bytes(found or bytes(32))[:32], np.int32).tolist() for found in data.values()
    )
    boxes = spherical_boxes(path)
    tags = tags_of(path, boxes.xml)
    stated = boxes.mode or tags.pop("StereoMode", "").lower()
    mode = stated or _HALVES.get((stereo[0], stereo[1] & 1), "mono")
    found = _PROJECTIONS.get(sphere[0]) or _STEREO.get(stereo[0])
    if boxes.projection or mode not in _MODES:
        found = f"the projection {boxes.projection}" if boxes.projection else f"stereo of {mode}"
    if tags.get("Stitched", "true").lower() not in ("true", "1"):
        found = "pictures that are not stitched"
    if found:
        raise DataError(
            path,
            found=f"a video with {found}, by its metadata",
            expected="equirectangular pictures, or photos, in each frame",
            remedy="Convert it, for example with FFmpeg's filter v360 or stereo3d. To remove "
            "wrong metadata: ffmpeg -i <video> -c copy <new>.mp4.",
        )
    tags |= {} if mode == "mono" else {"StereoMode": mode}
    if data["SPHERICAL"] and not boxes.xml:  # V1 has the direction of the first look, not the pose
        tags["PosePitchDegrees"], tags["PoseRollDegrees"] = (str(n / 2**16) for n in sphere[2:4])
    if sphere[0] == _TILE:  # shares of the sphere that are cropped at its edges
        left, top, right, bottom = (n % 2**32 / 2**32 for n in sphere[4:])
        size = 2 * (1 - left - right), 1 - top - bottom
        part = dict(zip(PART_TAGS, (2, 1, *size, 2 * left, top), strict=True))
        tags |= {name: str(value) for name, value in part.items()}
    return tags


def _upright(frame: Any, display: _Display) -> NDArray[np.uint8]:
    """Convert a frame to RGB ``(H, W, 3)`` as players show it, by its `_display`."""
    rgb: NDArray[np.uint8] = frame.to_ndarray(format="rgb24", **display.options)
    rgb = rgb if display.signs[0, 0] else rgb.swapaxes(0, 1)
    column_step, row_step = display.signs.sum(axis=1)
    return np.ascontiguousarray(rgb[::row_step, ::column_step])


def write_video(
    path: Path,
    source: Path,
    size: tuple[int, int, int],
    paint: Callable[[int, NDArray[np.uint8]], NDArray[np.uint8]],
    every: int = 1,
    half: tuple[slice, slice] = _WHOLE,
) -> None:
    """Write a video (H.264 in MP4) with size, rate and frame times of another one, without sound.

    Args:
        path: New file, which appears when it is complete.
        source: Source video.
        size: Number of frames, rows and columns of the source, see `read_video_size`.
        paint: Function that returns a new frame ``(H, W, 3)`` for the number of a frame and the
            upright source frame; called in threads.
        every: Step n: the first and then every n-th frame is written.
        half: See `read_frames`; `size` has its rows and columns.

    Raises:
        DataError: The source cannot be decoded.
        SettingError: The disk is full.
    """
    import av
    from av.video.reformatter import Colorspace

    expected, rows, columns = size

    def painted(frame: Frame) -> Any:
        picture = np.ascontiguousarray(paint(frame.number, frame()))
        made = av.VideoFrame.from_ndarray(picture, format="rgb24")
        made = made.reformat(columns, rows, pixels, dst_colorspace=Colorspace.ITU709)
        made.time_base = stream.time_base
        pts = frame.picture.pts
        made.pts = frame.number * step if pts is None else pts
        return made

    with (
        atomic_path(path) as temporary,
        open_video(source) as (_, stream),
        av.open(_file_url(temporary), "w", format="mp4") as output,
    ):
        rate = stream.average_rate or _USUAL_RATE
        step = max(1, round(1 / (rate * stream.time_base)))
        # Players expect colors at half the resolution, which requires an even size.
        pixels = "yuv444p" if rows % 2 or columns % 2 else "yuv420p"
        encoder: Any = output.add_stream(_ENCODER, rate=rate, options=_QUALITY)
        encoder.width, encoder.height, encoder.pix_fmt = columns, rows, pixels
        encoder.codec_context.time_base = stream.time_base
        encoder.codec_context.colorspace = encoder.codec_context.color_primaries = _BT709
        encoder.codec_context.color_trc = _BT709
        read = read_frames(source, expected, every, half)
        with closing(in_threads(painted, read, ahead=_AHEAD)) as frames:
            for frame in frames:
                output.mux(encoder.encode(frame))
        output.mux(encoder.encode(None))
