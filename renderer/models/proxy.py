"""Few triangles and few points in place of many: what casts an object's shadow and what bounds its picture."""

from __future__ import annotations

import fast_simplification
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

Points = NDArray[np.float32]
Triangles = NDArray[np.int32]
_OUTLINE_STEPS = 4
_MAX_GROWTH = 1.1           # of a proxy, for what it has lost of the volume
_MAX_HULL_POINTS = 2048


def welded(parts: list[tuple[Points, Triangles]]) -> tuple[Points, Triangles]:
    """All parts as one surface whose equal positions are one vertex, without degenerate triangles unless all are."""
    offsets = np.cumsum([0] + [len(points) for points, _ in parts[:-1]])
    points = np.concatenate([points for points, _ in parts])
    triangles = np.concatenate([part + offset for (_, part), offset in zip(parts, offsets, strict=True)])
    unique, inverse = np.unique(points, axis=0, return_inverse=True)
    triangles = inverse.reshape(-1)[triangles]
    a, b, c = triangles.T
    proper = (a != b) & (b != c) & (c != a)
    return unique, triangles[proper if proper.any() else slice(None)].astype(np.int32)


def simplified(points: Points, triangles: Triangles, most: int) -> tuple[Points, Triangles]:
    """A surface of at least one and at most `most` triangles near a welded one."""
    given = points, triangles
    if len(triangles) > most:
        points, triangles = fast_simplification.simplify(points, triangles, target_count=most)
    if len(triangles) > most:  # many loose parts, which edge collapse cannot join
        points, triangles = _clustered(points, triangles, most)
    if not len(triangles):     # many parts in one place, of which it leaves nothing
        points, triangles = given[0], given[1][:most]
    return np.asarray(_as_large(points, triangles, *given), dtype=np.float32), np.asarray(triangles, dtype=np.int32)


def _as_large(points: Points, triangles: Triangles, given: Points, given_triangles: Triangles) -> Points:
    """The points moved apart until the surface encloses what the given one does: corners alone lie inside of what is round."""
    before, after = (volume(p, t) for p, t in ((given, given_triangles), (points, triangles)))
    if not (after > 0 and before > 0):
        return points
    centre = (points.min(axis=0) + points.max(axis=0)) / 2
    return np.asarray((points - centre) * np.clip((before / after) ** (1 / 3), 1.0, _MAX_GROWTH) + centre)


def volume(points: Points, triangles: Triangles) -> float:
    """Of what a closed surface encloses, by the divergence theorem."""
    corners = points.astype(np.float64)[triangles]
    corners -= corners.mean(axis=(0, 1))
    return float(np.einsum("ij,ij->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6)


def _clustered(points: Points, triangles: Triangles, most: int) -> tuple[Points, Triangles]:
    """Vertices snapped to the finest grid that leaves few enough triangles."""
    low, size = points.min(axis=0), max(float(np.ptp(points, axis=0).max()), 1e-12)
    for cells in (24, 20, 16, 12, 10, 8, 6, 5, 4, 3, 2):
        keys = np.round((points - low) / size * cells).astype(np.int64)
        unique, inverse = np.unique(keys, axis=0, return_inverse=True)
        merged = np.sort(inverse.reshape(-1)[triangles], axis=1)
        a, b, c = merged.T
        merged = np.unique(merged[(a != b) & (b != c) & (c != a)], axis=0)
        if len(merged) <= most:
            break
    return (unique / cells * size + low).astype(np.float32), merged[:most].astype(np.int32)


def outline(points: Points) -> Points:
    """(n, 3) points whose projections bound those of all the points: the hull's corners and points on its long edges."""
    try:
        hull = ConvexHull(points.astype(np.float64))
    except (QhullError, ValueError):  # flat or degenerate
        low, high = points.min(axis=0), points.max(axis=0)
        corners = np.array([[(low, high)[i >> a & 1][a] for a in range(3)] for i in range(8)])
        return corners.astype(np.float32)
    corners = points[hull.vertices]
    edges = np.unique(np.sort(np.concatenate([hull.simplices[:, [0, 1]], hull.simplices[:, [1, 2]],
                                              hull.simplices[:, [2, 0]]]), axis=1), axis=0)
    start, end = points[edges[:, 0]], points[edges[:, 1]]
    size = float(np.linalg.norm(np.ptp(points, axis=0)))
    long_edge = np.linalg.norm(end - start, axis=1) > 0.1 * size
    steps = np.linspace(0, 1, _OUTLINE_STEPS + 1)[1:-1, None, None]
    between = (start[long_edge] * (1 - steps) + end[long_edge] * steps).reshape(-1, 3)
    return np.concatenate([corners, between]).astype(np.float32)


def thinned(points: Points) -> Points:
    """Some of the points, evenly through their order, so few that a hull is quick to make."""
    return points[::-(-len(points) // _MAX_HULL_POINTS)]
