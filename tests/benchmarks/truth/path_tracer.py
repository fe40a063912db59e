"""The truth: objects and a Lambertian floor under a radiance map, path traced with Mitsuba's ray tracing core.

Every pixel of the equirectangular frame sends its own primary rays from the origin. The floor's albedo is what makes the empty
floor look like the panorama under the map's own irradiance; where that would need more than `MAX_ALBEDO`, the rest is emitted.
Surfaces are glTF 2.0 metallic-roughness (specification, appendix B) with the energy of multiple bounces put back (Turquin 2019),
and the diffuse base gets what the specular coat's directional albedo leaves, so that a white object is a white furnace.
After a rough bounce, smooth surfaces are traced as `BLURRED_ROUGHNESS` (path regularization, Kaplanyan & Dachsbacher 2013): the
caustics of a sun would not converge otherwise.
"""

from __future__ import annotations

import glob
import os
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

os.environ.setdefault("DRJIT_LIBLLVM_PATH", next(iter(sorted(glob.glob("/usr/lib/*/libLLVM*19*.so*"))), ""))
import drjit as dr
import mitsuba as mi

mi.set_variant("llvm_ad_rgb")
Array = NDArray[np.float64]
Array32 = NDArray[np.float32]
MAX_ALBEDO = 0.95
FLOOR_REACH = 100.0         # floor radius in camera heights; what is beyond is the map's own
MAX_DEPTH = 7
MIN_ALPHA = 1e-3
BLURRED_ROUGHNESS = 0.3
LANES = 1 << 21             # paths traced at once


@dataclass(frozen=True)
class Solid:
    """All objects as one mesh in the world; `materials` (k, 8): base colour, metallic, roughness, emissive, of the objects
    `object_of_material` (k,). `texture`: linear base colour (height, width, 3) of the materials flagged in `textured` (k,)."""

    positions: Array32
    normals: Array32
    uvs: Array32
    triangles: NDArray[np.int32]
    material_of_triangle: NDArray[np.int32]
    materials: Array
    object_of_material: NDArray[np.int32]
    texture: Array32 | None = None
    textured: tuple[bool, ...] = ()


@dataclass(frozen=True)
class Traced:
    """Per traced pixel: (n, 3) radiance of objects times coverage, (n, objects) coverage by each, (n, 3) the floor's irradiance
    with objects by the one without times the floor's share of the pixel, (n,) that share."""

    object_radiance: Array
    coverage: Array
    floor_ratio: Array
    floor_share: Array

    def over(self, background: Array) -> Array:
        """(n, 3) pixels, given (n, 3) pixels of the panorama."""
        open_share = 1 - self.coverage.sum(axis=1) - self.floor_share
        return self.object_radiance + background * (self.floor_ratio + open_share[:, None])


def trace(solid: Solid, radiance: Array32, camera_height: float, pixels: NDArray[np.intp], samples: int, seed: int = 0) -> Traced:
    """Trace (n, 2) row and column `pixels` of the frame that has the size of `radiance`, (height, width, 3)."""
    tracer = _Tracer(solid, radiance, camera_height)
    at_once = max(1, min(samples, LANES // max(len(pixels), 1)))
    objects = int(solid.object_of_material.max()) + 1
    total = np.zeros((len(pixels), 7 + objects))
    done = 0
    while done < samples:
        count = min(at_once, samples - done)
        total += tracer.launch(pixels, count, done, seed)
        done += count
    total /= samples
    return Traced(total[:, :3], total[:, 7:], total[:, 3:6], total[:, 6])


class _Tracer:
    def __init__(self, solid: Solid, radiance: Array32, camera_height: float) -> None:
        self.size = (radiance.shape[1], radiance.shape[0])
        self.floor_y = -camera_height
        self.reach2 = (FLOOR_REACH * camera_height)**2
        environment = mi.load_dict({"type": "envmap", "bitmap": mi.Bitmap(_vertex_centred(radiance))})
        self.scene = mi.load_dict({"type": "scene", "solid": _mesh(solid), "environment": environment})
        self.environment = self.scene.environment()
        self.objects = int(solid.object_of_material.max()) + 1
        self.object_of_material = mi.Int32(solid.object_of_material.astype(np.int32))
        self.materials = [mi.Float(np.ascontiguousarray(column, dtype=np.float32)) for column in solid.materials.T]
        self.texture = None
        if solid.texture is not None:
            self.texture = mi.Texture2f(mi.TensorXf(solid.texture), wrap_mode=dr.WrapMode.Repeat)
            self.textured = mi.Float(np.array(solid.textured, dtype=np.float32))
        self.energy = mi.Texture2f(mi.TensorXf(_single_scattering().astype(np.float32)), wrap_mode=dr.WrapMode.Clamp)
        self.open_irradiance = self._open_irradiance()

    def _open_irradiance(self) -> Any:
        sampler = _sampler(1 << 22, 12345)
        sample, weight = self.scene.sample_emitter_direction(dr.zeros(mi.SurfaceInteraction3f, 1 << 22), sampler.next_2d(), False)
        return mi.Color3f(np.array(weight * dr.maximum(sample.d.y, 0.0), dtype=np.float64).mean(axis=1))

    def launch(self, pixels: NDArray[np.intp], count: int, first: int, seed: int) -> Array:
        """(n, channels) sums over `count` samples of each pixel, of which `first` have been taken."""
        lanes = len(pixels) * count
        sampler = _sampler(lanes, seed * 100_003 + first)
        index = dr.arange(mi.UInt32, lanes) // count
        row, column = (dr.gather(mi.UInt32, mi.UInt32(pixels[:, i].astype(np.uint32)), index) for i in (0, 1))
        # R2 sequence (Roberts 2018), each pixel's turned by its own amount: coverage converges with the count, not with its root
        turns = [dr.gather(mi.Float, mi.Float(values.astype(np.float32)), index)
                 for values in np.random.default_rng(seed).random((2, len(pixels)))]
        number = mi.Float(dr.arange(mi.UInt32, lanes) % count + first)
        jitter = mi.Point2f(*(turn + number * ratio - dr.floor(turn + number * ratio)
                              for turn, ratio in zip(turns, (0.7548776662, 0.5698402910), strict=True)))
        azimuth = ((mi.Float(column) + jitter.x) / self.size[0] * 2 - 1) * dr.pi
        polar = (mi.Float(row) + jitter.y) / self.size[1] * dr.pi
        s_polar, c_polar = dr.sincos(polar)
        s_azimuth, c_azimuth = dr.sincos(azimuth)
        ray = mi.Ray3f(mi.Point3f(0.0), mi.Vector3f(s_polar * s_azimuth, c_polar, -s_polar * c_azimuth))
        found, first_object, on_floor = self._radiance(ray, sampler)
        found = dr.select(dr.isfinite(found), found, 0.0)
        kinds = [on_floor, *(first_object == index for index in range(self.objects))]
        channels = [*dr.select(first_object >= 0, found, 0.0), *dr.select(on_floor, found, 0.0),
                    *(dr.select(kind, mi.Float(1.0), 0.0) for kind in kinds)]
        return np.stack([np.array(dr.block_sum(channel, count), dtype=np.float64) for channel in channels], axis=1)

    def _floor_hit(self, ray: Any, limit: Any) -> tuple[Any, Any, Any]:
        """Whether a ray meets the floor before `limit`, how far away, and where."""
        distance = (self.floor_y - ray.o.y) / ray.d.y
        point = ray.o + ray.d * distance
        hit = (ray.d.y < 0) & (ray.o.y > self.floor_y) & (distance < limit) & (point.x * point.x + point.z * point.z < self.reach2)
        return hit, distance, point

    def _map(self, direction: Any) -> Any:
        at = dr.zeros(mi.SurfaceInteraction3f)
        at.wi = -direction
        return self.environment.eval(at)

    def _map_pdf(self, direction: Any) -> Any:
        sample = dr.zeros(mi.DirectionSample3f)
        sample.d = direction
        return self.environment.pdf_direction(dr.zeros(mi.SurfaceInteraction3f), sample)

    @dr.syntax
    def _radiance(self, ray: Any, sampler: Any) -> Any:
        """Radiance along primary rays; that of a floor hit as irradiance by open irradiance."""
        depth = mi.UInt32(0)
        total, throughput = mi.Color3f(0.0), mi.Color3f(1.0)
        density = mi.Float(0.0)             # of the direction that led here; 0 for the camera's own
        rough_seen = mi.Bool(False)
        first_object, on_floor = mi.Int32(-1), mi.Bool(False)
        active = mi.Bool(True)
        while active:
            at = self.scene.ray_intersect(ray, active)
            hit = at.is_valid()
            floor, _, floor_point = self._floor_hit(ray, dr.select(hit, at.t, dr.inf))
            solid = hit & ~floor
            first = depth == 0
            material = mi.UInt32(at.shape.eval_attribute_1("face_material", at, active & solid) + 0.5)
            first_object = dr.select(first & solid, dr.gather(mi.Int32, self.object_of_material, material, active & solid),
                                     first_object)
            on_floor |= first & floor

            missed = active & ~solid & ~floor & ~first
            weight = dr.select(missed, density / dr.maximum(density + self._map_pdf(ray.d), 1e-20), 0.0)
            total += dr.select(missed, throughput * self._map(ray.d) * weight, 0.0)
            active &= solid | floor

            color, metallic, roughness, glow = self._substance(at, material, floor, floor_point, first, active & solid)
            roughness = dr.select(rough_seen, dr.maximum(roughness, BLURRED_ROUGHNESS), roughness)
            alpha = dr.maximum(roughness * roughness, MIN_ALPHA)
            shininess = dr.select(floor, mi.Float(0.0), mi.Float(1.0))
            total += dr.select(active & ~(floor & first), throughput * glow, 0.0)
            geometric, frame, start = _shape(at, ray, floor, floor_point)
            view = frame.to_local(-ray.d)

            # the map, sampled
            sample, weight3, lit = self._lamp(start, geometric, sampler, active)
            light = frame.to_local(sample.d)
            value = self._brdf_cosine(view, light, color, metallic, alpha, roughness, shininess)
            own = _density(view, light, metallic, alpha, shininess)
            total += dr.select(lit, throughput * value * weight3 * (sample.pdf / (sample.pdf + own)), 0.0)

            # the surface, sampled
            onward = _sampled(view, alpha, _lobe_share(metallic, shininess), sampler.next_1d(active), sampler.next_2d(active))
            density = _density(view, onward, metallic, alpha, shininess)
            value = self._brdf_cosine(view, onward, color, metallic, alpha, roughness, shininess)
            throughput *= dr.select(density > 1e-12, value / density, 0.0)
            rough_seen |= floor | (roughness > BLURRED_ROUGHNESS) | (metallic < 0.5)
            ray = mi.Ray3f(start, frame.to_world(onward))
            depth += 1
            active &= (depth < MAX_DEPTH) & (dr.max(throughput) > 0) & (dr.dot(ray.d, geometric) > 0)
            survival = dr.select(depth > 3, dr.clip(dr.max(throughput), 0.05, 0.95), 1.0)
            active &= sampler.next_1d(active) < survival
            throughput /= survival
        return total, first_object, on_floor

    def _substance(self, at: Any, material: Any, floor: Any, floor_point: Any, first: Any, on_solid: Any) -> tuple[Any, ...]:
        """Colour, metallic, roughness and what it gives off. The floor is as bright under the open map as the map shows it; seen
        first its colour is such that its radiance is the ratio of irradiances."""
        seen = self._map(dr.normalize(mi.Vector3f(floor_point)))
        albedo = dr.clip(seen * dr.pi / dr.maximum(self.open_irradiance, 1e-9), 0.0, MAX_ALBEDO)
        glow = dr.maximum(seen - albedo * self.open_irradiance / dr.pi, 0.0)
        albedo = dr.select(first, dr.pi / dr.maximum(self.open_irradiance, 1e-9), albedo)
        color, metallic, roughness, emissive = self._material(at, material, on_solid)
        return (dr.select(floor, albedo, color), dr.select(floor, 0.0, metallic), roughness, dr.select(floor, glow, emissive))

    def _lamp(self, start: Any, geometric: Any, sampler: Any, active: Any) -> tuple[Any, Any, Any]:
        """A direction drawn from the map, its weight, and whether it is seen."""
        anywhere = dr.zeros(mi.SurfaceInteraction3f)
        sample, weight = self.scene.sample_emitter_direction(anywhere, sampler.next_2d(), False, active)
        shadow_ray = mi.Ray3f(start, sample.d)
        lit = active & (dr.dot(sample.d, geometric) > 0) & (sample.pdf > 0)
        lit &= ~self._floor_hit(shadow_ray, mi.Float(dr.inf))[0]
        lit &= ~self.scene.ray_test(shadow_ray, lit)
        return sample, weight, lit

    def _material(self, at: Any, index: Any, active: Any) -> tuple[Any, Any, Any, Any]:
        r, g, b, metallic, roughness, er, eg, eb = (dr.gather(mi.Float, column, index, active) for column in self.materials)
        color = mi.Color3f(r, g, b)
        if self.texture is not None:
            texel = self.texture.eval(mi.Point2f(at.uv.x, at.uv.y), active)
            color *= dr.select(dr.gather(mi.Float, self.textured, index, active) > 0.5, mi.Color3f(texel), mi.Color3f(1.0))
        return color, metallic, roughness, mi.Color3f(er, eg, eb)

    def _brdf_cosine(self, view: Any, light: Any, color: Any, metallic: Any, alpha: Any, roughness: Any, shininess: Any) -> Any:
        """glTF's BRDF times the cosine; directions in the surface's frame."""
        half = dr.normalize(view + light)
        v, n_l = dr.maximum(view.z, 1e-4), dr.maximum(light.z, 0.0)
        away = 1 - dr.clip(dr.dot(view, half), 0, 1)
        f90 = away * away * away * away * away
        energy, grazing_energy = self.energy.eval(mi.Point2f(v, roughness))
        a2 = alpha * alpha
        d = a2 / (dr.pi * dr.square(half.z * half.z * (a2 - 1) + 1))
        visibility = 0.5 / dr.maximum(n_l * dr.sqrt(v * v * (1 - a2) + a2) + v * dr.sqrt(n_l * n_l * (1 - a2) + a2), 1e-9)
        lobe = d * visibility * shininess
        back = 1 / dr.maximum(energy, 1e-3) - 1
        metal = (color + (1 - color) * f90) * (1 + color * back) * lobe
        coat = (0.04 * energy + 0.96 * grazing_energy) * (1 + 0.04 * back) * shininess
        dielectric = (1 - coat) * color / dr.pi + (0.04 + 0.96 * f90) * (1 + 0.04 * back) * lobe
        value = metal * metallic + dielectric * (1 - metallic)
        return dr.select((light.z > 0) & (view.z > 0), value * n_l, 0.0)



def _shape(at: Any, ray: Any, floor: Any, floor_point: Any) -> tuple[Any, Any, Any]:
    """The side of the surface that is seen: its geometric normal, the frame of the interpolated one, and where rays leave."""
    up = mi.Vector3f(0, 1, 0)
    geometric = dr.select(dr.dot(at.n, ray.d) > 0, -at.n, at.n)
    smooth = dr.select(dr.dot(at.sh_frame.n, geometric) < 0, -at.sh_frame.n, at.sh_frame.n)
    facing = dr.dot(smooth, ray.d)
    smooth = dr.normalize(dr.select(facing > 0, smooth - ray.d * (facing + 1e-3), smooth))
    normal, geometric = dr.select(floor, up, smooth), dr.select(floor, up, geometric)
    point = dr.select(floor, floor_point, at.p)
    return geometric, mi.Frame3f(normal), point + geometric * (1e-4 * dr.maximum(1.0, dr.max(dr.abs(point))))


def _sampler(lanes: int, seed: int) -> Any:
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(seed, lanes)
    return sampler


def _lobe_share(metallic: Any, shininess: Any) -> Any:
    return (0.5 + 0.5 * metallic) * shininess


def _density(view: Any, light: Any, metallic: Any, alpha: Any, shininess: Any) -> Any:
    """Of `_sampled`, by solid angle."""
    share = _lobe_share(metallic, shininess)
    half = dr.normalize(view + light)
    a2 = alpha * alpha
    d = a2 / (dr.pi * dr.square(half.z * half.z * (a2 - 1) + 1))
    v = dr.maximum(view.z, 1e-4)
    g1 = 2 * v / (v + dr.sqrt(a2 + (1 - a2) * v * v))
    density = share * d * g1 / (4 * v) + (1 - share) * dr.maximum(light.z, 0) / dr.pi
    return dr.select((light.z > 0) & (view.z > 0), density, 0.0)


def _sampled(view: Any, alpha: Any, share: Any, choice: Any, point: Any) -> Any:
    """A direction from the visible normals (Dupuy & Benyoub 2023) or the cosine."""
    stretched = dr.normalize(mi.Vector3f(alpha * view.x, alpha * view.y, view.z))
    z = dr.fma(1 - point.y, 1 + stretched.z, -stretched.z)
    radius = dr.sqrt(dr.clip(1 - z * z, 0, 1))
    s, c = dr.sincos(2 * dr.pi * point.x)
    cap = mi.Vector3f(radius * c, radius * s, z) + stretched
    half = dr.normalize(mi.Vector3f(alpha * cap.x, alpha * cap.y, cap.z))
    mirrored = 2 * dr.dot(view, half) * half - view
    return dr.select(choice < share, mirrored, mi.warp.square_to_cosine_hemisphere(point))


def _mesh(solid: Solid) -> Any:
    mesh = mi.Mesh("solid", len(solid.positions), len(solid.triangles), has_vertex_normals=True, has_vertex_texcoords=True)
    mesh.add_attribute("face_material", 1, solid.material_of_triangle.astype(np.float32))
    values = mi.traverse(mesh)
    values["vertex_positions"], values["faces"] = solid.positions.ravel(), solid.triangles.astype(np.uint32).ravel()
    values["vertex_normals"], values["vertex_texcoords"] = solid.normals.ravel(), solid.uvs.ravel()
    values.update()
    return mesh


def _vertex_centred(radiance: Array32) -> Array32:
    """The map as Mitsuba wants it: rows from pole to pole with the ends included, u = 0 at -Z."""
    height, width = radiance.shape[:2]
    turned = np.roll(radiance, -(width // 2), axis=1)       # ours has -Z in the middle
    return interpolated(turned, np.arange(height + 1) - 0.5, np.arange(width))


def interpolated(radiance: Array32, rows: Array, columns: Array) -> Array32:
    """Bilinear, at these rows and columns of the map; pixel centres are whole numbers."""
    grid = np.meshgrid(np.clip(rows, 0, radiance.shape[0] - 1), columns, indexing="ij")
    return np.stack([map_coordinates(radiance[..., c], grid, order=1, mode="grid-wrap") for c in range(3)],
                    axis=-1).astype(np.float32)


@cache
def _single_scattering(size: int = 48, samples: int = 4096) -> Array:
    """(roughness, n.v, 2) share of light that comes back in one bounce off GGX without Fresnel, and weighed with Schlick's
    (1 - v.h)^5; sampled by visible normals."""
    index = np.arange(samples)
    u1, u2 = (index + 0.5) / samples, (index * 0.6180339887498949) % 1
    table = np.empty((size, size, 2))
    for i, roughness in enumerate((np.arange(size) + 0.5) / size):
        alpha = max(roughness**2, MIN_ALPHA)
        for j, v in enumerate((np.arange(size) + 0.5) / size):
            view = np.array([np.sqrt(1 - v * v), 0, v])
            stretched = view * [alpha, 1, 1]
            stretched /= np.linalg.norm(stretched)
            z = (1 - u2) * (1 + stretched[2]) - stretched[2]
            radius = np.sqrt(np.clip(1 - z * z, 0, 1))
            half = np.stack([radius * np.cos(2 * np.pi * u1), radius * np.sin(2 * np.pi * u1), z], axis=1) + stretched
            half *= [alpha, alpha, 1]
            half /= np.linalg.norm(half, axis=1, keepdims=True)
            light_z = np.maximum(2 * (half @ view) * half[:, 2] - v, 0)
            a2 = alpha * alpha
            # G2 / G1(view) of height-correlated Smith
            root_v, root_l = np.sqrt(a2 + (1 - a2) * v * v), np.sqrt(a2 + (1 - a2) * light_z**2)
            ratio = light_z * (v + root_v) / np.maximum(v * root_l + light_z * root_v, 1e-12)
            table[i, j] = ratio.mean(), (ratio * (1 - half @ view) ** 5).mean()
    return table
