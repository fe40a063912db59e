"""What objects stand close to: the ground under them with its shadows, and each other. As a factor on the distant irradiance.

The frame's light comes from infinitely far away, which the ground and the neighbours do not. For points spread over an object rays
are cast once per move, at simple solids and the ground; each new light then only weighs what they met. The ratio of near to
distant irradiance is fitted by a few functions of place and normal (`functions`), which the shader evaluates in each pixel. The
same rays serve both irradiances, so their noise is in both and the ratio keeps little of it.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from renderer.equirectangular import uv_from_direction
from renderer.light.detection import Light
from renderer.light.discs import disc_directions, hardly_moved
from renderer.models.mesh import Mesh, Surface
from renderer.models.shapes import Solid

Array = NDArray[np.floating]
POINTS = 64               # on an object
RAYS = 32                 # from a point
GROUND_CELLS = 12         # a side of the patch of ground around an object
GROUND_RAYS = 32
LIGHT_RAYS = 4            # to a light, from each cell of the ground
REACH = 1.6               # of that patch, in sizes of the object beyond it
CONTACT = 4.0             # how fast the contact term falls with height, in sizes
NEIGHBOURS = 2            # that have a function of their own
FUNCTIONS = 10 + NEIGHBOURS
RIDGE = 1e-3
RATIO_RANGE = (0.0, 4.0)
STALE = np.radians(1.0)     # how far a light may move before the rays to it are cast anew
COAT = 0.04               # of the light that falls on it, reflected by whatever is no metal


@dataclass(frozen=True)
class Body:
    """An object as the near field sees it. `points` and `normals` (POINTS, 3) lie on it in the world."""

    solid: Solid
    points: Array
    normals: Array
    is_convex: bool
    albedo: Array
    metallic: float = 0.0

    def reflects(self, irradiance: Array, seen: Array) -> Array:
        """(n, 3) radiance of places that receive this irradiance; metals give back what a mirror would show there, `seen`."""
        return np.asarray(self.albedo * (self.metallic * seen + (1 - self.metallic) * irradiance / np.pi))

    @property
    def color(self) -> Array:
        """(3,) base colour: `albedo` without what the coat reflects."""
        return np.asarray(np.maximum(self.albedo - COAT, 0.0) / (1 - 2 * COAT))


@dataclass(frozen=True)
class Fit:
    """`coefficients` (FUNCTIONS, 3) of `functions`, whose origin, scale (metres) and (NEIGHBOURS, 4) spheres these are."""

    centre: Array
    size: float
    coefficients: Array
    spheres: Array = field(default_factory=lambda: np.zeros((NEIGHBOURS, 4)))

    def ratio(self, points: Array, normals: Array, ground_y: float) -> Array:
        """(n, 3) irradiance near by distant."""
        found = functions(points, normals, self.centre, self.size, ground_y, self.spheres)
        return np.maximum(found @ self.coefficients, 0.0)


def functions(points: Array, normals: Array, centre: Array, size: float, ground_y: float, spheres: Array) -> Array:
    """(n, FUNCTIONS); the twin of near_field.glsl."""
    q = (points - centre) / size
    contact = np.exp(-CONTACT * np.maximum(points[:, 1] - ground_y, 0.0) / size)
    one = np.ones(len(points))
    seen = [form_factor(points, normals, sphere) for sphere in spheres]
    return np.stack([one, *normals.T, *q.T, contact, contact * normals[:, 1], normals[:, 1] ** 2, *seen], axis=1)


def form_factor(points: Array, normals: Array, sphere: Array) -> Array:
    """(n,) share of a sphere (x, y, z, radius) in the cosine-weighted view: (n . d) (r / d)^2, and the parabola of `disc_cosine`
    where it sets behind the horizon."""
    towards = sphere[:3] - points
    distance = np.maximum(np.linalg.norm(towards, axis=1), 1e-6)
    cosine, sine = (towards * normals).sum(axis=1) / distance, np.minimum(sphere[3] / distance, 1.0)
    rising = np.clip(cosine + sine, 0.0, 2 * sine)
    return np.asarray(sine**2 * np.where(cosine >= sine, cosine, rising**2 / np.maximum(4 * sine, 1e-6)))


def surface_points(mesh: Mesh, count: int = POINTS) -> tuple[Array, Array]:
    """(count, 3) points and normals spread evenly over a mesh's area, in its coordinates; always the same ones."""
    random = np.random.default_rng(7)
    corners = np.concatenate([p.positions[p.triangles] for p in mesh.primitives]).astype(np.float64)
    normals = np.concatenate([p.normals[p.triangles] for p in mesh.primitives]).astype(np.float64)
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    if not area.sum() > 0:
        area = np.ones(len(corners))
    chosen = np.searchsorted(np.cumsum(area) / area.sum(), (np.arange(count) + random.random(count)) / count).clip(0, len(area) - 1)
    a, b = random.random((2, count))
    a, b = np.where(a + b > 1, 1 - a, a), np.where(a + b > 1, 1 - b, b)
    weights = np.stack([1 - a - b, a, b], axis=1)[..., None]
    point, normal = (corners[chosen] * weights).sum(axis=1), (normals[chosen] * weights).sum(axis=1)
    return point, normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)


def mean_albedo(surface: Surface) -> Array:
    """(3,) share of light that a surface gives back, roughly: metals as much as their colour."""
    return np.asarray(COAT + (1 - 2 * COAT) * mean_color(surface))


def mean_color(surface: Surface) -> Array:
    """(3,) linear base colour, the mean of a textured one."""
    color = np.array(surface.base_color[:3])
    if surface.base_color_texture is not None:
        mean = surface.base_color_texture[..., :3].reshape(-1, 3).mean(axis=0) / 255.0
        color = color * mean**2.2
    return np.asarray(color)


def mirrored(rays: Array, normals: Array) -> Array:
    """(n, 3) rays as they go on from a mirror."""
    return np.asarray(rays - 2 * (rays * normals).sum(axis=1, keepdims=True) * normals)


@lru_cache(maxsize=4)
def _cosine_directions(count: int, sets: int) -> Array:
    """(sets, count, 3) cosine-distributed directions about +Z, each set turned differently."""
    index = np.arange(count)
    radius, phi = np.sqrt((index + 0.5) / count), index * np.pi * (3 - np.sqrt(5))
    turn = (np.arange(sets) * 0.6180339887 % 1 * 2 * np.pi)[:, None]
    z = np.broadcast_to(np.sqrt(1 - radius**2), (sets, count))
    return np.stack([radius * np.cos(phi + turn), radius * np.sin(phi + turn), z], axis=-1)


def _about(normals: Array, local: Array) -> Array:
    """(n, k, 3) local directions turned so that +Z is each normal (Duff et al. 2017)."""
    x, y, z = normals.T
    sign = np.where(z >= 0, 1.0, -1.0)
    a = -1.0 / (sign + z)
    b = x * y * a
    right = np.stack([1 + sign * x * x * a, sign * b, -sign * x], axis=1)
    up = np.stack([b, sign + y * y * a, -y], axis=1)
    return np.asarray(np.einsum("nkc,ncd->nkd", local, np.stack([right, up, normals], axis=1)))


def texels(directions: Array, rows: int) -> NDArray[np.intp]:
    """Flat index into a (rows, 2 * rows) map of the texel in each direction."""
    uv = uv_from_direction(directions)
    row = np.minimum((uv[..., 1] * rows).astype(np.intp), rows - 1)
    return np.asarray(row * 2 * rows + (uv[..., 0] * 2 * rows).astype(np.intp) % (2 * rows))


class _GroundPatch:
    """A grid on the ground around an object: what of the sky and of each light reaches it."""

    def __init__(self, body: Body, solids: list[Solid], ground_y: float) -> None:
        centre, reach = body.solid.centre, body.solid.radius * (1 + 2 * REACH)
        self.low, self.step = centre[[0, 2]] - reach, 2 * reach / GROUND_CELLS
        at = (np.arange(GROUND_CELLS) + 0.5) * self.step
        x, z = np.meshgrid(self.low[0] + at, self.low[1] + at, indexing="ij")
        self.points = np.stack([x, np.full_like(x, ground_y), z], axis=-1).reshape(-1, 3)
        self.solids = [s for s in solids if _may_shade(s, centre, reach)]
        local = _cosine_directions(GROUND_RAYS, 1)[0]
        self.directions = local[:, [0, 2, 1]]                       # about +Y
        self._free = _visibility(self.points, self.directions, self.solids)
        self._lights: dict[int, tuple[Light, Array]] = {}

    def cell(self, points: Array) -> NDArray[np.intp]:
        """Flat index of the cell that each point of the ground is in; -1 outside."""
        index = np.floor((points[..., [0, 2]] - self.low) / self.step).astype(np.intp)
        inside = ((index >= 0) & (index < GROUND_CELLS)).all(axis=-1)
        return np.where(inside, index[..., 0] * GROUND_CELLS + index[..., 1], -1)

    def ratio(self, sky: Array, lights: tuple[Light, ...]) -> Array:
        """(cells, 3) irradiance with the objects by the one without; `sky` (GROUND_RAYS, 3) is the radiance along its rays."""
        whole = sky.mean(axis=0) * np.pi
        found = self._free @ sky * (np.pi / len(sky))
        for light in lights:
            if light.direction[1] > 0.02:
                irradiance = light.irradiance * light.direction[1]
                whole = whole + irradiance
                found = found + self._light_share(light)[:, None] * irradiance
        return np.asarray(np.where(whole > 1e-9, found / np.maximum(whole, 1e-9), 1.0))


    def _light_share(self, light: Light) -> Array:
        """(cells,) share of a light that arrives; kept until it has moved."""
        kept = self._lights.get(light.id)
        if kept is None or not hardly_moved(kept[0], light, least=STALE):
            directions = disc_directions(light.direction, light.angular_radius, LIGHT_RAYS)
            kept = self._lights[light.id] = (light, _visibility(self.points, directions, self.solids).mean(axis=1))
        return kept[1]

    def forget_lights(self, lights: tuple[Light, ...]) -> None:
        """All but these."""
        self._lights = {light.id: self._lights[light.id] for light in lights if light.id in self._lights}


def _may_shade(solid: Solid, centre: Array, reach: float) -> bool:
    return bool(np.linalg.norm((solid.centre - centre)[[0, 2]]) < 2 * reach + 3 * solid.radius)


def _visibility(points: Array, directions: Array, solids: list[Solid]) -> Array:
    """(points, directions): 1 where nothing is in the way."""
    free = np.ones((len(points), len(directions)), dtype=bool)
    for solid in solids:
        free &= ~solid.hides(points, directions)
    return free.astype(np.float64)


class NearField:
    """The rays from one object, and what they meet; for as long as nothing moves."""

    def __init__(self, body: Body, others: list[Body], ground_y: float | None, rows: int) -> None:
        self._body, self._others, self._ground_y = body, others, ground_y
        directions = _about(body.normals, _cosine_directions(RAYS, POINTS))
        origins = np.repeat(body.points + body.normals * 1e-3 * body.solid.radius, RAYS, axis=0)
        rays = directions.reshape(-1, 3)
        self._sky = texels(rays, rows)
        nearest, met, normals = np.full(len(rays), np.inf), np.full(len(rays), -1), np.zeros((len(rays), 3))
        for index, other in enumerate(others):
            distance, normal = other.solid.hit(origins, rays)
            closer = distance < nearest
            nearest, met, normals = np.where(closer, distance, nearest), np.where(closer, index, met), np.where(
                closer[:, None], normal, normals)
        self._patch: _GroundPatch | None = None
        self._on_ground = np.zeros(len(rays), dtype=bool)
        if ground_y is not None:
            with np.errstate(divide="ignore"):
                down = np.where(rays[:, 1] < -1e-6, (ground_y - origins[:, 1]) / rays[:, 1], np.inf)
            self._on_ground = (down < nearest) & (down >= 0)
            met = np.where(self._on_ground, -1, met)
            self._patch = _GroundPatch(body, [b.solid for b in (body, *others)], ground_y)
            ground = origins[self._on_ground] + rays[self._on_ground] * down[self._on_ground, None]
            self._ground_cells = self._patch.cell(ground)
            self._ground_texels = texels(ground / np.linalg.norm(ground, axis=1, keepdims=True), rows)
            self._patch_sky = texels(self._patch.directions, rows)
        self._met = [(index, np.flatnonzero(met == index)) for index in range(len(others)) if (met == index).any()]
        self._met_normals = [normals[found] for _, found in self._met]
        self._met_mirrored = [texels(mirrored(rays[found], normals[found]), rows) for _, found in self._met]
        self._size = 2 * body.solid.radius
        self._spheres = _nearest_spheres(body, others)
        basis = functions(body.points, body.normals, body.solid.centre, self._size, -1e9 if ground_y is None else ground_y,
                          self._spheres)
        self._solver = np.linalg.solve(basis.T @ basis + RIDGE * len(basis) * np.eye(FUNCTIONS), basis.T)

    def fit(self, radiance: NDArray[np.float32], irradiance: NDArray[np.float32], lights: tuple[Light, ...]) -> Fit:
        """For (rows, 2 * rows, 3) radiance without its lights, and (rows', 2 * rows', 3) irradiance of it."""
        flat = radiance.reshape(-1, 3).astype(np.float64)
        distant = flat[self._sky]
        near = distant.copy()
        if self._patch is not None:
            self._patch.forget_lights(lights)
            ratio = np.append(self._patch.ratio(flat[self._patch_sky], lights), [[1.0, 1.0, 1.0]], axis=0)
            near[self._on_ground] = flat[self._ground_texels] * ratio[self._ground_cells]
        for (index, rays), normals, seen in zip(self._met, self._met_normals, self._met_mirrored, strict=True):
            received = irradiance.reshape(-1, 3)[texels(normals, irradiance.shape[0])]
            near[rays] = self._others[index].reflects(received, flat[seen])
        sums = [values.reshape(POINTS, RAYS, 3).sum(axis=1) for values in (near, distant)]
        ratio = np.clip(np.where(sums[1] > 1e-9, sums[0] / np.maximum(sums[1], 1e-9), 1.0), *RATIO_RANGE)
        one = np.zeros((FUNCTIONS, 3))
        one[0] = 1.0
        return Fit(self._body.solid.centre, self._size, self._solver @ (ratio - 1.0) + one, self._spheres)


def _nearest_spheres(body: Body, others: list[Body]) -> Array:
    """(NEIGHBOURS, 4) centre and radius of spheres as large as those neighbours that fill most of the view; 0 for none."""
    found = np.zeros((NEIGHBOURS, 4))
    away = [max(float(np.linalg.norm(other.solid.centre - body.solid.centre)), 1e-6) for other in others]
    size = [other.solid.mean_radius / distance for other, distance in zip(others, away, strict=True)]
    for slot, index in enumerate(np.argsort(size)[::-1][:NEIGHBOURS]):
        found[slot] = (*others[index].solid.centre, others[index].solid.mean_radius)
    return found
