"""The fast estimator: few filtered samples, no noise in the diffuse term.

Diffuse light comes from tables of irradiance; specular light from visible-normal samples whose
look-ups are filtered to each sample's share of the lobe; lamps are summed one by one. The screen's
edge is as soft as the sample's footprint, so that pose and maps have gradients without edges. The
bias is that of the footprints and falls as samples grow.
"""

from __future__ import annotations

from typing import Any

from invrender.render import brdf
from invrender.render.backend import dr, vector, while_loop
from invrender.render.fast.irradiance import screen_cell
from invrender.render.fast.lamps import LAMP_SIDES, MAX_HOT
from invrender.render.fast.pyramid import disc_direction
from invrender.render.fast.specular import Sample, reflected, reflected_rows, sample_lobe
from invrender.render.fast.tables import Tables, fast_tables
from invrender.render.renderer import Renderer
from invrender.render.scene import Scene, ScreenFrame, View, screen_frame
from invrender.render.shading import Shading, Sums, with_tangents

LAMP_SAMPLES = 256  # at least so many where a narrow lobe meets a lamp
STEEP_SIDE = 16  # screen cells a side where a normal's horizon cuts the screen


class Fast(Renderer):
    """The fast estimator, prepared for a scene: nearly without noise, with a small bias.

    detail: a power of two that multiplies the sizes of its tables; with the samples it takes the
    bias to zero. Gradients pass through the tables to the lights and the pose.
    """

    def __init__(self, scene: Scene, detail: int = 1) -> None:
        super().__init__(scene)
        self.tables = fast_tables(scene, detail)

    @property
    def traced(self) -> tuple[Any, ...]:
        return (self.tables,)

    def _shade(
        self, view: View, roughness: Any, normal: Any, samples: int, jacobian: bool
    ) -> Shading:
        return shade_fast(self.tables, view, roughness, normal, samples, jacobian)


def shade_fast(
    tables: Tables, view: View, rho: Any, normal: Any, samples: int, jacobian: bool = False
) -> Shading:
    """The fast estimator. normal: unit. samples: of the specular lobe, any number without
    recompiling."""
    scene = tables.scene
    scalar = scene.scalar
    uint, vec3 = dr.uint32_array_t(scalar), vector(scalar, 3)
    width = max(dr.width(view.x), dr.width(rho), dr.width(normal))
    sums = Sums(vec3, width, jacobian)
    screen = screen_frame(scene, view.x) if tables.screen is not None else None
    sums.add(sums.derive(lambda _, n: (_smooth_irradiance(tables, view, n),), rho, normal), (0,))
    if screen is not None:
        side = STEEP_SIDE * tables.detail
        cells = dr.select(_is_steep(scene, view, normal), uint(side * side), uint(0))

        def steep(i: Any) -> list[list[Any]]:
            d, omega, light = screen_cell(scene, tables.screen, tables.sky, view.x, i, side)
            return _along_normal(sums, normal, light * omega, d, -1)

        sums.run(dr.detach(cells), steep, (0,), "steep")

    n_samples = dr.opaque(uint, samples)
    inv_n = 1 / scalar(n_samples)
    if tables.screen is not None or tables.sky is not None:

        def specular(i: Any) -> list[list[Any]]:
            f = lambda r, n: sample_lobe(tables, screen, view, i, inv_n, r * r, n).flat()  # noqa: E731
            if not jacobian:
                return [reflected(tables, Sample.of(tables, f(rho, normal)))]
            values, tangents = with_tangents(f, rho, normal)
            return reflected_rows(
                tables, Sample.of(tables, values), [Sample.of(tables, t) for t in tangents]
            )

        sums.run(n_samples, specular, (1, 2), "specular", inv_n)
    if tables.lamps is not None:
        most = dr.maximum(n_samples, LAMP_SAMPLES)
        _add_lamps(sums, tables, screen, view, rho, normal, most)
    shading = sums.shading()
    # The sky behind the screen is subtracted: where that is nearly all of it, rounding may show.
    shading.irradiance = dr.maximum(shading.irradiance, 0)
    return shading


def _along_normal(sums: Sums, n: Any, light: Any, d: Any, sign: int = 1) -> list[list[Any]]:
    """Rows of light · max(±n·d, 0)."""
    cos = sign * dr.dot(n, d)
    rows = [light * dr.maximum(cos, 0)]
    if sums.jacobian:
        s, t = brdf.frame(n)
        light = light * dr.select(cos > 0, type(cos)(sign), 0)
        rows += [type(light)(0), light * dr.dot(s, d), light * dr.dot(t, d)]
    return [[r] for r in rows]


def _add_lamps(
    sums: Sums,
    tables: Tables,
    screen: ScreenFrame | None,
    view: View,
    rho: Any,
    normal: Any,
    samples: Any,
) -> None:
    """Lamps one by one, by Gauss's rule or, close to a narrow lobe's core, by its samples."""
    lamps = tables.lamps
    assert lamps is not None
    uint = type(samples)
    word = dr.uint64_array_t(uint)
    count = dr.opaque(uint, lamps.count)
    alpha, core, viewer = dr.detach((rho * rho, normal, view.to_camera))
    side_of = lambda lamp: lamps.points_a_side(lamp, viewer, core, alpha, samples)  # noqa: E731

    def irradiance(i: Any) -> list[list[Any]]:
        d, light = lamps.at(screen, i)
        return _along_normal(sums, normal, light, d)

    sums.run(count, irradiance, (0,), "lamp irradiance")

    points = LAMP_SIDES**2

    def lobe(i: Any) -> list[list[Any]]:
        lamp = i // points
        side = side_of(lamp)
        d, light = lamps.at(screen, lamp, i - lamp * points, dr.maximum(side, 1))
        light = dr.select(side > 0, light, 0)
        rows = sums.derive(lambda r, n: _lobe(view, r * r, n, d), rho, normal)
        return [[light * x for x in row] for row in rows]

    def next_point(i: Any) -> Any:
        lamp = i // points
        last = i - lamp * points + 1 >= dr.square(side_of(lamp))
        return dr.select(last, (lamp + 1) * points, i + 1)

    sums.run(count * points, lobe, (1, 2), "lamp lobes", following=next_point)

    # The lamps that are left to samples, a bit each.
    def mark(lamp: Any, near: Any) -> tuple[Any, Any]:
        bit = word(1) << word(lamp)
        return lamp + 1, near | dr.select(side_of(lamp) == 0, bit, 0)

    narrow = dr.select(lamps.may_need_samples(alpha, samples), count, 0)
    _, near = while_loop(
        (dr.zeros(uint, sums.width), dr.zeros(word, sums.width)),
        lambda lamp, _: lamp < narrow,
        mark,
        label="lamps in the lobe's core",
    )
    _add_lamp_images(sums, tables, screen, view, rho, normal, samples, near)


def _add_lamp_images(
    sums: Sums,
    tables: Tables,
    screen: ScreenFrame | None,
    view: View,
    rho: Any,
    normal: Any,
    samples: Any,
    near: Any,
) -> None:
    """Lamps as the lobe's samples meet them; near: a 64-bit word whose bits tell which lamps."""
    lamps = tables.lamps
    assert lamps is not None
    uint, word = type(samples), type(near)
    inv_n = 1 / tables.scene.scalar(samples)

    def lamp_after(lamp: Any) -> Any:
        """The next marked lamp from this one on, 64 if there is none."""
        return uint(dr.tzcnt(dr.select(lamp < MAX_HOT, near & ~((word(1) << word(lamp)) - 1), 0)))

    def image(i: Any) -> list[list[Any]]:
        lamp = i // samples

        def terms(r: Any, n: Any) -> tuple[Any, Any]:
            sample = sample_lobe(tables, screen, view, i - lamp * samples, inv_n, r * r, n)
            x, y, _ = sample.sky
            d = disc_direction(2 * x - 1, 1 - 2 * y, type(normal))
            light = lamps.tent(lamp, d) * dr.select(d.z > 0, sample.weight, 0)
            if tables.screen is not None and lamps.open < lamps.count:
                light = light * (1 - tables.screen(*sample.screen).w)
            return light * (1 - sample.fresnel), light * sample.fresnel

        return sums.derive(terms, rho, normal)

    def next_sample(i: Any) -> Any:
        lamp = i // samples
        last = i - lamp * samples + 1 >= samples
        return dr.select(last, lamp_after(lamp + 1) * samples, i + 1)

    first, stop = lamp_after(uint(0)) * samples, MAX_HOT * samples
    sums.run(stop, image, (1, 2), "lamp images", inv_n, next_sample, first)


def _lobe(view: View, alpha: Any, n: Any, d: Any) -> tuple[Any, Any]:
    """Factors of B and A of light from direction d."""
    s, t = brdf.frame(n)
    local = brdf.to_local(d, s, t, n)
    value, fresnel = brdf.specular(local, brdf.to_viewer(view.to_camera, s, t, n), alpha)
    return value * (1 - fresnel), value * fresnel


def _smooth_irradiance(tables: Tables, view: View, n: Any) -> Any:
    """Irradiance E without lamps for a screen wholly above the normal's horizon."""
    total = vector(tables.scene.scalar, 3)(0)
    if tables.sky_irradiance is not None:
        total = total + tables.sky_irradiance(n)
    if tables.vector_irradiance is not None:
        a, b, c = tables.vector_irradiance(view.x)
        total = total + a * n.x + b * n.y + c * n.z
    return total


def _is_steep(scene: Scene, view: View, n: Any) -> Any:
    """Whether the normal's horizon cuts the screen: then one of its corners is below."""
    lowest = dr.dot(scene.corner - view.x, n)
    sx, sy = dr.dot(scene.edge_x, n), dr.dot(scene.edge_y, n)
    return lowest + dr.minimum(sx, 0) + dr.minimum(sy, 0) < 0
