"""Rendering of rooms: ray casting with Embree, shading, exposure, noise, and holes in the scan."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from numpy.typing import NDArray

from datamodules.synthrooms.camera import PictureRays
from datamodules.synthrooms.layout import FloorPlan
from datamodules.synthrooms.materials import albedo, material_table
from datamodules.synthrooms.room import Light, Room

Floats = NDArray[np.float32]

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
        room: Furnished room, which is not changed.
    """

    def __init__(self, room: Room) -> None:
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
        self.materials = material_table([part.material for part in room.parts])
        self.item_of_part = np.array([part.item for part in room.parts])
        self._lights = room.lights
        self._ambient = _bounced_light(room)

    def cast(self, origin: NDArray[np.float64], directions: Floats) -> Hits:
        """Return first hits of rays from one point along ``(n, 3)`` unit `directions`."""
        start = origin.astype(np.float32)
        origins = np.broadcast_to(start, directions.shape).copy()
        answer = self._tree.run(origins, directions, query="INTERSECT", output=1)
        triangle, distance = answer["primID"], answer["tfar"]
        found = triangle >= 0
        triangle = np.where(found, triangle, 0)
        distance = np.where(found, distance, 1).astype(np.float32)
        normals = self._normals[triangle]
        cosine = -np.einsum("ij,ij->i", normals, directions)
        normals = normals * np.sign(cosine)[:, None]
        points = start + directions * distance[:, None]
        return Hits(found, distance, self._part[triangle], points, normals, np.abs(cosine))

    def surface_points(self, rng: np.random.Generator, count: int) -> NDArray[np.float64]:
        """Draw points uniformly from all surfaces, ``(count, 3)``."""
        chosen = rng.choice(len(self._areas), count, p=self._areas / self._areas.sum())
        weights = rng.dirichlet(np.ones(3), count)
        return np.einsum("nk,nkd->nd", weights, self._triangles[chosen])

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
        for lamp in self._lights:
            light += self._direct(lamp, lifted, hits.normals, place)[:, None]
        light += self.materials["emission"][hits.part, None]
        light *= albedo(self.materials, hits.part, hits.points, hits.normals)
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
        shadow = self._tree.run(
            points[lit], way[lit], dists=distance[lit] - np.float32(0.01), query="OCCLUDED"
        )
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
    area = 2 * plan.floor_area + plan.height * sum(wall.length for wall in plan.walls)
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


class Holes(NamedTuple):
    """Balls in the room within which the scan has no surface.

    Attributes:
        centers: ``(n, 3)`` meters.
        radii: ``(n,)`` meters.
    """

    centers: NDArray[np.float64]
    radii: NDArray[np.float64]

    def cover(self, points: Floats) -> NDArray[np.bool_]:
        """Return mask of the ``(n, 3)`` points that lie in a hole; the rims are ragged."""
        ragged = 1 + 0.25 * np.sin(points @ np.array([23.0, 29.0, 31.0], np.float32))
        covered = np.zeros(len(points), np.bool_)
        for center, radius in zip(self.centers, self.radii, strict=True):
            away = points - center.astype(np.float32)
            covered |= np.einsum("ij,ij->i", away, away) < ragged * np.float32(radius**2)
        return covered


@dataclass(frozen=True)
class Camera:
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
    caps: tuple[float, float]
    gain: Floats
    noise: float


def draw_holes(rng: np.random.Generator, scene: RayScene) -> Holes:
    """Draw up to six holes of 10 to 35 cm on the room's surfaces."""
    count = int(rng.integers(0, 7))
    return Holes(scene.surface_points(rng, count), rng.uniform(0.1, 0.35, count))


def draw_camera(
    rng: np.random.Generator, scene: RayScene, plan: FloorPlan, others: list[Camera]
) -> Camera:
    """Draw a camera with free space around it, away from the others, and expose it."""
    location = _draw_location(rng, scene, plan, [camera.location for camera in others])
    caps = tuple(math.radians(rng.uniform(6, 15)) if rng.random() < 0.7 else 0.0 for _ in range(2))
    around = scene.cast(location, even_directions(1024))
    light = scene.radiance(around, (0.0, 0.0), even_directions(1)[0]).mean(axis=1)
    typical = math.exp(float(np.log(light + 1e-3).mean()))
    exposure = 0.26 * rng.uniform(0.75, 1.35) / typical
    gain = (exposure * rng.uniform(0.92, 1.08, 3)).astype(np.float32)
    heading, noise = rng.uniform(-math.pi, math.pi), rng.uniform(0.004, 0.012)
    return Camera(location, heading, (caps[0], caps[1]), gain, noise)


def _draw_location(
    rng: np.random.Generator,
    scene: RayScene,
    plan: FloorPlan,
    others: list[NDArray[np.float64]],
) -> NDArray[np.float64]:
    """Draw the first location with enough free space, or the best one tried."""
    directions = even_directions(192)
    best, most = np.zeros(3), -math.inf
    for _ in range(_PLACES):
        area = plan.floors[rng.integers(len(plan.floors))]
        x, y = rng.uniform(area.x0, area.x1), rng.uniform(area.y0, area.y1)
        place = np.array([x, y, rng.uniform(*_HEIGHTS)])
        clear = float(scene.cast(place, directions).distance.min()) / _CLEAR
        apart = min((float(np.linalg.norm(place - other)) for other in others), default=math.inf)
        free = min(clear, apart / _APART)
        if free > most:
            best, most = place, free
        if most >= 1:
            break
    return best


def render_picture(
    scene: RayScene,
    view: PictureRays,
    camera: Camera,
    holes: Holes,
    supersample: int,
    rng: np.random.Generator,
) -> Picture:
    """Render a view.

    Colors are the mean of ``supersample²`` rays per pixel, spread evenly over it, each through the
    tone curve; labels and depth come from one ray through the pixel's center.

    Args:
        scene: Scene of the room.
        view: Pixels of the picture, at the camera's location.
        camera: Sensor of the camera.
        holes: Holes in the scan.
        supersample: Rays per pixel side.
        rng: Random generator of the sensor's noise.
    """
    rays = view.rays()
    shape = (rays.shape[0], rays.shape[1])
    distance, items = np.empty(shape, np.float32), np.empty(shape, np.int64)
    for rows in _bands(shape):
        hits = scene.cast(camera.location, rays[rows].reshape(-1, 3))
        missing = ~hits.found | (hits.cosine < _GRAZING) | holes.cover(hits.points)
        missing |= scene.materials["unscanned"][hits.part]
        distance[rows] = np.where(missing, np.nan, hits.distance).reshape(-1, shape[1])
        found = np.where(missing, MISSING, scene.item_of_part[hits.part])
        items[rows] = found.reshape(-1, shape[1])
    zenith, nadir = camera.caps
    black = (rays[..., 2] > math.cos(zenith)) & (zenith > 0)
    black |= (rays[..., 2] < -math.cos(nadir)) & (nadir > 0)
    items[black] = MISSING
    distance[black] = np.nan
    color = _colors(scene, view, camera, shape, supersample)
    color += rng.normal(0, camera.noise, color.shape).astype(np.float32)
    rgb = np.clip(color * 255 + 0.5, 0, 255).astype(np.uint8)
    rgb[black] = 0
    return Picture(rgb, view.depth_m(distance), items)


def _colors(
    scene: RayScene, view: PictureRays, camera: Camera, shape: tuple[int, int], supersample: int
) -> Floats:
    """Return display values ``(h, w, 3)``."""
    steps = (np.arange(supersample) + 0.5) / supersample - 0.5
    spreads = even_directions(supersample**2)
    color = np.zeros((*shape, 3), np.float32)
    for k, spread in enumerate(spreads):
        dx, dy = float(steps[k % supersample]), float(steps[k // supersample])
        rays = view.rays(dx, dy)
        for rows in _bands(shape):
            hits = scene.cast(camera.location, rays[rows].reshape(-1, 3))
            light = scene.radiance(hits, (2 * dx, 2 * dy), spread) * camera.gain
            # Tone curve (Reinhard et al. 2002, equation 4) and a gamma of 2.
            toned = light * (1 + light / np.float32(_WHITE)) / (1 + light)
            color[rows] += np.sqrt(np.minimum(toned, 1)).reshape(color[rows].shape)
    return color / np.float32(len(spreads))


def _bands(shape: tuple[int, int]) -> Iterator[slice]:
    """Yield slices of rows that together make a picture, few enough rays in each."""
    height, width = shape
    step = max(1, _RAYS_AT_ONCE // width)
    for start in range(0, height, step):
        yield slice(start, start + step)
