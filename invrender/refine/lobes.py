"""The specular lobe of each material of a sample, from all of its pixels at once.

For a flat sample of one material the photo is I_c = k_d,c·E_c/π + k_s,c·B_c(ρ) + A_c(ρ): linear in
the albedos once ρ is given. The pattern makes E, B and A differ from place to place and colour to
colour, so many pixels together tell the lobe that one cannot: the roughness that leaves the least,
of a list, and its k_s by least squares. First for the sample as a whole, then for each group of
pixels of like albedo. Relief widens the lobe that is found.

Whether a material is bare metal is often a close call: `read_lobes` also gives what the photo says
of either case (`invrender.refine.evidence`), which the networks weigh.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter

from invrender.colour import AXES
from invrender.maps import Maps
from invrender.refine.evidence import MaterialEvidence, compress
from invrender.refine.flat import USUAL_ROUGHNESS, USUAL_SPECULAR, diffuse_rest, plane_terms
from invrender.refine.groups import group
from invrender.render.renderer import Renderer
from invrender.sampling import centres, resize
from invrender.types import TINY, Array

Labels = NDArray[np.intp]
ROUGHNESS = np.array([0.05, 0.1, 0.16, 0.23, 0.32, 0.42, 0.55, 0.7, 0.85, 1.0])
SPREAD = 0.25  # of ρ around its usual value
SPREAD_F0 = (0.005, 0.1)  # of k_s: a lobe as usual, or any
UNUSUAL = 3.0  # by how much -2 log-likelihood must fall for another than a lobe as usual
LEAST_F0 = 0.02  # of common materials
BRIGHTEST = 4.0  # k_d: a white sample under lights told too dark is no metal
METAL = 0.2  # f0 from which a material may be bare metal
FIT_SIZE = 128  # pixels a side of the fit: what decides is as wide as the pattern's features
SMOOTH, GRID = 0.15, 64  # from this ρ on, E, B and A are interpolated from so many pixels a side
MEASUREMENTS = 100.0  # that a photo's worth of pixels counts for: texture repeats
MATERIALS, ROUNDS = 4, 4
LITTLE = 0.3  # of B's mean
# Of an albedo's texture: the albedo that counts as black, the variance in an octave that counts as
# none, how many measurements an octave counts for, and how much its volume counts.
BLACK, EVEN, MEASURED, VOLUME = 0.02, 0.003, 4, 0.85
WHITER, TOO_WHITE, IMPLAUSIBLE = 1.5, 0.3, 20.0  # albedos, share of pixels, and the cost of those


@dataclass(frozen=True)
class Lobe:
    """Index into `ROUGHNESS`, f0 (3,) and mean diffuse albedo (3,), which is nought for metal."""

    rho: int
    f0: Array
    albedo: Array

    def diffuse(self, photo: Array, terms: Any) -> Array:
        """What the lobe leaves of the photo, as diffuse albedo."""
        return diffuse_rest(photo, terms, self.f0) * np.float32(self.albedo.any())

    def mirror(self, photo: Array, terms: Any) -> Array:
        """f0 (H, W, 3) of metal, pixel by pixel; the material's where it mirrors little."""
        _, b, a = terms
        usual = np.float32(LITTLE) * b.mean((0, 1))
        f0 = np.float32(self.f0)
        return np.clip((photo - a + usual * f0) / (b + usual + np.float32(1e-20)), 0, 1)

    def misfit(self, photo: Array, terms: Any, weight: Array) -> Array:
        """Squared residual (H, W) of the photo if all of it were this material."""
        e, b, a = terms
        rest = photo - self.albedo * e / np.pi - self.f0 * b - a
        return ((weight * rest) ** 2).sum(-1)


@dataclass(frozen=True)
class Lobes:
    """What a fit finds of a sample: ``maps``, those of each group's likeliest lobe; and, whichever
    case is likelier, what the photo says of dielectric and of metal."""

    maps: Maps
    evidence: MaterialEvidence


def lobe_terms(renderer: Renderer, height: int, width: int, samples: int = 64) -> list[list[Array]]:
    """E, B and A of a photo's pixels as it is fitted, for each of `ROUGHNESS`."""
    h, w = min(FIT_SIZE, height), min(FIT_SIZE, width)
    return [_terms(renderer, h, w, float(rho), samples) for rho in ROUGHNESS]


def fit_lobes(photo: Array, renderer: Renderer, samples: int = 64) -> Maps:
    """Maps of a flat sample with up to `MATERIALS` lobes for a photo (H, W, 3), linear radiance."""
    terms = lobe_terms(renderer, photo.shape[0], photo.shape[1], samples)
    lobes = _search(_small(photo), terms)[2]
    return _maps(photo, lobes, _full_terms(photo, renderer, samples, terms, lobes))[0]


def read_lobes(
    photo: Array,
    renderer: Renderer,
    samples: int = 64,
    terms: list[list[Array]] | None = None,
) -> Lobes:
    """`fit_lobes`, and what else the fit tells.

    terms: `lobe_terms` of these lights, where several photos are taken under them.
    """
    terms = terms or lobe_terms(renderer, photo.shape[0], photo.shape[1], samples)
    small = _small(photo)
    moments, label, lobes = _search(small, terms)
    either = [_either(moments, label == k) for k in range(len(lobes))]
    every = [*lobes, *(f for e in either for f in e.lobes)]
    full = _full_terms(photo, renderer, samples, terms, every)
    maps, label = _maps(photo, lobes, full)
    sample, texture = _either(moments, np.ones(small.shape[:2], bool)), _by_texture(small, terms)
    return Lobes(maps, _evidence(photo, full, label, either, sample, texture))


def _small(photo: Array) -> Array:
    """The pixels of a photo that its lobes are fitted to."""
    rows, columns = (centres(min(FIT_SIZE, n), n) for n in photo.shape[:2])
    return photo[np.ix_(rows, columns)]


def _search(photo: Array, terms: list[list[Array]]) -> tuple[Array, Labels, list[Lobe]]:
    """The moments of a photo's pixels, the group of each (h, w), and each group's lobe."""
    h, w = photo.shape[:2]
    rho = int(np.abs(ROUGHNESS - USUAL_ROUGHNESS).argmin())
    usual = Lobe(rho, np.full(3, USUAL_SPECULAR), np.ones(3))
    moments = _moments(photo, terms)
    whole = _fit(moments, np.ones((h, w), bool), usual)
    # Groups of like albedo first; then each pixel joins the material that explains it best, with
    # its neighbours.
    label = _group(whole.diffuse(photo, terms[whole.rho]))
    for _ in range(ROUNDS):
        lobes = [_fit(moments, label == k, whole) for k in range(int(label.max()) + 1)]
        label = _closest(photo, [terms[f.rho] for f in lobes], lobes)
        label = np.unique(label, return_inverse=True)[1].reshape(h, w)
    return moments, label, [_fit(moments, label == k, whole) for k in range(int(label.max()) + 1)]


def _full_terms(
    photo: Array, renderer: Renderer, samples: int, terms: list[list[Array]],
    lobes: list[Lobe],
) -> dict[int, list[Array]]:  # fmt: skip
    """E, B and A of all of a photo's pixels, by the lobes' ρ."""
    height, width = photo.shape[:2]
    return {
        rho: terms[rho] if terms[rho][0].shape == photo.shape
        else _terms(renderer, height, width, float(ROUGHNESS[rho]), samples)
        for rho in {f.rho for f in lobes}
    }  # fmt: skip


def _maps(photo: Array, lobes: list[Lobe], terms: dict[int, list[Array]]) -> tuple[Maps, Labels]:
    """Each pixel chooses among the lobes anew: the maps, and which lobe it has (H, W)."""
    label = _closest(photo, [terms[f.rho] for f in lobes], lobes)
    normal = np.zeros(photo.shape, np.float32)
    normal[..., 2] = 1
    maps = Maps(
        _select(label, [f.diffuse(photo, terms[f.rho]) for f in lobes]),
        np.array([f.f0 for f in lobes], np.float32)[label],
        ROUGHNESS[[f.rho for f in lobes]].astype(np.float32)[label],
        normal,
    )
    return maps, label


def _evidence(
    photo: Array, terms: dict[int, list[Array]], label: Labels, either: list[_Either],
    sample: _Either, texture: Array,
) -> MaterialEvidence:  # fmt: skip
    """Of a photo whose pixels belong to the groups ``label``, each with its two fits ``either``;
    the ``sample`` fitted as one material; costs by ``texture``."""
    dielectric, metal = zip(*(e.lobes for e in either), strict=True)
    weight = np.exp((texture.min(1, keepdims=True) - texture) / 2)
    mean_roughness = weight @ ROUGHNESS / weight.sum(1)
    everywhere = lambda x: np.broadcast_to(np.float32(x), label.shape)  # noqa: E731
    by_group = lambda x: np.asarray(x, np.float32)[label]  # noqa: E731
    return MaterialEvidence(
        dielectric_diffuse=_select(label, [f.diffuse(photo, terms[f.rho]) for f in dielectric]),
        dielectric_roughness=by_group(ROUGHNESS[[f.rho for f in dielectric]]),
        metal_specular=_select(label, [f.mirror(photo, terms[f.rho]) for f in metal]),
        metal_roughness=by_group(ROUGHNESS[[f.rho for f in metal]]),
        material_odds=by_group(compress(np.array([e.odds for e in either]))),
        sample_odds=everywhere(compress(np.asarray(sample.odds))),
        texture_odds=everywhere(compress(texture[0].min() - texture[1].min())),
        dielectric_texture_roughness=everywhere(mean_roughness[0]),
        metal_texture_roughness=everywhere(mean_roughness[1]),
        metal_material_specular=by_group([f.f0 for f in metal]),
        residual_costs=np.float32(compress(sample.costs - sample.costs.min())),
        texture_costs=np.float32(compress(texture - texture.min())),
    )


def _terms(renderer: Renderer, height: int, width: int, rho: float, samples: int) -> list[Array]:
    """`plane_terms`, for wide lobes from a coarse grid."""
    h, w = (height, width) if rho < SMOOTH else (min(GRID, height), min(GRID, width))
    return [resize(x, height, width) for x in plane_terms(renderer, h, w, rho, samples)]


def _closest(photo: Array, terms: list[Any], lobes: list[Lobe]) -> Labels:
    """Which lobe explains each pixel and its neighbours best."""
    weight = _weight(photo, photo)
    misfit = [f.misfit(photo, t, weight) for f, t in zip(lobes, terms, strict=True)]
    return np.argmin([uniform_filter(m, 3) for m in misfit], 0)


def _select(label: Labels, images: list[Array]) -> Array:
    """The pixels of the image that each label names."""
    out = images[0].copy()
    for k, image in enumerate(images[1:], 1):
        out[label == k] = image[label == k]
    return out


def _group(albedo: Array) -> Labels:
    """Labels (H, W) of pixels of like albedo, by its square root."""
    points = np.sqrt(albedo.reshape(-1, 3)).astype(np.float64)
    if len(np.unique(points.round(3), axis=0)) < 10 * MATERIALS:
        return np.zeros(albedo.shape[:2], np.intp)
    return group(points, MATERIALS)[1].reshape(albedo.shape[:2])


def _moments(photo: Array, terms: list[Any]) -> Array:
    """Weighted products xx, xy, yy, xz, yz, zz of x = E/π, y = B and z = photo - A.

    For each ρ of the list, colour and pixel: (ρ, 3, 6, H·W). Their means are all that least squares
    of any group of pixels needs.
    """
    weight = _weight(photo, photo).astype(np.float64)
    out = np.empty((len(terms), 3, 6, photo[..., 0].size))
    for i, (e, b, a) in enumerate(terms):
        x, y, z = (np.moveaxis(weight * v, -1, 0).reshape(3, -1) for v in (e / np.pi, b, photo - a))
        for k, product in enumerate((x * x, x * y, y * y, x * z, y * z, z * z)):
            out[i, :, k] = product
    return out


def _fits(
    moments: Array, of: NDArray[np.bool_], usual: Array, spreads: tuple[float, ...]
) -> tuple[Array, Array, Array]:
    """f0, albedo (case, ρ, 3) and -2 log-likelihood (case, ρ) of the pixels ``of``: with f0 within
    each of the spreads around the usual one, and as bare metal."""
    measurements = MEASUREMENTS * float(of.mean())
    mean = np.moveaxis(moments @ (of.ravel() / of.sum()), -1, 0)  # (6, ρ, 3)
    variance = _least_squares(mean, 0.0, usual)[2]
    metal = mean * np.array([0, 0, 1, 0, 1, 1])[:, None, None]
    fits = [_least_squares(mean, variance / measurements / s**2, usual) for s in spreads]
    fits.append(_least_squares(metal, 0.0, usual))
    f0, albedo, residual = (np.stack(x) for x in zip(*fits, strict=True))
    return f0, albedo, measurements * np.log(residual.mean(-1) + 1e-9)


def _fit(moments: Array, of: NDArray[np.bool_], usual: Lobe) -> Lobe:
    """The lobe of the pixels ``of``: as usual, of another f0, or bare metal."""
    f0, albedo, cost = _fits(moments, of, usual.f0, SPREAD_F0)
    cost += ((ROUGHNESS - ROUGHNESS[usual.rho]) / SPREAD) ** 2
    cost[1:] += UNUSUAL
    cost[2, f0[2].mean(-1) < METAL] = np.inf
    k, rho = (int(i) for i in np.unravel_index(np.argmin(cost), cost.shape))
    return Lobe(rho, f0[k, rho], albedo[k, rho] if k < 2 else np.zeros(3))


@dataclass(frozen=True)
class _Either:
    """Pixels as a usual dielectric and as bare metal: the lobes, and -2 log-likelihoods (2, ρ)."""

    lobes: tuple[Lobe, Lobe]
    costs: Array

    @property
    def odds(self) -> float:
        """How much likelier metal is."""
        return float(self.costs[0].min() - self.costs[1].min())


def _either(moments: Array, of: NDArray[np.bool_]) -> _Either:
    """The pixels ``of`` in either case."""
    f0, _, costs = _fits(moments, of, np.full(3, USUAL_SPECULAR), SPREAD_F0[:1])
    costs += _UNLIKELY
    i, j = (int(k) for k in costs.argmin(1))
    return _Either((Lobe(i, f0[0, i], np.ones(3)), Lobe(j, f0[1, j], np.zeros(3))), costs)


def _by_texture(photo: Array, terms: list[list[Array]]) -> Array:
    """-2 log-likelihood (2, ρ) of either case by the sample's texture: a wrong lobe leaves the
    light's pattern in the albedo that is derived with it."""
    size = max(4, 1 << max(min(photo.shape[:2]).bit_length() - 3, 0))
    small = resize(photo, size, size)
    lit = [[resize(x, size, size) for x in t] for t in terms]
    costs = [[_plainness(small, e, b, a, metal) for e, b, a in lit] for metal in (False, True)]
    return np.array(costs) + _UNLIKELY / 4


def _plainness(photo: Array, e: Array, b: Array, a: Array, metal: bool) -> float:
    """-2 log-likelihood of a photo (n, n, 3) whose texture is a Gaussian of the logarithm of k_d,
    or of k_s for ``metal``, with a variance of its own for each octave and colour axis."""
    by = np.maximum(b, 0.02 * b.mean()) + 1e-20 if metal else e / np.pi + 1e-20
    albedo = (photo - a - (0 if metal else USUAL_SPECULAR) * b) / by
    log = np.log(np.maximum(albedo, 0) + BLACK)
    volume = float((log + np.log(by)).mean((0, 1)).sum())  # of the photo over that of the texture
    log, cost = log @ AXES, 0.0
    while len(log) > 2:
        coarse = log.reshape(len(log) // 2, 2, len(log) // 2, 2, 3).mean((1, 3))
        detail = log - np.repeat(np.repeat(coarse, 2, 0), 2, 1)
        spread = float(np.log((detail**2).mean((0, 1)) + EVEN).sum())
        cost += MEASURED * (spread / 2 + VOLUME * volume)
        log = coarse
    return cost + IMPLAUSIBLE * ((albedo > WHITER).any(-1).mean() > TOO_WHITE)


def _weight(photo: Array, pixels: Array) -> Array:
    """Inverse standard deviation of pixels relative to the photo's mean: shot noise and floor."""
    level = photo.mean((0, 1)) + TINY
    return 1 / np.sqrt(level * (pixels + 0.1 * level))


def _least_squares(moments: Array, pull: Any, usual: Array) -> tuple[Array, Array, Array]:
    """k_s ≥ `LEAST_F0`, k_d ≤ `BRIGHTEST` of z ≈ k_d·x + k_s·y, and their mean squared residual.

    moments: the means of xx, xy, yy, xz, yz and zz. pull: weight of (k_s - usual)². Any shapes that
    broadcast.
    """
    xx, xy, yy, xz, yz, zz = moments
    x2, y2, y1 = xx + 1e-20, yy + pull + 1e-20, yz + pull * usual
    k_d = np.clip((y2 * xz - xy * y1) / np.maximum(x2 * y2 - xy * xy, 1e-30), 0, BRIGHTEST)
    k_s = np.clip((y1 - xy * k_d) / y2, LEAST_F0, 1)
    k_d = np.clip((xz - xy * k_s) / x2, 0, BRIGHTEST)
    rest = zz - 2 * k_d * xz - 2 * k_s * yz
    rest += k_d * k_d * xx + 2 * k_d * k_s * xy + k_s * k_s * yy
    return k_s, k_d, np.maximum(rest, 0.0)


_UNLIKELY = ((ROUGHNESS - USUAL_ROUGHNESS) / SPREAD) ** 2  # -2 log prior of each of the list
