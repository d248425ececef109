"""Ray casting with Embree, and shading."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from numpy.typing import NDArray

from datamodules.synthrooms.materials import albedo, material_table
from datamodules.synthrooms.room import Light, Room

Floats = NDArray[np.float32]


_LIFT = 1e-3  # meters off the surface where secondary rays begin
_REACH = 0.8  # meters within which surfaces occlude ambient light
_NEAREST = 0.3  # square meters: lamps are not brighter closer than this


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
