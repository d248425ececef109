"""Tables of convolutions on the icosphere, each a function of the level."""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from models.mapped import Table
from tangent_train.geometry import icosphere, vertex_resolution
from tangent_train.geometry.icosphere import icosphere_directions, locate
from tangent_train.geometry.sphere import gnomonic_points_xyz, tangent_axes


@cache
def mesh_operators(level: int) -> Table:
    """Return the four rows of MeshConv (Jiang et al. 2019, equation 3): x, L x, ∂EW x, ∂NS x.

    L is the cotangent Laplacian without division by the area of a vertex. The derivatives towards
    east and north are those of the linear function on each face, along EW = NS × n and the gradient
    NS of the latitude, averaged over the faces of a vertex by area.

    The article has derivatives per radian on a sphere of radius 1. Here, they are per vertex
    spacing `vertex_resolution(level)`, and L is divided by 2√3, so that it is the mean of the ring
    minus the value where triangles are equilateral. Weights absorb these constants of a level, but
    training is faster when no row outweighs the others. A pole has neither east nor north: its
    rows average the derivatives along NS and EW of its five faces, which tend to 0 for smooth
    functions.

    Args:
        level: Level s of the icosphere.
    """
    faces, points = icosphere(level).faces, icosphere_directions(level)
    a, b, c = np.moveaxis(points[faces], 1, 0)
    double_normals = np.cross(b - a, c - a)
    double_areas = np.linalg.norm(double_normals, axis=1, keepdims=True)
    normals, areas = double_normals / double_areas, double_areas[:, 0] / 2
    opposite = np.stack([c - b, a - c, b - a], axis=1)
    gradients = np.cross(normals[:, None], opposite) / double_areas[:, None]  # (F, 3, 3)

    latitudes = np.arcsin(np.clip(points[:, 2], -1, 1))
    north = np.einsum("fi,fix->fx", latitudes[faces], gradients)
    outward = normals * np.sign((normals * a).sum(axis=1, keepdims=True))
    east = np.cross(north, outward)
    shares = areas[:, None] / np.bincount(faces.ravel(), np.repeat(areas, 3))[faces]

    at, of = np.repeat(faces, 3, axis=1).ravel(), np.tile(faces, 3).ravel()

    def assembled(entries: NDArray[np.float64]) -> sparse.csr_array:
        shape = len(points), len(points)
        return sparse.coo_array((entries.ravel(), (at, of)), shape).tocsr()

    laplacian = -areas[:, None, None] * np.einsum("fix,fjx->fij", gradients, gradients)
    shares = shares * vertex_resolution(level)
    derivatives = [
        shares[:, :, None] * np.einsum("fx,fjx->fj", along, gradients)[:, None]
        for along in (east, north)
    ]
    identity = sparse.eye_array(len(points), format="csr")
    return Table.of_operators([identity, *map(assembled, (laplacian / 12**0.5, *derivatives))])


@cache
def hexagonal_rings(level: int) -> Table:
    """Return the seven rows of HexConv (Zhang et al. 2019, section 3.2): a vertex and its ring.

    The ring starts in the north and continues counterclockwise, as seen from outside. Its row k is
    α x[n_k] + (1 − α) x[n_(k+1)] for the neighbors n of the vertex, of which n_0 and n_1 enclose
    the north; α is the share of their angle between n_1 and the north. The convolution is the
    paper's α (W¹ * x) + (1 − α) (W² * x), where W² has the ring of W¹ shifted by one.

    The paper leaves out the poles, and pads the ten other vertices with five neighbors. Here, six
    rows divide the ring of five evenly. A pole has no north: its six rows are the mean of the ring.

    Args:
        level: Level s of the icosphere.
    """
    vertices, faces = icosphere(level)
    origin, neighbor = faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2).T
    axes = tangent_axes(vertices)[origin, :2]
    bearing = np.arctan2(*np.einsum("nij,nj->in", axes, vertices[neighbor])) % (2 * np.pi)
    order = np.lexsort((bearing, origin))
    origin, neighbor, bearing = origin[order], neighbor[order], bearing[order]

    valence = np.bincount(origin)
    end = valence.cumsum()
    start = end - valence
    before = 2 * np.pi - bearing[end - 1]  # from the last neighbor to the north
    north = valence - 1 + before / (before + bearing[start])
    is_pole = np.hypot(*vertices[:, :2].T) < 1e-9
    at_pole, of_pole = origin[is_pole[origin]], neighbor[is_pole[origin]]
    inside = np.flatnonzero(~is_pole)
    start, valence = start[inside], valence[inside]
    operators = [sparse.eye_array(len(vertices), format="csr")]
    for k in range(6):
        share, first = np.modf(north[inside] + k * valence / 6)
        ends = [neighbor[start + (first.astype(np.int64) + i) % valence] for i in (0, 1)]
        values = np.concatenate([1 - share, share, np.full(len(of_pole), 1 / 5)])
        entries = np.concatenate([inside, inside, at_pole]), np.concatenate([*ends, of_pole])
        operators.append(sparse.coo_array((values, entries), operators[0].shape).tocsr())
    return Table.of_operators(operators)


@cache
def face_neighbors(level: int) -> Table:
    """Return the ten rows of SpherePHD (Lee et al. 2019, figure 5), for signals on faces.

    They are a face, the three faces across its edges, and the six next to these, in the order of
    the corners. Corner 0 points to the north in the upward faces of the unfolded icosahedron, to
    the south in the downward ones: their order is that of the upward ones turned by 180°. Around a
    vertex with five faces, the ten faces are different too.

    Args:
        level: Level s of the icosphere.
    """
    faces = icosphere(level).faces
    count = len(faces)
    edges = faces[:, [[1, 2], [2, 0], [0, 1]]].reshape(-1, 2)  # opposite to corners 0, 1, 2
    code, reverse = edges @ [count, 1], edges @ [1, count]
    order = code.argsort()
    across = order[np.searchsorted(code, reverse, sorter=order)]
    # Corner 0 of the icosahedron's faces 5 to 9 lies on their upper edge.
    top = np.repeat([0, 1, 0], [count // 4, count // 4, count // 2])
    start = across[3 * np.arange(count)[:, None] + (top[:, None] + np.arange(3)) % 3]
    sides = start[:, :, None] // 3 * 3 + (start[:, :, None] + [1, 2]) % 3
    rows = np.arange(count)[:, None], start // 3, across[sides].reshape(count, 6) // 3
    return Table.of_entries(np.concatenate(rows, axis=1)[..., None], np.ones(1), count)


@cache
def vertex_parents(level: int) -> Table:
    """Return the table that doubles the resolution of signals on vertices, with one value each.

    A vertex of the coarser level keeps its value; a new vertex, on an edge, takes the mean of the
    edge's two ends.

    Args:
        level: Level of the result, at least 1.
    """
    coarse = icosphere(level - 1)
    parents = np.tile(np.arange(len(icosphere(level).vertices))[:, None], 2)
    parents[icosphere(level).faces[3::4]] = coarse.faces[:, [[1, 2], [2, 0], [0, 1]]]
    return Table.of_entries(parents[:, None], np.array(0.5), len(coarse.vertices))


@cache
def gnomonic_points(level: int) -> Table:
    """Return nine taps: a 3 × 3 grid on the tangent plane of each vertex, aligned to the north.

    Their distance on the plane is the tangent of the mean angle between neighboring vertices (Coors
    et al. 2018 and Tateno et al. 2018 use that of neighboring pixels). Rows are from north to
    south, columns from west to east, as in a convolution of images.

    Args:
        level: Level s of the icosphere.
    """
    pitch = float(np.tan(vertex_resolution(level)))
    return mapped_samples(level, gnomonic_points_xyz(icosphere_directions(level), 3, pitch))


def mapped_samples(level: int, directions_xyz: NDArray[np.float64]) -> Table:
    """Return a mapped convolution of signals on vertices (Eder et al. 2019): any taps.

    Args:
        level: Level s of the icosphere.
        directions_xyz: ``(V_out, K, 3)`` unit vectors. Values there are interpolated between the
            three vertices of a face, with barycentric weights.
    """
    found, weights = locate(level, directions_xyz.reshape(-1, 3))
    vertices, faces = icosphere(level)
    shape = (*directions_xyz.shape[:2], 3)
    return Table.of_entries(faces[found].reshape(shape), weights.reshape(shape), len(vertices))


@cache
def vertex_means(level: int) -> Table:
    """Return the table that halves the resolution of signals on vertices, with one value each.

    It is the mean of the seven rows of `hexagonal_rings`: a vertex and the neighbors around it.

    Args:
        level: Level of the signals, at least 1.
    """
    rings = hexagonal_rings(level)
    count = len(icosphere(level - 1).vertices)
    means = sparse.kron(sparse.eye_array(count), np.full((1, rings.taps), 1 / rings.taps), "csr")
    return Table.of_operators([means @ rings.matrix[: count * rings.taps]])
