"""Videos: their frames one after another, and new videos with the times of another."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator
from contextlib import closing, contextmanager
from functools import partial
from itertools import count, takewhile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from datamodules.images.png import check_pixels
from tangent_train.errors import DataError, of_extra
from tangent_train.files import atomic_path
from tangent_train.threads import in_threads

VIDEO_SUFFIXES = (".mp4", ".mov", ".m4v", ".mkv", ".webm", ".avi")
"""Suffixes of videos, in lower case."""

_AHEAD = 2
_ENCODER = "libx264"
_QUALITY = {"crf": "18", "preset": "veryfast"}
_BT709 = 1  # of the matrix, primaries and transfer: what players assume of large videos


@contextmanager
def _opened(path: Path) -> Iterator[tuple[Any, Any]]:
    """A container and its first video stream; errors in the block name the file."""
    with of_extra("video", path):
        import av
    try:
        with av.open(str(path)) as container:
            if not container.streams.video:
                raise DataError(path, found="no video stream", expected="a video")
            stream = container.streams.video[0]
            stream.thread_type = "AUTO"
            yield container, stream
    except av.FFmpegError as error:
        raise DataError(
            path,
            found=f"a video that cannot be decoded ({error.strerror})",
            expected="one that decodes to its end",
            remedy="Copy or export it again.",
        ) from error


def read_video_size(path: Path) -> tuple[int, int, int]:
    """Number of frames, rows and columns of a video; nothing is decoded.

    Raises:
        DataError: It cannot be read, or has no video stream or no frames.
        SettingError: PyAV is missing.
    """
    with _opened(path) as (container, stream):
        # Some formats do not say it: their packets are counted.
        frames = stream.frames or sum(packet.size > 0 for packet in container.demux(stream))
        if not frames:
            raise DataError(path, found="no frames", expected="a whole video")
        check_pixels(path, stream.height, stream.width)
        return frames, stream.height, stream.width


def read_frames(path: Path) -> Generator[Callable[[], NDArray[np.uint8]]]:
    """The frames of a video, decoded in a thread a few ahead.

    Yields:
        What gives a frame in RGB, ``(H, W, 3)``; not calling it saves the conversion.

    Raises:
        DataError: The video cannot be decoded to its end.
    """
    for frame in _frames(path):
        yield partial(frame.to_ndarray, format="rgb24")


def _frames(path: Path) -> Generator[Any]:
    def decoded() -> Generator[Any]:
        with _opened(path) as (container, stream):
            yield from container.decode(stream)

    source = decoded()
    with closing(in_threads(lambda _: next(source, None), count(), 1, _AHEAD)) as frames:
        yield from takewhile(lambda frame: frame is not None, frames)


def write_video(
    path: Path, source: Path, paint: Callable[[int, NDArray[np.uint8]], NDArray[np.uint8]]
) -> None:
    """Write a video (H.264 in MP4) with the size, rate and times of another; without its sound.

    Args:
        path: The file, which appears once complete.
        source: The other video.
        paint: Gives a frame ``(H, W, 3)`` of the new one, by its number and the other's. Called in
            threads.

    Raises:
        DataError: The other one cannot be decoded.
        SettingError: The disk is full.
    """
    import av
    from av.video.reformatter import Colorspace

    def painted(numbered: tuple[int, Any]) -> Any:
        number, frame = numbered
        picture = np.ascontiguousarray(paint(number, frame.to_ndarray(format="rgb24")))
        made = av.VideoFrame.from_ndarray(picture, format="rgb24")
        made = made.reformat(format=pixels, dst_colorspace=Colorspace.ITU709)
        made.time_base = stream.time_base
        made.pts = number * step if frame.pts is None else frame.pts
        return made

    with (
        atomic_path(path) as temporary,
        _opened(source) as (_, stream),
        av.open(str(temporary), "w", format="mp4") as output,
    ):
        rate = stream.average_rate or 30
        step = max(1, round(1 / (rate * stream.time_base)))
        # Players want colours at half the resolution, which takes an even size.
        pixels = "yuv444p" if stream.height % 2 or stream.width % 2 else "yuv420p"
        encoder: Any = output.add_stream(_ENCODER, rate=rate, options=_QUALITY)
        encoder.width, encoder.height, encoder.pix_fmt = stream.width, stream.height, pixels
        encoder.codec_context.time_base = stream.time_base
        encoder.codec_context.colorspace = encoder.codec_context.color_primaries = _BT709
        encoder.codec_context.color_trc = _BT709
        with closing(in_threads(painted, enumerate(_frames(source)), ahead=_AHEAD)) as frames:
            for frame in frames:
                output.mux(encoder.encode(frame))
        output.mux(encoder.encode(None))
