"""Keypoints of one grey image: OpenCV's detectors, with positions that can be trusted."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import cv2
import numpy as np

from tangent_train.errors import SettingError

if TYPE_CHECKING:
    from numpy.typing import NDArray

__all__ = ["Detections", "Detector", "Norm"]

Norm = Literal["l2", "hamming"]

_cv2: Any = cv2  # its types leave out the detectors
_SMALLEST_SIDE = 16
"""Pixels; in smaller images nothing is found, and ORB's pyramid fails on the smallest."""


class Detections(NamedTuple):
    """What was found in one image.

    Attributes:
        points_xy: ``(n, 2)`` float64 column and row; pixel centres are integers.
        sizes: ``(n,)`` float64 diameters in pixels.
        angles_rad: ``(n,)`` float64 from right towards down.
        responses: ``(n,)`` float32.
        descriptors: ``(n, D)`` float32 or uint8.
        octaves: ``(n,)`` int32, the level of the pyramid, the finest 0; SIFT's are all 0.
    """

    points_xy: NDArray[np.float64]
    sizes: NDArray[np.float64]
    angles_rad: NDArray[np.float64]
    responses: NDArray[np.float32]
    descriptors: NDArray[np.float32] | NDArray[np.uint8]
    octaves: NDArray[np.int32]

    def select(self, chosen: NDArray[np.bool_] | NDArray[np.integer]) -> Detections:
        """Some of them, by mask or index."""
        parts: Any = (values[chosen] for values in self)
        return Detections(*parts)


class _Option(NamedTuple):
    """A number OpenCV takes; what lies outside crashes it or means nothing."""

    default: int | float
    least: float
    most: float


_OPTIONS: dict[str, dict[str, _Option]] = {
    "sift": {
        "nOctaveLayers": _Option(3, 1, 16),
        "contrastThreshold": _Option(0.04, 0.0, 1.0),
        "edgeThreshold": _Option(10.0, 1.0, 1e6),
        "sigma": _Option(1.6, 1.0, 16.0),
    },
    "orb": {
        "scaleFactor": _Option(1.2, 1.05, 4.0),
        "nlevels": _Option(8, 1, 16),
        "fastThreshold": _Option(20, 1, 255),
    },
    "akaze": {
        "threshold": _Option(0.001, 1e-9, 1.0),
        "nOctaves": _Option(4, 1, 8),
        "nOctaveLayers": _Option(4, 1, 8),
    },
}

_ORB_TOTAL = 10_000
_ALL = 2**24
"""More corners than an image has: which are the strongest is known when all images are done."""


@dataclass(frozen=True)
class Detector:
    """One of OpenCV's detectors, together with its descriptor.

    * ``sift`` runs with ``enable_precise_upscale``: without it OpenCV's positions are off by ¼
      pixel to the right and down.
    * ``orb``, ``akaze``: positions found in smaller copies of the image are taken back as the
      copies were made, pixel edges to pixel edges. OpenCV's are off by up to a pixel and more
      where sizes do not divide.
    * ``akaze`` is part of OpenCV 4; OpenCV 5 has it in its *contrib* builds only.

    Args:
        name: ``sift``, ``orb`` or ``akaze``.
        options: OpenCV's parameters under OpenCV's names, for what should not be its default:
            sift: nOctaveLayers, contrastThreshold, edgeThreshold, sigma; orb: scaleFactor, nlevels,
            fastThreshold; akaze: threshold, nOctaves, nOctaveLayers.
        max_keypoints: Most keypoints of a whole panorama, the strongest, however many images they
            come from; None is 10 000 for orb, whose corners are too many otherwise, and no limit
            for the others.

    Raises:
        SettingError: The detector or an option is unknown or out of range, or this OpenCV lacks
            the detector.

    >>> Detector("orb", {"fastThreshold": 7}).norm
    'hamming'
    """

    name: str = "sift"
    options: Mapping[str, float] = field(default_factory=dict)
    max_keypoints: int | None = None

    def __post_init__(self) -> None:
        if self.name not in _OPTIONS:
            expected = ", ".join(_OPTIONS)
            raise SettingError("detector", found=repr(self.name), expected=f"one of {expected}")
        _check_options(self.name, self.options)
        if self.max_keypoints is not None and self.max_keypoints < 1:
            raise SettingError("max_keypoints", found=self.max_keypoints, expected="1 or more")
        self._create()  # fails now rather than in a thread

    @property
    def norm(self) -> Norm:
        """How descriptors are compared: ``l2`` (float32) or ``hamming`` (bits in uint8)."""
        return "l2" if self.name == "sift" else "hamming"

    @property
    def limit(self) -> int | None:
        """Most keypoints of a panorama; None is no limit."""
        if self.max_keypoints is None and self.name == "orb":
            return _ORB_TOTAL
        return self.max_keypoints

    def detect(self, gray: NDArray[np.uint8]) -> Detections:
        """Find and describe keypoints. May be called from several threads at once.

        Args:
            gray: ``(h, w)`` uint8.

        Returns:
            All keypoints, in OpenCV's order. SIFT finds none within 1¾ pixels of the borders, ORB
            none within 31.

        Raises:
            SettingError: The image is no grey uint8 image.
        """
        if gray.ndim != 2 or gray.dtype != np.uint8:
            found = f"shape {gray.shape}, dtype {gray.dtype}"
            raise SettingError("grey image", found=found, expected="(h, w) uint8")
        engine = self._create()
        width = engine.descriptorSize()
        kind = np.float32 if self.norm == "l2" else np.uint8
        points: Any = ()
        descriptors = None
        if min(gray.shape) >= _SMALLEST_SIDE:
            points, descriptors = engine.detectAndCompute(np.ascontiguousarray(gray), None)
        if descriptors is None or not len(points):
            points, descriptors = (), np.empty((0, width), kind)
        return self._converted(points, descriptors, gray.shape)

    def strongest(
        self, responses: NDArray[np.float32], octaves: NDArray[np.int32]
    ) -> NDArray[np.int64]:
        """The keypoints of a panorama that stay within the limit.

        Those of the largest response. ORB's responses cannot be compared between the levels of its
        pyramid; as in OpenCV each level has its share, a geometric series with 1/scaleFactor, and
        what a level leaves of its share the others take.

        Args:
            responses: ``(n,)``.
            octaves: ``(n,)``.

        Returns:
            ``(m,)`` indices, ascending.
        """
        if self.limit is None or len(responses) <= self.limit:
            return np.arange(len(responses))
        order = np.lexsort((-responses, octaves))
        _, first, counts = np.unique(octaves[order], return_index=True, return_counts=True)
        rank = np.arange(len(order)) - np.repeat(first, counts)
        growth = self._option("scaleFactor") if self.name == "orb" else 1
        in_shares = rank * growth ** octaves[order]
        return np.sort(order[np.argsort(in_shares, kind="stable")[: self.limit]])

    def _option(self, name: str) -> int | float:
        return self.options.get(name, _OPTIONS[self.name][name].default)

    def _create(self) -> Any:
        options = {name: self._option(name) for name in _OPTIONS[self.name]}
        if self.name == "sift":
            return _cv2.SIFT_create(
                0,
                options["nOctaveLayers"],
                options["contrastThreshold"],
                options["edgeThreshold"],
                options["sigma"],
                cv2.CV_32F,
                True,  # enable_precise_upscale
            )
        if self.name == "orb":
            return _cv2.ORB_create(_ALL, **options)
        return _akaze()(**options)

    def _converted(
        self, points: Any, descriptors: NDArray[Any], shape: tuple[int, ...]
    ) -> Detections:
        values = np.array(
            [(*p.pt, p.size, p.angle, p.response, p.octave) for p in points], np.float64
        ).reshape(-1, 6)
        places = values[:, :2].copy()
        octaves = np.zeros(len(values), np.int32)
        if self.name != "sift":
            octaves = values[:, 5].astype(np.int32)
            places = self._placed(places, octaves[:, None], np.array(shape[::-1]))
        return Detections(
            places,
            values[:, 2],
            np.deg2rad(values[:, 3]),
            values[:, 4].astype(np.float32),
            descriptors,
            octaves,
        )

    def _placed(
        self,
        said_xy: NDArray[np.float64],
        octaves: NDArray[np.int32],
        size_xy: NDArray[np.int64],
    ) -> NDArray[np.float64]:
        """Positions in the image of what OpenCV found in resized ones, edge to edge.

        OpenCV takes positions back by the nominal scale, not by the ratio of the sizes, which are
        whole numbers; for ORB it takes pixel indices for positions besides.
        """
        if self.name == "orb":
            scale = self._option("scaleFactor") ** octaves
            from_edge = said_xy / scale + 0.5
            level = np.rint(size_xy / scale)
        else:
            from_edge = (said_xy + 0.5) / 2**octaves
            level = size_xy >> octaves
        return from_edge * size_xy / level - 0.5


def _check_options(name: str, options: Mapping[str, float]) -> None:
    known = _OPTIONS[name]
    for option, value in options.items():
        if option not in known:
            expected = ", ".join(known)
            raise SettingError(
                f"options of detector {name}", found=repr(option), expected=f"some of {expected}"
            )
        default, least, most = known[option]
        kind = int if isinstance(default, int) else (int, float)
        number = isinstance(value, kind) and not isinstance(value, bool)
        if not number or not least <= value <= most:
            whole = "a whole number" if isinstance(default, int) else "a number"
            raise SettingError(
                f"{option} of detector {name}",
                found=repr(value),
                expected=f"{whole} from {least:g} to {most:g}",
            )


def _akaze() -> Callable[..., Any]:
    """Where this OpenCV has AKAZE: in OpenCV 4 in its main part, in 5 in xfeatures2d."""
    for place in (cv2, getattr(cv2, "xfeatures2d", None)):
        create = getattr(place, "AKAZE_create", None)
        if create is not None:
            return create
    raise SettingError(
        "detector",
        found=f"'akaze' with OpenCV {cv2.__version__}",
        expected="'sift' or 'orb' with this build",
        remedy="OpenCV 5 has AKAZE in its contrib build: pip uninstall opencv-python-headless; "
        "pip install opencv-contrib-python-headless",
    )
