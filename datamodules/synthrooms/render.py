"""Views of rooms: ray casting with Embree, shading, exposure, noise, and holes in the scan.

Room coordinates are right-handed, in meters, z up. Camera axes are x right, y down, z forward, as
in `tangent_train.geometry`. The pose of a panorama is that of an upright camera that faces the
middle of the panorama, see `datamodules.stanford2d3ds.files`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from numpy.typing import NDArray

from datamodules.stanford2d3ds.files import BLENDER, CAMERA_FROM_SPHERE
from datamodules.synthrooms.materials import SURFACE, Floats, albedo
from datamodules.synthrooms.room import Light, Room
from tangent_train import geometry

ViewKind = Literal["stanford", "wide", "uniform"]
"""Viewing directions of photos, see `RoomSettings.views`."""

MISSING = -1
"""Item number of pixels without a scan."""

_LIFT = 1e-3  # meters off the surface where secondary rays begin
_REACH = 0.8  # meters within which surfaces occlude ambient light
_NEAREST = 0.3  # square meters: lamps are not brighter closer than this
_RAYS_AT_ONCE = 1 << 17  # a 2048 × 4096 panorama takes at most 200 MB, and caches stay warm
_GRAZING = 0.04  # cosine below which a depth camera gets no return
_WHITE = 9.0  # square of the light, in units of exposure, that becomes white
_HEIGHTS = (1.3, 1.7)
_CLEAR = 0.55  # meters around a camera that should be free
_APART = 1.2  # meters between the cameras of a room
_PLACES = 60  # locations tried for every camera


@dataclass(frozen=True)
class View:
    """A panorama, or a square pinhole image.

    Attributes:
        location: ``(3,)`` center in meters.
        world_from_camera: ``(3, 3)``; its columns are the camera's right, down and forward.
        size: Rows in pixels.
        fov_rad: Field of view between the outer pixel edges; None for a panorama of twice as many
            columns.
    """

    location: NDArray[np.float64]
    world_from_camera: NDArray[np.float64]
    size: int
    fov_rad: float | None = None

    @classmethod
    def looking(
        cls,
        location: NDArray[np.float64],
        size: int,
        fov_rad: float | None = None,
        *,
        heading: float,
        pitch: float = 0.0,
        roll: float = 0.0,
    ) -> View:
        """Return the view for some angles in radians.

        Args:
            location: ``(3,)`` center in meters.
            size: Rows in pixels.
            fov_rad: Field of view; None for a panorama.
            heading: Counterclockwise from the room's x axis, seen from above.
            pitch: Upward tilt.
            roll: Clockwise as seen by the camera; the picture tilts counterclockwise.
        """
        x, _, z = np.eye(3)
        turns = ((z, heading - math.pi / 2), (x, math.pi / 2 + pitch), (z, -roll))
        yaw, tilt, tip = (geometry.rotation_about(axis, angle) for axis, angle in turns)
        return cls(location, yaw @ tilt @ tip @ BLENDER, size, fov_rad)

    @property
    def camera_matrix(self) -> NDArray[np.float64]:
        """``(3, 3)`` K for integer pixel centers; of one cube face for a panorama."""
        fov_deg = math.degrees(self.fov_rad or math.pi / 2)
        return geometry.camera_matrix_from_fov(fov_deg, (self.size, self.size))

    def rays(self, dx: float = 0.0, dy: float = 0.0) -> Floats:
        """Return the room directions of all pixels, shifted by (dx, dy) pixels: ``(h, w, 3)``."""
        if self.fov_rad is not None:
            moved = self.camera_matrix
            moved[:2, 2] -= (dx, dy)
            directions = geometry.perspective_directions(moved, (self.size, self.size)).astype(
                np.float32
            )
            return directions @ self.world_from_camera.T.astype(np.float32)
        lon = geometry.equirect_longitudes(2 * self.size, dx)
        lat = geometry.equirect_latitudes(self.size, dy)
        # A direction is cos φ times its horizontal part plus the vertical: no trigonometry here.
        room_from_sphere = (self.world_from_camera @ CAMERA_FROM_SPHERE).T
        level = geometry.lonlat_to_xyz(np.stack([lon, 0 * lon], axis=-1)) @ room_from_sphere
        vertical = np.sin(lat)[:, None] * room_from_sphere[2]
        spread = np.cos(lat).astype(np.float32)[:, None, None] * level.astype(np.float32)
        return spread + vertical.astype(np.float32)[:, None, :]

    def depth_m(self, distance_m: Floats) -> Floats:
        """Return the depth ``(h, w)`` of distances: the z-depth, in panoramas the distance."""
        if self.fov_rad is None:
            return distance_m
        return distance_m * (self.rays() @ self.world_from_camera[:, 2].astype(np.float32))


def draw_view(
    rng: np.random.Generator, kind: ViewKind, location: NDArray[np.float64], size: int
) -> View:
    """Draw a perspective view from a location.

    Args:
        rng: Source of randomness.
        kind: See `RoomSettings.views`.
        location: ``(3,)`` center in meters.
        size: Side in pixels.
    """
    heading = rng.uniform(-math.pi, math.pi)
    if kind == "uniform":
        pitch, roll = math.asin(rng.uniform(-1, 1)), rng.uniform(-math.pi, math.pi)
    else:
        spread = math.radians(35 if kind == "wide" else 20)
        pitch = float(np.clip(rng.normal(0, spread), -1.4, 1.4))
        roll = rng.normal(0, math.radians(3))
    fov = math.radians(rng.uniform(96, 106) if kind == "wide" else rng.uniform(45, 75))
    return View.looking(location, size, fov, heading=heading, pitch=pitch, roll=roll)


class Hits(NamedTuple):
    """Hit points of rays.

    Attributes:
        found: ``(n,)`` True where the ray hit a surface; other fields are undefined elsewhere.
        distance: ``(n,)`` meters along the unit direction.
        part: ``(n,)`` position in `Room.parts`.
        points: ``(n, 3)`` meters.
        normals: ``(n, 3)`` of the surface, towards the viewer.
        cosine: ``(n,)`` of the angle between the normal and the way back.
    """

    found: NDArray[np.bool_]
    distance: Floats
    part: NDArray[np.int64]
    points: Floats
    normals: Floats
    cosine: Floats


def even_directions(count: int) -> Floats:
    """Return directions spread evenly over the sphere (a Fibonacci lattice), ``(count, 3)``."""
    k = np.arange(count) + 0.5
    z = 1 - 2 * k / count
    angle = k * math.pi * (3 - math.sqrt(5))
    ring = np.sqrt(1 - z * z)
    return np.stack([ring * np.cos(angle), ring * np.sin(angle), z], axis=1).astype(np.float32)


class RayScene:
    """A furnished room ready for rays.

    Args:
        room: Furnished room; only its source of randomness changes.
    """

    def __init__(self, room: Room) -> None:
        self.room = room
        triangles = np.concatenate([part.triangles for part in room.parts]).astype(np.float32)
        self._tree = EmbreeScene()
        self._mesh = TriangleMesh(self._tree, triangles)
        counts = [len(part.triangles) for part in room.parts]
        self._part = np.repeat(np.arange(len(counts)), counts)
        normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
        size = np.linalg.norm(normals, axis=1, keepdims=True)
        self._normals = normals / size
        self._areas = size[:, 0] / 2
        self._triangles = triangles
        self.materials = np.array([part.material for part in room.parts], SURFACE)
        self.item_of_part = np.array([part.item for part in room.parts])
        self._ambient = _bounced_light(room)

    def cast(self, origin: NDArray[np.float64], directions: Floats) -> Hits:
        """Return first hits of rays from one point along ``(n, 3)`` unit `directions`."""
        start = origin.astype(np.float32)
        origins = np.broadcast_to(start, directions.shape).copy()
        answer = self._tree.run(origins, directions, query="INTERSECT", output=1)
        found = answer["primID"] >= 0
        triangle = np.where(found, answer["primID"], 0)
        distance = np.where(found, answer["tfar"], 1).astype(np.float32)
        normals = self._normals[triangle]
        cosine = -np.einsum("ij,ij->i", normals, directions)
        normals = normals * np.sign(cosine)[:, None]
        points = start + directions * distance[:, None]
        return Hits(found, distance, self._part[triangle], points, normals, np.abs(cosine))

    def cast_image(
        self, origin: NDArray[np.float64], rays: Floats
    ) -> Iterator[tuple[slice, tuple[int, int], Hits]]:
        """Yield rows of a picture, their shape and their hits, few enough rays in each."""
        height, width, _ = rays.shape
        step = max(1, _RAYS_AT_ONCE // width)
        for start in range(0, height, step):
            rows = slice(start, start + step)
            yield rows, (-1, width), self.cast(origin, rays[rows].reshape(-1, 3))

    def surface_points(self, count: int) -> NDArray[np.float64]:
        """Draw points uniformly from all surfaces, ``(count, 3)``."""
        rng, shares = self.room.rng, self._areas / self._areas.sum()
        chosen = rng.choice(len(shares), count, p=shares)
        return np.einsum("nk,nkd->nd", rng.dirichlet(np.ones(3), count), self._triangles[chosen])

    def radiance(self, hits: Hits, place: tuple[float, float], spread: Floats) -> Floats:
        """Return the radiance along rays.

        Lambertian surfaces under the lamps with their shadows, plus light bounced between the
        surfaces, which surfaces within 0.8 m occlude.

        Args:
            hits: Hit points of the rays.
            place: Point of every lamp that lights these rays, in [−1, 1]² of its half sides: rays
                of one pixel that use different points make soft shadows.
            spread: ``(3,)`` unit vector added to the normal for ambient occlusion.

        Returns:
            ``(n, 3)`` linear values; 0 where nothing was hit.
        """
        lifted = hits.points + hits.normals * np.float32(_LIFT)
        light = self._ambient * self._openness(lifted, hits.normals, spread)[:, None]
        for lamp in self.room.lights:
            light += self._direct(lamp, lifted, hits.normals, place)[:, None]
        surface = self.materials[hits.part]
        light += surface["emission"][:, None]
        light *= albedo(surface, hits.points, hits.normals)
        light[~hits.found] = 0
        return light

    def _openness(self, points: Floats, normals: Floats, spread: Floats) -> Floats:
        """Return the share of ambient light, smaller close to other surfaces."""
        ahead = np.float32(1.001) * normals + spread  # never zero
        ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
        limit = np.full(len(points), _REACH, np.float32)
        free = self._tree.run(points, ahead, dists=limit, query="DISTANCE") / np.float32(_REACH)
        tilt = normals @ np.array([0.08, 0.05, -0.06], np.float32)
        return (0.25 + 0.75 * np.clip(free, 0, 1)) * (1 + tilt)

    def _direct(
        self, lamp: Light, points: Floats, normals: Floats, place: tuple[float, float]
    ) -> Floats:
        """Return irradiance by one lamp, 0 in its shadow."""
        source = (lamp.center + np.asarray(place) @ lamp.half_sides).astype(np.float32)
        way = source - points
        distance = np.sqrt(np.einsum("ij,ij->i", way, way))
        way /= distance[:, None]
        arriving = np.einsum("ij,ij->i", normals, way)
        leaving = -(way @ lamp.normal.astype(np.float32))
        light = np.zeros(len(points), np.float32)
        lit = np.flatnonzero((arriving > 0) & (leaving > 0))
        reach = distance[lit] - np.float32(0.01)
        shadow = self._tree.run(points[lit], way[lit], dists=reach, query="OCCLUDED")
        lit = lit[shadow < 0]
        strength = np.float32(lamp.intensity) * arriving[lit] * leaving[lit]
        light[lit] = strength / np.maximum(distance[lit] ** 2, _NEAREST)
        return light


def _bounced_light(room: Room) -> Floats:
    """Return the irradiance by light that was reflected once or more, equal in all places.

    The integrating sphere's law: flux Φ in an enclosure of area A and reflectance ρ gives
    Φρ / (A(1 − ρ)); a Lambertian lamp of intensity I along its normal emits Φ = πI.
    """
    plan = room.plan
    floor_area = sum((x1 - x0) * (y1 - y0) for x0, y0, x1, y1 in plan.floors)
    area = 2 * floor_area + plan.height * sum(wall.length for wall in plan.walls)
    flux = math.pi * sum(lamp.intensity for lamp in room.lights)
    reflectance = np.clip(room.reflectance, 0.2, 0.7)
    return (flux / area * reflectance / (1 - reflectance)).astype(np.float32)


class Picture(NamedTuple):
    """One rendered view.

    Attributes:
        rgb: ``(h, w, 3)`` uint8.
        depth_m: ``(h, w)`` float32; NaN where missing.
        items: ``(h, w)`` int64, position in `Room.items`; `MISSING` where missing.
    """

    rgb: NDArray[np.uint8]
    depth_m: Floats
    items: NDArray[np.int64]


class Camera(NamedTuple):
    """Location and sensor of a camera, the same in all of its pictures.

    Attributes:
        location: ``(3,)`` meters.
        heading: Radians from the room's x axis to the middle of the panorama, counterclockwise.
        caps: Radians around the zenith and the nadir that were not photographed.
        gain: ``(3,)`` exposure times white balance.
        noise: Standard deviation of the sensor's noise, display values.
    """

    location: NDArray[np.float64]
    heading: float
    caps: Sequence[float]
    gain: Floats
    noise: float


def draw_holes(scene: RayScene) -> NDArray[np.float64]:
    """Draw up to six holes in the scan: balls of 10 to 35 cm around points of the surfaces.

    Returns:
        ``(n, 4)`` center and radius in meters.
    """
    count = int(scene.room.rng.integers(0, 7))
    centers = scene.surface_points(count)
    return np.column_stack([centers, scene.room.rng.uniform(0.1, 0.35, count)])


def _is_in_hole(points: Floats, holes: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return mask of the ``(n, 3)`` points that lie in a hole; the rims are ragged."""
    ragged = 1 + 0.25 * np.sin(points @ np.array([23.0, 29.0, 31.0], np.float32))
    covered = np.zeros(len(points), np.bool_)
    for *center, radius in holes:
        away = points - np.array(center, np.float32)
        covered |= np.einsum("ij,ij->i", away, away) < ragged * np.float32(radius**2)
    return covered


def draw_camera(scene: RayScene, others: Sequence[Camera] = ()) -> Camera:
    """Draw a camera with free space around it, away from the others, and expose it."""
    rng = scene.room.rng
    location = _draw_location(scene, others)
    caps = [math.radians(rng.uniform(6, 15)) if rng.random() < 0.7 else 0.0 for _ in range(2)]
    around = scene.cast(location, even_directions(1024))
    light = scene.radiance(around, (0.0, 0.0), even_directions(1)[0]).mean(axis=1)
    typical = math.exp(float(np.log(light + 1e-3).mean()))
    exposure = 0.26 * rng.uniform(0.75, 1.35) / typical
    gain = (exposure * rng.uniform(0.92, 1.08, 3)).astype(np.float32)
    heading, noise = rng.uniform(-math.pi, math.pi), rng.uniform(0.004, 0.012)
    return Camera(location, heading, caps, gain, noise)


def _draw_location(scene: RayScene, others: Sequence[Camera]) -> NDArray[np.float64]:
    """Draw the first location with enough free space, or the best one tried."""
    rng, floors, directions = scene.room.rng, scene.room.plan.floors, even_directions(192)
    best, most = np.zeros(3), -math.inf
    for _ in range(_PLACES):
        x0, y0, x1, y1 = floors[rng.integers(len(floors))]
        place = np.array([rng.uniform(x0, x1), rng.uniform(y0, y1), rng.uniform(*_HEIGHTS)])
        clear = float(scene.cast(place, directions).distance.min()) / _CLEAR
        apart = [float(np.linalg.norm(place - other.location)) / _APART for other in others]
        free = min([clear, *apart])
        if free > most:
            best, most = place, free
        if most >= 1:
            break
    return best


def render_picture(
    scene: RayScene, view: View, camera: Camera, holes: NDArray[np.float64], supersample: int
) -> Picture:
    """Render a view.

    Colors are the mean of ``supersample²`` rays per pixel, spread evenly over it, each through the
    tone curve; labels and depth come from one ray through the pixel's center.

    Args:
        scene: Scene of the room.
        view: Pixels of the picture, at the camera's location.
        camera: Sensor of the camera.
        holes: From `draw_holes`.
        supersample: Rays per pixel side.
    """
    rays = view.rays()
    distance, items = np.empty(rays.shape[:2], np.float32), np.empty(rays.shape[:2], np.int64)
    for rows, shape, hits in scene.cast_image(camera.location, rays):
        missing = ~hits.found | (hits.cosine < _GRAZING) | _is_in_hole(hits.points, holes)
        missing |= scene.materials["unscanned"][hits.part]
        distance[rows] = np.where(missing, np.nan, hits.distance).reshape(shape)
        items[rows] = np.where(missing, MISSING, scene.item_of_part[hits.part]).reshape(shape)
    zenith, nadir = camera.caps
    black = (rays[..., 2] > math.cos(zenith)) & (zenith > 0)
    black |= (rays[..., 2] < -math.cos(nadir)) & (nadir > 0)
    items[black] = MISSING
    distance[black] = np.nan
    color = _colors(scene, view, camera, supersample)
    color += scene.room.rng.normal(0, camera.noise, color.shape).astype(np.float32)
    rgb = np.clip(color * 255 + 0.5, 0, 255).astype(np.uint8)
    rgb[black] = 0
    return Picture(rgb, view.depth_m(distance), items)


def _colors(scene: RayScene, view: View, camera: Camera, supersample: int) -> Floats:
    """Return display values ``(h, w, 3)``."""
    steps = (np.arange(supersample) + 0.5) / supersample - 0.5
    spreads = even_directions(supersample**2)
    color = np.zeros_like(view.rays())
    for k, spread in enumerate(spreads):
        dx, dy = float(steps[k % supersample]), float(steps[k // supersample])
        for rows, shape, hits in scene.cast_image(camera.location, view.rays(dx, dy)):
            light = scene.radiance(hits, (2 * dx, 2 * dy), spread) * camera.gain
            # Tone curve (Reinhard et al. 2002, equation 4) and a gamma of 2.
            toned = light * (1 + light / np.float32(_WHITE)) / (1 + light)
            color[rows] += np.sqrt(np.minimum(toned, 1)).reshape(*shape, 3)
    return color / np.float32(len(spreads))
