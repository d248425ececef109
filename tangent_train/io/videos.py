"""Videos: reading frames, and writing videos with the frame times of another video."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator
from contextlib import closing, contextmanager
from functools import partial
from itertools import count, takewhile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tangent_train.errors import DataError, of_extra
from tangent_train.files import atomic_path
from tangent_train.threads import in_threads

VIDEO_SUFFIXES = (".mp4", ".mov", ".m4v", ".mkv", ".webm", ".avi")
"""Suffixes of videos, in lower case."""

_READERS = "mov,matroska,avi"
"""FFmpeg's demuxers of these formats. Other demuxers read playlists, scripts and further files."""

_MICROSECONDS = 10**6
_MISSING_S = 0.5
"""Part of the declared duration that a whole video may lack: frames are not always as long."""

_SHOWN_VP8 = 0x10
_UPRIGHT_SIGNS = np.eye(2, dtype=np.int64)
_AHEAD = 2
_ENCODER = "libx264"
_QUALITY = {"crf": "18", "preset": "veryfast"}
_BT709 = 1  # of the matrix, primaries and transfer: what players assume of large videos


def read_video_size(path: Path) -> tuple[int, int, int]:
    """Return the number of frames that a video declares, and rows and columns of an upright frame.

    All packets are read; only the first frame is decoded.

    Raises:
        DataError: The video cannot be read, or has no frames.
        SettingError: PyAV is missing.
    """
    first, times, packets, end_s = None, [], 0, 0.0
    with _opened(path) as (container, stream):
        for packet in container.demux():
            if packet.pts is not None:
                end = (packet.pts + (packet.duration or 0)) * packet.time_base
                end_s = max(end_s, float(end))
            if packet.stream == stream:
                packets += packet.size > 0
                times += [packet.pts] if packet.size and _is_shown(packet) else []
                first = first or next(iter(packet.decode()), None)
        indexed = sum(entry.size > 0 for entry in stream.index_entries)
        # MP4 files have an index of all frames, the others a duration.
        is_cut = (container.duration or 0) / _MICROSECONDS - end_s > _MISSING_S
        is_cut &= "mov" not in container.format.name
    if first is None:
        raise DataError(path, found="no frame that can be decoded", expected="a whole video")
    # Cutting without encoding leaves frames at the start that refer to missing ones.
    early = sum(None not in (time, first.pts) and time < first.pts for time in times)
    declared = max(indexed, packets + is_cut) - (packets - len(times)) - early
    return declared, *_upright(first, _orientation(first)).shape[:2]


def read_frames(
    path: Path, frames: int | None = None, every: int = 1
) -> Generator[Callable[[], NDArray[np.uint8]]]:
    """Yield the first and then every n-th frame of a video, decoded in a thread a few ahead.

    Args:
        path: Video file.
        frames: Number of frames, see `read_video_size`; None to read it.
        every: Step n between frames.

    Yields:
        Function that converts a frame to upright RGB, ``(H, W, 3)``.

    Raises:
        DataError: A frame is damaged, or the video ends before its declared length: after the
            frames that were read.
    """
    for frame in _frames(path, read_video_size(path)[0] if frames is None else frames, every):
        yield partial(_upright, *frame)


def _frames(path: Path, expected: int, every: int) -> Generator[tuple[Any, NDArray[np.int64]]]:
    """Yield frames with their orientation, see `_orientation`."""

    def decoded() -> Generator[tuple[Any, NDArray[np.int64]]]:
        number, signs = 0, _UPRIGHT_SIGNS
        with _opened(path) as (container, stream):
            for frame in container.decode(stream):
                if frame.is_corrupt:  # and frames before that refer to it
                    break
                # Within an H.264 stream, only the first frame may have the matrix.
                signs = _orientation(frame) if number == 0 else signs
                if number % every == 0:
                    yield frame, signs
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
    with closing(in_threads(lambda _: next(source, None), count(), 1, _AHEAD)) as frames:
        yield from takewhile(lambda frame: frame is not None, frames)


@contextmanager
def _opened(path: Path) -> Iterator[tuple[Any, Any]]:
    """Return a context with a container and its video stream; its errors name the file."""
    with of_extra("video", path):
        import av
    options = {"format_whitelist": _READERS, "protocol_whitelist": "file"}
    try:
        with av.open(
            _file_url(path), container_options=options, metadata_errors="replace"
        ) as container:
            stream: Any = container.streams.best("video")
            if stream is None or stream.codec_context is None:
                expected = "a video stream of a codec that FFmpeg has"
                raise DataError(path, found="no video stream", expected=expected)
            stream.thread_type = "AUTO"
            yield container, stream
    except av.FFmpegError as error:
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


def _orientation(frame: Any) -> NDArray[np.int64]:
    """Return the signs ``(2, 2)`` of the transposed display matrix of a frame, or the identity.

    The matrix M of ISO 14496-12 maps a stored pixel [x y 1] to the displayed pixel [x y 1] M. Other
    rotations than by quarter turns are rounded to these.
    """
    data = frame.side_data.get("DISPLAYMATRIX")
    if data is None:
        return _UPRIGHT_SIGNS
    # Its rows give the column and the row of a displayed pixel.
    matrix = np.frombuffer(bytes(data), np.int32).reshape(3, 3)[:2, :2].T.astype(float)
    return np.rint(matrix / np.maximum(abs(matrix).max(axis=1, keepdims=True), 1)).astype(np.int64)


def _upright(frame: Any, signs: NDArray[np.int64]) -> NDArray[np.uint8]:
    """Convert a frame to RGB ``(H, W, 3)`` as players show it, by its `_orientation`."""
    rgb: NDArray[np.uint8] = frame.to_ndarray(format="rgb24")
    rgb = rgb if signs[0, 0] else rgb.swapaxes(0, 1)
    column_step, row_step = signs.sum(axis=1)
    return np.ascontiguousarray(rgb[::row_step, ::column_step])


def write_video(
    path: Path,
    source: Path,
    size: tuple[int, int, int],
    paint: Callable[[int, NDArray[np.uint8]], NDArray[np.uint8]],
    every: int = 1,
) -> None:
    """Write a video (H.264 in MP4) with size, rate and frame times of another one, without sound.

    Args:
        path: New file, which appears when it is complete.
        source: Source video.
        size: Number of frames, rows and columns of the source, see `read_video_size`.
        paint: Function that returns a new frame ``(H, W, 3)`` for the number of a frame and the
            upright source frame; called in threads.
        every: Step n: the first and then every n-th frame is written.

    Raises:
        DataError: The source cannot be decoded.
        SettingError: The disk is full.
    """
    import av
    from av.video.reformatter import Colorspace

    expected, rows, columns = size

    def painted(numbered: tuple[int, tuple[Any, NDArray[np.int64]]]) -> Any:
        place, (frame, signs) = numbered
        number = place * every
        picture = np.ascontiguousarray(paint(number, _upright(frame, signs)))
        made = av.VideoFrame.from_ndarray(picture, format="rgb24")
        made = made.reformat(columns, rows, pixels, dst_colorspace=Colorspace.ITU709)
        made.time_base = stream.time_base
        made.pts = number * step if frame.pts is None else frame.pts
        return made

    with (
        atomic_path(path) as temporary,
        _opened(source) as (_, stream),
        av.open(_file_url(temporary), "w", format="mp4") as output,
    ):
        rate = stream.average_rate or 30
        step = max(1, round(1 / (rate * stream.time_base)))
        # Players expect colors at half the resolution, which requires an even size.
        pixels = "yuv444p" if rows % 2 or columns % 2 else "yuv420p"
        encoder: Any = output.add_stream(_ENCODER, rate=rate, options=_QUALITY)
        encoder.width, encoder.height, encoder.pix_fmt = columns, rows, pixels
        encoder.codec_context.time_base = stream.time_base
        encoder.codec_context.colorspace = encoder.codec_context.color_primaries = _BT709
        encoder.codec_context.color_trc = _BT709
        numbered = enumerate(_frames(source, expected, every))
        with closing(in_threads(painted, numbered, ahead=_AHEAD)) as frames:
            for frame in frames:
                output.mux(encoder.encode(frame))
        output.mux(encoder.encode(None))
