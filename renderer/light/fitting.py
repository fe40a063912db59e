"""Madsen's virtual probe: an ambient term and N directional lights that shade a white sphere as the whole panorama does.

Madsen et al. 2003, section 3: a Lambertian probe of 320 facets in an environment of 5120, both subdivided icosahedra; ambient,
colours and directions are fitted to its irradiance by least squares. Ours differs in method, not in model: the environment's
facets have equal parts of the solid angle they cover, the Jacobian is analytic and assembled from the 3 N + 1 columns that
its 3 x 320 rows share, the iteration is Levenberg-Marquardt, colours cannot become negative, the first guess is what the light
detection found and after that the last frame's fit. N may be found too: the fewest lights whose error of shading is below a
threshold, which the paper leaves as future work.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.spatial import cKDTree

from renderer.equirectangular import pixel_directions, solid_angles
from renderer.light.inverse_tone_mapping import WEIGHTS

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]
Guess = Callable[[], Array]
PROBE_SUBDIVISIONS, ENVIRONMENT_SUBDIVISIONS = 2, 4     # of an icosahedron: 320 and 5120 facets
MAX_ITERATIONS = 30
WARM_ITERATIONS = 3         # from the last frame's fit: what they leave, the next frame's take up
CONVERGED = 1e-3            # relative decrease of the squared error in one step
MAX_ERROR = 0.02            # rms of the probe's irradiance, relative: Weber's just noticeable difference
FEWER_BELOW = 0.5           # of MAX_ERROR: then one light less is tried
MAX_LIGHTS = 8
MAX_TURN = 0.3              # rad a step
SEPARATE = 0.9              # cosine; a guess nearer to a light than that is that light
SEEN_BEFORE_CONCLUDED = 1.5     # how much more a light must explain that no detector saw


@dataclass(frozen=True)
class ProbeFit:
    """`ambient`: (3,) radiance from everywhere; `directions`: (n, 3) to the lights; `irradiances`: (n, 3) on planes that face
    them; `error`: rms of what is left of the probe's irradiance, relative to its own rms."""

    ambient: Array
    directions: Array
    irradiances: Array
    error: float
    iterations: int


class Probe:
    """The probe's irradiance under radiance maps of one size, and fits to it. Keeps the last fit as the next first guess."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """The next fit starts from the guess alone."""
        self._directions = np.zeros((0, 3))

    def fit(self, radiance: NDArray[np.floating], guess: Guess, count: int | None = None, max_error: float = MAX_ERROR) -> ProbeFit:
        """Fit to a (height, width, 3) radiance map. `guess` gives (n, 3) directions of lights that a detector finds, and is asked
        only when a light is to be added; `count`: number of lights, None for the fewest whose error is below `max_error`."""
        target = probe_irradiance(radiance)
        scale = max(_rms(target), 1e-12)
        problem = _Problem(target / scale, WARM_ITERATIONS if len(self._directions) else MAX_ITERATIONS)
        found = (problem.with_count(self._directions, guess, count) if count is not None
                 else problem.with_fewest(self._directions, guess, max_error))
        self._directions = found.directions
        return ProbeFit(found.colors[0] * (scale / np.pi), found.directions, found.colors[1:] * scale, found.error,
                        problem.iterations)


@dataclass(frozen=True)
class _State:
    """Lights that are being fitted: directions, the colours (ambient first) that are best for them, what is left of the
    probe, and that relative to the probe's rms."""

    directions: Array
    colors: Array
    columns: Array
    left: Array
    error: float


class _Problem:
    """One probe to be explained, scaled to an rms of about 1."""

    def __init__(self, target: Array, most_iterations: int) -> None:
        self._target, self._most_iterations = target, most_iterations
        self._normals = probe_normals()
        self._norm = max(_rms(target), 1e-12)
        self.iterations = 0

    def with_count(self, directions: Array, guess: Guess, count: int) -> _State:
        """The fit with so many lights, from a fit with any number of them."""
        state = self._solved(directions)
        if len(directions) > count:
            strongest = np.sort(np.argsort(-(state.colors[1:] @ WEIGHTS), kind="stable")[:count])
            state = self._solved(directions[strongest])
        while len(state.directions) < count:
            state = self._solved(np.vstack([state.directions, self._next_direction(state, guess)]))
        return self._refined(state)

    def with_fewest(self, directions: Array, guess: Guess, max_error: float) -> _State:
        """From the last number of lights up or down to the fewest that do."""
        state = self.with_count(directions, guess, len(directions))
        while state.error > max_error and len(state.directions) < MAX_LIGHTS:
            state = self.with_count(state.directions, guess, len(state.directions) + 1)
        while state.error < FEWER_BELOW * max_error and len(state.directions):
            fewer = self.with_count(state.directions, guess, len(state.directions) - 1)
            if fewer.error > max_error:
                break
            state = fewer
        return state

    def _next_direction(self, state: _State, guess: Guess) -> Array:
        """Where another light is most wanted: the guess, or else the probe's own normal, that explains the rest best."""
        left = -(state.left @ WEIGHTS)
        far = [one for one in guess() if not len(state.directions) or float((state.directions @ one).max()) < SEPARATE]
        candidates = np.vstack([*far, self._normals[::4]])
        lobes = np.maximum(candidates @ self._normals.T, 0.0)
        gain = (lobes @ left) / np.sqrt((lobes**2).sum(axis=1))
        gain[:len(far)] *= SEEN_BEFORE_CONCLUDED
        return np.asarray(candidates[int(np.argmax(gain))])

    def _solved(self, directions: Array) -> _State:
        """The best colours for these directions: linear least squares, without negative ones."""
        columns = _columns(directions, self._normals)
        gram = columns.T @ columns
        gram.flat[::len(gram) + 1] += 1e-9 * gram[0, 0]
        colors = np.maximum(np.linalg.solve(gram, columns.T @ self._target), 0.0)
        left = columns @ colors - self._target
        return _State(directions, colors, columns, left, _rms(left) / self._norm)

    def _refined(self, state: _State) -> _State:
        """Levenberg-Marquardt over colours and directions together."""
        damping = 1e-3
        for _ in range(self._most_iterations if len(state.directions) else 0):
            self.iterations += 1
            tried = self._step(state, damping)
            if tried.error < state.error:
                done = state.error**2 - tried.error**2 < CONVERGED * state.error**2
                state, damping = tried, max(damping / 5, 1e-9)
                if done:
                    break
            elif damping > 1e2:
                break
            else:
                damping *= 10
        return state

    def _step(self, state: _State, damping: float) -> _State:
        """One damped step of the directions; the colours follow them exactly (variable projection, Golub & Pereyra 1973)."""
        count = len(state.directions)
        tangents = _tangents(state.directions)                          # light, 2, axis
        turned = (self._normals @ tangents.reshape(-1, 3).T) * np.repeat(state.columns[:, 1:] > 0.0, 2, axis=1)
        both = np.hstack([state.columns, turned])
        gram, slope = both.T @ both, both.T @ state.left
        weights = np.repeat(state.colors[1:], 2, axis=0)                # a turn changes irradiance by the light's colour
        linear, mixed = gram[:count + 1, :count + 1].copy(), gram[:count + 1, count + 1:]
        linear.flat[::count + 2] += 1e-9 * linear[0, 0]
        # Schur complement of the colours: their matrix is the same for red, green and blue
        solved = mixed.T @ np.linalg.inv(linear)
        normal = (weights @ weights.T) * (gram[count + 1:, count + 1:] - solved @ mixed)
        right = (weights * (slope[count + 1:] - solved @ slope[:count + 1])).sum(axis=1)
        diagonal = normal.flat[::2 * count + 1]
        normal.flat[::2 * count + 1] += damping * diagonal + 1e-12 * max(float(diagonal.sum()), 1e-200)
        turn = -np.linalg.solve(normal, right).reshape(count, 2)
        turn *= np.minimum(1.0, MAX_TURN / np.maximum(np.hypot(turn[:, :1], turn[:, 1:]), 1e-12))
        moved = state.directions + (turn[:, :, None] * tangents).sum(axis=1)
        return self._solved(moved / np.sqrt((moved**2).sum(axis=1, keepdims=True)))


def _rms(values: Array) -> float:
    flat = values.ravel()
    return float(np.sqrt(flat @ flat / flat.size))


def _columns(directions: Array, normals: Array) -> Array:
    """(facets, 1 + n): irradiance under an ambient of 1 / pi and under each light of 1."""
    columns = np.empty((len(normals), 1 + len(directions)))
    columns[:, 0] = 1.0
    np.maximum(normals @ directions.T, 0.0, out=columns[:, 1:])
    return columns


def _tangents(directions: Array) -> Array:
    """(n, 2, 3) orthonormal vectors across each direction (Duff et al. 2017)."""
    x, y, z = directions.T
    sign = np.copysign(1.0, z)
    a = -1.0 / (sign + z)
    b = x * y * a
    return np.stack([np.stack([1.0 + sign * x * x * a, sign * b, -sign * x], axis=1), np.stack([b, sign + y * y * a, -y], axis=1)],
                    axis=1)


def probe_normals() -> Array:
    """(320, 3) unit centroids of the probe's facets; the second half are those opposite to the first."""
    return _paired(PROBE_SUBDIVISIONS)


def probe_irradiance(radiance: NDArray[np.floating]) -> Array:
    """(height, width, 3) radiance to (320, 3) irradiance of the probe's facets.

    Both spheres are symmetric: max(0, c) = (c + |c|) / 2, so opposite facets share a product, a quarter of the work.
    """
    gather = _gather(*radiance.shape[:2])
    power = np.asarray(gather @ np.ascontiguousarray(radiance, dtype=np.float32).reshape(-1, 3))    # (5120, 3) by facet
    half = len(power) // 2
    even = _absolute_cosines() @ (power[:half] + power[half:])
    odd = _paired(PROBE_SUBDIVISIONS)[:len(even)] @ (_paired(ENVIRONMENT_SUBDIVISIONS).T @ power.astype(np.float64))
    return np.asarray(0.5 * np.concatenate([even + odd, even - odd]), dtype=np.float64)


@lru_cache(maxsize=4)
def _gather(height: int, width: int) -> sparse.csr_array:
    """(5120, texels) solid angle of each texel, in the row of the facet that it lies in."""
    _, facet = cKDTree(_paired(ENVIRONMENT_SUBDIVISIONS)).query(pixel_directions(height, width).reshape(-1, 3))
    weights = np.broadcast_to(solid_angles(height, width), (height, width)).ravel().astype(np.float32)
    shape = (20 * 4**ENVIRONMENT_SUBDIVISIONS, height * width)
    return sparse.csr_array((weights, (facet, np.arange(height * width))), shape=shape)


@lru_cache(maxsize=1)
def _absolute_cosines() -> Array32:
    half = _paired(PROBE_SUBDIVISIONS)[:10 * 4**PROBE_SUBDIVISIONS]
    return np.asarray(np.abs(half @ _paired(ENVIRONMENT_SUBDIVISIONS)[:10 * 4**ENVIRONMENT_SUBDIVISIONS].T), dtype=np.float32)


@lru_cache(maxsize=2)
def _paired(subdivisions: int) -> Array:
    """Unit centroids of an icosphere's facets, ordered so that the one opposite to number i is number i + half of them."""
    centroids = icosphere_centroids(subdivisions)
    first = [index for index, c in enumerate(centroids) if tuple(np.round(c, 9)) > tuple(np.round(-c, 9))]
    return np.concatenate([centroids[first], -centroids[first]])


def icosphere_centroids(subdivisions: int) -> Array:
    """(20 * 4 ** subdivisions, 3) unit centroids of the facets of an icosahedron, each split in four so many times."""
    golden = (1 + np.sqrt(5)) / 2
    corners = np.array([(0, a, b * golden) for a in (-1, 1) for b in (-1, 1)])
    vertices = np.concatenate([np.roll(corners, shift, axis=1) for shift in range(3)]).astype(float)
    edge = 2.0
    distance = np.linalg.norm(vertices[:, None] - vertices[None], axis=2)
    near = np.abs(distance - edge) < 1e-6
    triangles = np.array([(vertices[a], vertices[b], vertices[c]) for a in range(12) for b in range(a + 1, 12)
                          for c in range(b + 1, 12) if near[a, b] and near[b, c] and near[a, c]])
    triangles /= np.linalg.norm(triangles, axis=2, keepdims=True)
    for _ in range(subdivisions):
        a, b, c = triangles[:, 0], triangles[:, 1], triangles[:, 2]
        ab, bc, ca = (m / np.linalg.norm(m, axis=1, keepdims=True) for m in (a + b, b + c, c + a))
        triangles = np.concatenate([np.stack(t, axis=1) for t in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))])
    centroids = triangles.mean(axis=1)
    return np.asarray(centroids / np.linalg.norm(centroids, axis=1, keepdims=True))
