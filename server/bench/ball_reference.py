"""Two balls on the ground under a known environment, in float64: what each pixel should be, without a path tracer.

The light of every texel is summed with visibility by ray and sphere; discs by points on them, their shadow on the ground by
closed form (`ball_shadow.py`). A ray that goes down meets the ground where it is: the panorama's radiance there times the ratio
of light that the balls leave, from a table; one that meets the other ball sees its radiance, of the diffuse one from a table by
its normal, of the metal by the map prefiltered along the mirrored ray (second order: it lights nothing but its neighbours).
Light goes round twice. The reflectance is the renderer's own (glTF metallic-roughness, GGX, Fdez-Aguera's compensation), so
that what differs is light.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from renderer.equirectangular import pixel_directions, solid_angles
from renderer.light.detection import Light
from renderer.light.discs import disc_directions
from renderer.light.specular import prefilter, resample
from server.bench.ball_shadow import hidden_share
from server.bench.light_reference import interpolated

Array = NDArray[np.float64]
UP = np.array([0.0, 1.0, 0.0])
DISC_SAMPLES = 64
CHUNK = 24              # points that are summed over at once
TABLE_CELLS, TABLE_REACH_M = 44, 2.4
TABLE_TEXELS, NORMAL_ROWS = 32, 16
ROUNDS = 2
DIELECTRIC = 0.04


@dataclass(frozen=True)
class Ball:
    name: str
    centre: Array
    radius: float
    color: Array
    metallic: float
    roughness: float


@dataclass(frozen=True)
class Environment:
    """`sky`: (height, width, 3) radiance without `lights`; `backdrop`: what the frame shows, without them too."""

    sky: Array
    lights: tuple[Light, ...]
    backdrop: Array

    def texels(self, rows: int) -> tuple[Array, Array, Array]:
        """(m, 3) directions, (m, 3) radiance and (m,) solid angles of the sky at so many rows."""
        sky = np.asarray(resample(self.sky, rows, 2 * rows), dtype=np.float64) if rows < self.sky.shape[0] else self.sky
        rows = sky.shape[0]
        angles = np.broadcast_to(solid_angles(rows, 2 * rows), (rows, 2 * rows)).ravel()
        return pixel_directions(rows, 2 * rows).reshape(-1, 3), sky.reshape(-1, 3), angles


class BallReference:
    """Holds the tables of one environment."""

    def __init__(self, environment: Environment, balls: tuple[Ball, ...], camera_height: float, texels: int) -> None:
        self._environment, self._balls, self._ground_y = environment, balls, -camera_height
        self._texels = environment.texels(texels)
        self._table_texels = environment.texels(TABLE_TEXELS)
        self._middle = np.mean([ball.centre for ball in balls], axis=0)
        self._ratio = np.ones((TABLE_CELLS, TABLE_CELLS, 3))
        self._irradiance = {ball.name: np.zeros((NORMAL_ROWS, 2 * NORMAL_ROWS, 3)) for ball in balls if ball.metallic < 1}
        for _ in range(ROUNDS):
            for ball in balls:
                if ball.name in self._irradiance:
                    self._irradiance[ball.name] = self._table_of(ball)
            self._ratio = self.ground(self._cells(), self._table_texels).reshape(TABLE_CELLS, TABLE_CELLS, 3)

    @cached_property
    def _open_ground(self) -> Array:
        directions, radiance, angles = self._texels
        return _on_ground(directions, radiance, angles) + sum(
            (light.irradiance * float(light.direction[1]) for light in self._above()), np.zeros(3))

    def _above(self) -> list[Light]:
        return [light for light in self._environment.lights if light.direction[1] > np.sin(light.angular_radius)]

    def ground(self, points: Array, texels: tuple[Array, Array, Array] | None = None) -> Array:
        """(n, 3) light that points of the ground receive, by what they would without the balls."""
        directions, radiance, angles = self._texels if texels is None else texels
        over = directions[:, 1] > 0
        weights = directions[over, 1] * angles[over]
        missing = np.zeros((len(points), 3))
        for start in range(0, len(points), CHUNK):
            part = points[start:start + CHUNK]
            seen = self._seen(part, directions[over], radiance[over], None)
            missing[start:start + CHUNK] = np.einsum("pmc,m->pc", radiance[over] - seen, weights)
        for light in self._above():
            hidden = sum(hidden_share(points, ball.centre, ball.radius, light) for ball in self._balls)
            missing += np.minimum(hidden, 1.0)[:, None] * light.irradiance * light.direction[1]
        whole = self._open_ground if texels is None else _on_ground(directions, radiance, angles) + sum(
            (light.irradiance * float(light.direction[1]) for light in self._above()), np.zeros(3))
        return np.asarray(1 - missing / np.maximum(whole, 1e-12))

    def radiance(self, ball: Ball, points: Array, views: Array) -> Array:
        """(n, 3) radiance of points of a ball in the (n, 3) directions of those who see it."""
        directions, radiance, angles = self._texels
        found = np.zeros((len(points), 3))
        for start in range(0, len(points), CHUNK):
            part = slice(start, start + CHUNK)
            normals = (points[part] - ball.centre) / ball.radius
            seen = self._seen(points[part], directions, radiance, ball)
            lobe = _Reflectance(ball, normals, views[part], directions, angles)
            found[part] = np.einsum("pmc,pmc->pc", seen, lobe.factors(directions) * angles[:, None])
            for light in self._environment.lights:
                samples = disc_directions(light.direction, light.angular_radius, DISC_SAMPLES)
                free = ~np.any([_hit(points[part], samples, other)[0] for other in self._balls if other is not ball], axis=0)
                free &= samples[:, 1] > 0
                found[part] += np.einsum("pmc,pm->pc", lobe.factors(samples), free / DISC_SAMPLES) * light.irradiance
        return found

    def _table_of(self, ball: Ball) -> Array:
        """Irradiance of a ball by its normal, as a map of directions."""
        normals = pixel_directions(NORMAL_ROWS, 2 * NORMAL_ROWS).reshape(-1, 3)
        points = ball.centre + ball.radius * normals
        directions, radiance, angles = self._table_texels
        found = np.zeros((len(normals), 3))
        for start in range(0, len(normals), CHUNK):
            part = slice(start, start + CHUNK)
            weights = np.maximum(normals[part] @ directions.T, 0.0) * angles
            found[part] = np.einsum("pmc,pm->pc", self._seen(points[part], directions, radiance, ball), weights)
        for light in self._environment.lights:
            samples = disc_directions(light.direction, light.angular_radius, DISC_SAMPLES)
            free = ~np.any([_hit(points, samples, other)[0] for other in self._balls if other is not ball], axis=0)
            found += (np.maximum(normals @ samples.T, 0.0) * free).mean(axis=1)[:, None] * light.irradiance
        return found.reshape(NORMAL_ROWS, 2 * NORMAL_ROWS, 3)

    def _cells(self) -> Array:
        at = self._middle[[0, 2]][:, None] + (((np.arange(TABLE_CELLS) + 0.5) / TABLE_CELLS - 0.5) * 2 * TABLE_REACH_M)
        x, z = np.meshgrid(at[0], at[1], indexing="ij")
        return np.stack([x, np.full_like(x, self._ground_y), z], axis=-1).reshape(-1, 3)

    def _ratio_at(self, points: Array) -> Array:
        """Bilinear in the table; 1 beyond it."""
        at = ((points[..., [0, 2]] - self._middle[[0, 2]]) / (2 * TABLE_REACH_M) + 0.5) * TABLE_CELLS - 0.5
        corner = np.clip(np.floor(at).astype(int), 0, TABLE_CELLS - 2)
        share = np.clip(at - corner, 0.0, 1.0)
        x, z = corner[..., 0], corner[..., 1]
        fx, fz = share[..., :1], share[..., 1:]
        found = ((1 - fx) * ((1 - fz) * self._ratio[x, z] + fz * self._ratio[x, z + 1])
                 + fx * ((1 - fz) * self._ratio[x + 1, z] + fz * self._ratio[x + 1, z + 1]))
        return np.where((np.abs(at + 0.5 - TABLE_CELLS / 2) < TABLE_CELLS / 2 - 1).all(axis=-1, keepdims=True), found, 1.0)

    def _seen(self, points: Array, directions: Array, radiance: Array, own: Ball | None) -> Array:
        """(p, m, 3) radiance that comes to points from directions; `own`: the ball that they lie on."""
        seen = np.broadcast_to(radiance, (len(points), *radiance.shape)).copy()
        down = np.flatnonzero(directions[:, 1] < -1e-3)
        if len(down):
            distance = (self._ground_y - points[:, None, 1]) / directions[down, 1]
            met = points[:, None] + directions[down] * distance[..., None]
            backdrop = interpolated(self._environment.backdrop, met.reshape(-1, 3)).reshape(met.shape)
            seen[:, down] = backdrop * self._ratio_at(met)
        for ball in self._balls:
            if ball is not own:
                hit, at = _hit(points, directions, ball)
                point, ray = np.nonzero(hit)
                normals = (points[point] + directions[ray] * at[point, ray, None] - ball.centre) / ball.radius
                seen[point, ray] = self._given_back(ball, normals, directions[ray])
        return seen

    def _given_back(self, ball: Ball, normals: Array, rays: Array) -> Array:
        """(n, 3) radiance of a ball where rays meet it."""
        if ball.name in self._irradiance:
            return ball.color / np.pi * interpolated(self._irradiance[ball.name], normals)
        mirrored = rays - 2 * (rays * normals).sum(axis=1, keepdims=True) * normals
        return ball.color * interpolated(self._lobes[ball.roughness], mirrored)

    @cached_property
    def _lobes(self) -> dict[float, Array]:
        """The environment, its lights in it, prefiltered for each metal."""
        directions, radiance, angles = self._environment.texels(64)
        whole = radiance.copy()
        for light in self._environment.lights:
            nearest = int(np.argmax(directions @ light.direction))
            whole[nearest] += light.irradiance / angles[nearest]
        rows = int(np.sqrt(len(whole) / 2))
        return {ball.roughness: prefilter(whole.reshape(rows, 2 * rows, 3).astype(np.float32), ball.roughness).astype(np.float64)
                for ball in self._balls if ball.metallic == 1}


class _Reflectance:
    """Of points with these normals, for viewers in these directions; its albedo is summed over (m, 3) directions."""

    def __init__(self, ball: Ball, normals: Array, views: Array, directions: Array, angles: Array) -> None:
        self._ball, self._normals, self._views = ball, normals, views
        self._alpha2 = max(ball.roughness**4, 4e-6)
        self._f0 = DIELECTRIC * (1 - ball.metallic) + ball.color * ball.metallic
        lobe, fresnel = self._lobe(directions)
        whole = (lobe * angles).sum(axis=1)
        self._compensation = 1 + self._f0 * (1 / np.maximum(whole, 1e-3)[:, None] - 1)
        reflected = self._f0 * ((1 - fresnel) * lobe * angles).sum(axis=1)[:, None] + (fresnel * lobe * angles).sum(axis=1)[:, None]
        self._diffuse = ball.color / np.pi * (1 - ball.metallic) * (1 - reflected * self._compensation)

    def factors(self, directions: Array) -> Array:
        """(p, m, 3) reflectance times cosine."""
        lobe, fresnel = self._lobe(directions)
        glossy = (self._f0 + (1 - self._f0) * fresnel[..., None]) * lobe[..., None] * self._compensation[:, None]
        return np.asarray(glossy + self._diffuse[:, None] * np.maximum(self._normals @ directions.T, 0.0)[..., None])

    def _lobe(self, directions: Array) -> tuple[Array, Array]:
        """(p, m) D V cos, and Schlick's fifth power."""
        n_dot_l = np.maximum(self._normals @ directions.T, 0.0)
        n_dot_v = np.maximum((self._normals * self._views).sum(axis=1), 1e-3)[:, None]
        v_dot_h = np.sqrt(np.maximum(0.5 * (1 + self._views @ directions.T), 1e-12))
        n_dot_h = np.clip((n_dot_l + n_dot_v) / (2 * v_dot_h), 0.0, 1.0)
        a2 = self._alpha2
        distribution = a2 / (np.pi * (n_dot_h**2 * (a2 - 1) + 1) ** 2)
        smith = n_dot_l * np.sqrt(n_dot_v**2 * (1 - a2) + a2) + n_dot_v * np.sqrt(n_dot_l**2 * (1 - a2) + a2)
        visibility = 0.5 / np.maximum(smith, 1e-12)
        return distribution * visibility * n_dot_l, (1 - v_dot_h) ** 5


def _on_ground(directions: Array, radiance: Array, angles: Array) -> Array:
    return np.asarray((np.maximum(directions[:, 1], 0.0) * angles) @ radiance)


def _hit(points: Array, directions: Array, ball: Ball) -> tuple[NDArray[np.bool_], Array]:
    """(p, m) whether a ray from a point outside meets a ball, and how far off."""
    offset = points - ball.centre
    along = offset @ directions.T
    under_root = along**2 - ((offset**2).sum(axis=1) - ball.radius**2)[:, None]
    return (under_root > 0) & (along < 0), -along - np.sqrt(np.maximum(under_root, 0.0))
