"""The one BRDF: Cook–Torrance with GGX, its importance sampling and its units.

    f = k_d/π + D(α)·G2(α)·F / (4 (n·l)(n·v)),     α = ρ²

D: GGX; G2: height-correlated Smith [Heitz 2014, "Understanding the Masking-Shadowing Function"];
F: Schlick with f0 = k_s. Nothing is reflected below the shading normal's horizon; that the table
hides what lies below z = 0 is the renderer's concern.

Directions are unit ``Array3f`` (or any Dr.Jit 3-vector, of any precision) in the shading frame,
whose z axis is the normal; l points to the light, v to the viewer. Every function is generic in
the Dr.Jit type, so that the float64 checks and the Mitsuba plugin run these very lines.
"""

from __future__ import annotations

from typing import Any

from invrender.render.backend import dr

MIN_VIEW = 1e-4  # the least n·v: normals that face away from the viewer are seen at this angle


def frame(n: Any) -> tuple[Any, Any]:
    """Tangents s, t such that (s, t, n) is orthonormal and right-handed, smooth for n_z > -1.

    Duff et al. 2017, "Building an Orthonormal Basis, Revisited", for the upper hemisphere.
    """
    vector = type(n)
    a = -1 / (1 + n.z)
    b = n.x * n.y * a
    return vector(1 + n.x * n.x * a, b, -n.x), vector(b, 1 + n.y * n.y * a, -n.y)


def to_local(d: Any, s: Any, t: Any, n: Any) -> Any:
    """World direction to the frame (s, t, n)."""
    return type(d)(dr.dot(d, s), dr.dot(d, t), dr.dot(d, n))


def to_viewer(d: Any, s: Any, t: Any, n: Any) -> Any:
    """`to_local` for the direction to the viewer: a normal that faces away shows its horizon."""
    v = to_local(d, s, t, n)
    return dr.normalize(type(d)(v.x, v.y, dr.maximum(v.z, MIN_VIEW)))


def to_world(d: Any, s: Any, t: Any, n: Any) -> Any:
    """Direction in the frame (s, t, n) to the world."""
    return dr.fma(s, d.x, dr.fma(t, d.y, n * d.z))


def ggx_d(h: Any, alpha: Any) -> Any:
    """GGX normal distribution, 1/sr. Exact for the smallest α: no 1 - cos² cancellation."""
    a2 = alpha * alpha
    e = dr.fma(a2, h.z * h.z, h.x * h.x + h.y * h.y)
    return a2 / (dr.pi * e * e)


def schlick(v_dot_h: Any) -> Any:
    """Schlick's weight (1 - v·h)⁵: F = k_s + (1 - k_s)·weight, affine in k_s."""
    x = dr.maximum(1 - v_dot_h, 0)
    x2 = x * x
    return x2 * x2 * x


def specular(l: Any, v: Any, alpha: Any) -> tuple[Any, Any]:
    """D·G2/(4 n·l n·v)·(n·l) and Schlick's weight at (l, v): the specular lobe times cosine is

        value · (k_s + (1 - k_s)·weight).

    Zero where l or v is below the horizon.
    """
    h = dr.normalize(l + v)
    up = (l.z > 0) & (v.z > 0)
    lz, vz = dr.select(up, l.z, 1), dr.select(up, v.z, 1)
    # G2 / (4 n·l n·v) = 1 / (2 (n·v √(α² + (1-α²)(n·l)²) + n·l √(…)))
    a2 = alpha * alpha
    root_l = dr.sqrt(dr.fma(a2, l.x * l.x + l.y * l.y, lz * lz))
    root_v = dr.sqrt(dr.fma(a2, v.x * v.x + v.y * v.y, vz * vz))
    visibility = 1 / (2 * dr.fma(vz, root_l, lz * root_v))
    value = ggx_d(h, alpha) * visibility * lz
    return dr.select(up, value, 0), schlick(dr.dot(v, h))


def sample_vndf(v: Any, alpha: Any, u1: Any, u2: Any) -> Any:
    """A half vector from the GGX distribution of normals visible from v.

    Dupuy and Benyoub 2023, "Sampling Visible GGX Normals with Spherical Caps". Smooth in v and α.
    """
    vector = type(v)
    w = dr.normalize(vector(alpha * v.x, alpha * v.y, v.z))
    sin_phi, cos_phi = dr.sincos(2 * dr.pi * u1)
    z = dr.fma(1 - u2, 1 + w.z, -w.z)
    r = dr.safe_sqrt(dr.fma(-z, z, 1))
    h = vector(dr.fma(r, cos_phi, w.x), dr.fma(r, sin_phi, w.y), z + w.z)
    return dr.normalize(vector(alpha * h.x, alpha * h.y, h.z))


def pdf_vndf(l: Any, v: Any, alpha: Any) -> Any:
    """Density over directions l of reflecting v about a `sample_vndf` half vector, 1/sr."""
    h = dr.normalize(l + v)
    up = (l.z > 0) & (v.z > 0)
    vz = dr.select(up, v.z, 1)
    root_v = dr.sqrt(dr.fma(alpha * alpha, v.x * v.x + v.y * v.y, vz * vz))
    # G1(v) D / (4 n·v), with G1 = 2 n·v / (n·v + √(α² sin² + cos²))
    return dr.select(up, ggx_d(h, alpha) / (2 * (vz + root_v)), 0)


def sample_cosine(u1: Any, u2: Any, vector: type) -> Any:
    """A direction with density (n·l)/π."""
    sin_phi, cos_phi = dr.sincos(2 * dr.pi * u1)
    r = dr.sqrt(u2)
    return vector(r * cos_phi, r * sin_phi, dr.safe_sqrt(1 - u2))
