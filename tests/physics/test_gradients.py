"""Derivatives against central differences in float64, on random and extreme configurations."""

from dataclasses import replace

import numpy as np
import pytest
from forward_scenes import (
    ESTIMATORS,
    configuration_view,
    extreme_configurations,
    some_environment,
    some_pattern,
)

from invrender.lights import Device
from invrender.maps import constant_maps
from invrender.render import brdf
from invrender.render.backend import Float, ad, dr, vector
from invrender.render.fast.estimator import Fast
from invrender.render.mis import Mis, shade_mis
from invrender.render.renderer import Material, _compose
from invrender.render.scene import make_scene, make_view
from invrender.rig import Rig

Float64 = ad.Float64
N = 2048
LIGHTS = {
    "both": (some_pattern(), some_environment()),
    "screen": (some_pattern(), None),
    "environment": (None, some_environment()),
    "smooth": (some_pattern(), some_environment(sun=0, lamps=0)),
}
LIGHTS |= {"display": LIGHTS["both"], "smooth display": LIGHTS["smooth"]}
WIDE = Rig(screen_size=(0.228, 0.16), screen_bezel=0.01, camera_height=0.17)


def a_scene(lights, scalar=Float64, rig=None):
    """Lights of that name; those of a display dim to the sides and have a bezel."""
    pattern, environment = LIGHTS[lights]
    real = "display" in lights
    device = Device(falloff=0.8) if real else Device()
    rig = rig or (WIDE if real else Rig())
    return make_scene(rig, pattern, environment, (4.0, 3.0, 5.0), 1.3, scalar, device)


def numpy(array):
    return np.array(array, np.float64)


def central(f, h):
    """Fourth-order central difference of f, whose steps are scaled by the array h."""
    a, b = f(h) - f(-h), f(2 * h) - f(-2 * h)
    return (8 * a - b) / (12 * h)


def worst(found, expected, scale, report, where):
    """Largest error relative to |expected| + scale; printed with the configuration it is at."""
    error = np.abs(found - expected) / (np.abs(expected) + scale)
    assert np.all(np.isfinite(error)), f"{where}: not finite"
    i = np.unravel_index(np.argmax(error), error.shape)
    report.append(
        f"{where}: worst {error[i]:.1e} (derivative {expected[i]:.3e}) at configuration {i[-1]}, "
        f"99th percentile {np.percentile(error, 99):.1e}"
    )
    return error


def shading_of(estimator, renderer, view, rho, n, samples, at):
    """Shading with mis's directions held where the configuration has them."""
    if estimator == "fast":
        return renderer.shade(view, rho, n, samples)
    return shade_mis(renderer.scene, renderer.sampler, view, rho, n, samples, proposal=at)


SLOW = pytest.mark.slow  # more kernels to compile, no more code to cover
CASES = [
    ("fast", "both"),
    ("mis", "both"),
    ("fast", "display"),
    pytest.param("mis", "display", marks=SLOW),
    pytest.param("fast", "environment", marks=SLOW),
    pytest.param("fast", "screen", marks=SLOW),
    pytest.param("mis", "screen", marks=SLOW),
    pytest.param("mis", "environment", marks=SLOW),
]


@pytest.mark.parametrize("estimator, lights", CASES)
def test_map_derivatives(estimator, lights, capsys):
    """pixel_jacobian, forward and reverse mode agree with differences on 2,048 configurations.

    The fast estimator is piecewise smooth: a step may cross a kink between texels or levels, so a
    share of 0.2% of the configurations may disagree by more than 1e-5; mis must agree everywhere.
    """
    scene = a_scene(lights)
    renderer = ESTIMATORS[estimator](scene)
    view, m = configuration_view(scene, extreme_configurations(N, seed=7))
    samples = 16
    j = renderer.pixel_jacobian(view, m, samples)
    s, t = brdf.frame(m.normal)
    at = (m.roughness, m.normal)

    def image(rho, n):
        shading = shading_of(estimator, renderer, view, rho, n, samples, at)
        return numpy(_compose(m.diffuse, m.specular, shading))

    rho = numpy(m.roughness)
    step = 2e-6 * rho
    narrow = 3e-6 * rho * rho  # a normal moves the lobe by the angle that α sets

    def moved(axis):
        """The image with ρ or the normal moved; one kernel for all three."""

        def f(h):
            steps = [Float64(h * (k == axis)) for k in range(3)]
            dr.make_opaque(steps)
            turned = dr.normalize(m.normal + s * steps[1] + t * steps[2])
            return image(m.roughness + steps[0], turned)

        return f

    expected = {
        "roughness": central(moved(0), step),
        "tangent_s": central(moved(1), narrow),
        "tangent_t": central(moved(2), narrow),
    }
    value = numpy(j.radiance)
    lines: list[str] = []
    scales = {"roughness": value / rho, "tangent_s": value / rho**2, "tangent_t": value / rho**2}
    for name, fd in expected.items():
        found = numpy(getattr(j, name))
        error = worst(found, fd, 1e-2 * scales[name] + 1e-6, lines, f"{estimator} {lights} {name}")
        bad = np.mean(error.max(0) > 1e-5)
        assert bad <= (0.002 if estimator == "fast" else 0), lines[-1]
    # Affine in the albedos: the difference quotient is exact.
    for name in ("diffuse", "specular"):
        other = replace(m, **{name: getattr(m, name) + 0.5})
        quotient = (numpy(renderer.radiance(view, other, samples)) - value) / 0.5
        found = numpy(getattr(j, name))
        assert np.allclose(found, quotient, rtol=1e-9, atol=1e-9 * value.max())

    # Reverse and forward mode of `radiance` are this Jacobian, applied.
    rng = np.random.default_rng(0)
    weights = vector(Float64, 3)(rng.standard_normal((3, N)))
    leaves = Material(*(type(v)(v) for v in (m.diffuse, m.specular, m.roughness, m.normal)))
    names = ("diffuse", "specular", "roughness", "normal")
    for name in names:
        dr.enable_grad(getattr(leaves, name))
    color = renderer.radiance(view, leaves, samples)
    dr.backward(dr.sum(dr.dot(color, weights)))
    expected_grad = {
        "diffuse": j.diffuse * weights,
        "specular": j.specular * weights,
        "roughness": dr.dot(j.roughness, weights),
        "normal": s * dr.dot(j.tangent_s, weights) + t * dr.dot(j.tangent_t, weights),
    }
    for name in names:
        assert np.allclose(
            numpy(dr.grad(getattr(leaves, name))), numpy(expected_grad[name]), rtol=1e-9, atol=1e-12
        )
    for name, tangent in (
        ("roughness", Float64(rng.standard_normal(N))),
        ("normal", vector(Float64, 3)(rng.standard_normal((3, N)))),
    ):
        leaf = type(tangent)(getattr(m, name))
        dr.enable_grad(leaf)
        color = renderer.radiance(view, replace(m, **{name: leaf}), samples)
        dr.set_grad(leaf, tangent)
        forward = numpy(dr.forward_to(color))
        if name == "roughness":
            expect = numpy(j.roughness * tangent)
        else:
            expect = numpy(j.tangent_s * dr.dot(s, tangent) + j.tangent_t * dr.dot(t, tangent))
        assert np.allclose(forward, expect, rtol=1e-9, atol=1e-9)
    with capsys.disabled():
        print("", *lines, sep="\n  ")


@pytest.mark.parametrize("estimator", ["fast", "mis"])
def test_float32_derivatives(estimator, capsys):
    """Single precision of a map's gradients: 99% within 1e-3 of float64.

    A direction's rounding, 6e-8, is felt in units of the lobe's width α: the worst error of any
    derivative is below 1e-4/α, that is 1% at roughness 0.1 and 0.03% at 0.6.
    """
    lights = "both"
    c = extreme_configurations(N, seed=3)
    results = {}
    for scalar in (Float64, Float):
        scene = a_scene(lights, scalar)
        view, m = configuration_view(scene, c)
        results[scalar] = ESTIMATORS[estimator](scene).pixel_jacobian(view, m, 32)
    lines = []
    rho = c["roughness"]
    value = numpy(results[Float64].radiance)
    scales = {"radiance": 1, "diffuse": 1, "specular": 1, "roughness": 1 / rho}
    scales |= {"tangent_s": 1 / rho**2, "tangent_t": 1 / rho**2}
    for name, scale in scales.items():
        a, b = numpy(getattr(results[Float64], name)), numpy(getattr(results[Float], name))
        assert np.all(np.isfinite(b)), name
        error = worst(b, a, 1e-1 * value * scale + 1e-6, lines, f"{estimator} {lights} {name}")
        lines[-1] += f", error·α {np.max(error * rho**2):.1e}"
        assert np.percentile(error, 99) < 2e-3, lines[-1]
        assert np.max(error * rho**2) < 1e-4, lines[-1]
    with capsys.disabled():
        print("", *lines, sep="\n  ")


def light_gradient(estimator, field, index):
    """(∂/∂θ of a weighted sum of pixels by reverse mode, by differences) for a light's entry."""
    scene = a_scene("both")
    view, m = configuration_view(scene, extreme_configurations(256, seed=1))
    m.roughness = dr.maximum(m.roughness, 0.1)
    weights = np.random.default_rng(1).uniform(0.5, 1.5, (3, 256))
    sampler = Mis(scene).sampler

    def total(scene):
        # The sampler would follow the environment: hold it.
        renderer = Fast(scene) if estimator == "fast" else Mis(scene, sampler)
        color = renderer.radiance(view, m, 32)
        return dr.sum(dr.dot(color, vector(Float64, 3)(weights)))

    leaf = type(getattr(scene, field))(getattr(scene, field))
    dr.enable_grad(leaf)
    dr.backward(total(replace(scene, **{field: leaf})))
    grad = numpy(dr.grad(leaf)).ravel()[index]
    base = numpy(getattr(scene, field))
    h = 1e-3 * max(abs(base.ravel()[index]), 1e-2)

    def moved(delta):
        values = base.copy().ravel()
        values[index] += delta
        new = type(leaf)(values.reshape(base.shape) if base.ndim > 1 else values)
        return float(total(replace(scene, **{field: new}))[0])

    return grad, (moved(h) - moved(-h)) / (2 * h)


SUN_TEXEL = 3 * (int(0.3 * 32) * 64 + int(0.2 * 32))


@pytest.mark.parametrize("estimator", ["fast", "mis"])
@pytest.mark.parametrize(
    "field, index",
    [
        ("pattern", 3 * (16 * 5 + 7)),
        ("pattern", 0),
        ("environment", 3 * (64 * 12 + 40) + 1),
        ("environment", 3 * (64 * 12)),
        ("environment", SUN_TEXEL),
        ("gain", 1),
        ("scale", 0),
    ],
)
def test_light_derivatives(estimator, field, index):
    """Radiance is linear in every light, so differences are exact."""
    grad, fd = light_gradient(estimator, field, index)
    # Which share of a bright texel is a lamp to the fast estimator follows the environment too.
    held = estimator == "mis" or field != "environment"
    assert grad == pytest.approx(fd, rel=1e-7 if held else 0.02)


@pytest.mark.parametrize("estimator, field", [("fast", "falloff"), ("fast", "bezel"),
                                              ("mis", "falloff")])  # fmt: skip
def test_display_derivatives(estimator, field):
    """By the exponent of the dimming, and (the fast estimator's edges are soft) by the bezel's
    width; summed over extreme configurations."""
    scene = a_scene("display")
    view, m = configuration_view(scene, extreme_configurations(256, seed=1))
    m.roughness = dr.maximum(m.roughness, 0.1)

    def total(value):
        moved = {"falloff": value} if field == "falloff" else {"bezel": (value, scene.bezel[1])}
        color = ESTIMATORS[estimator](replace(scene, **moved)).radiance(view, m, 32)
        return dr.sum(dr.sum(color))

    start = Float64(scene.falloff if field == "falloff" else scene.bezel[0])
    leaf = Float64(start)
    dr.enable_grad(leaf)
    dr.backward(total(leaf))
    h = 1e-6
    expected = central(lambda d: numpy(total(start + d)), h)[0]
    assert abs(expected) > 1
    assert float(dr.grad(leaf)[0]) == pytest.approx(expected, rel=1e-6)


POSES = [("screen_shift", 0), ("screen_shift", 1), ("screen_shift", 2)]
POSES += [("screen_tilt", 0), ("screen_tilt", 1), ("screen_tilt", 2)]
POSES += [("camera_shift", 0), ("camera_shift", 1), ("camera_shift", 2)]


def pose_scene(lights, field, axis, delta):
    shift = [0.0, 0.0, 0.0]
    shift[axis] = delta
    rig = WIDE if "display" in lights else Rig()
    return a_scene(lights, rig=replace(rig, **{field: tuple(shift)}))


POSE_FIELDS = ("corner", "edge_x", "edge_y", "camera")


def pose_tangent(lights, field, axis):
    """The scene with its pose's fields carrying their derivative along one degree of freedom."""
    h = 1e-6
    scene = pose_scene(lights, field, axis, 0.0)
    plus, minus = (pose_scene(lights, field, axis, d) for d in (h, -h))
    fields = {}
    for name in POSE_FIELDS:
        leaf = vector(Float64, 3)(getattr(scene, name))
        dr.enable_grad(leaf)
        fields[name] = leaf
    for name, leaf in fields.items():
        d = (numpy(getattr(plus, name)) - numpy(getattr(minus, name))) / (2 * h)
        dr.set_grad(leaf, vector(Float64, 3)(*(float(v) for v in d.ravel())))
    return replace(scene, **fields), list(fields.values())


@pytest.mark.parametrize(
    "lights, field, axis",
    [
        ("both", *p) if i % 2 == 0 else pytest.param("both", *p, marks=SLOW)
        for i, p in enumerate(POSES)
    ]
    + [pytest.param("display", "screen_shift", 2, marks=SLOW), ("display", "screen_tilt", 1)],
)
def test_pose_derivatives_fast(lights, field, axis):
    """Pixel by pixel: the fast estimator's edges are soft, so its derivative has no jumps."""
    n, samples = 16, 16
    m = Material(0.4, 0.3, Float64(0.35), vector(Float64, 3)(0.1, -0.2, 1))

    def image(scene):
        view = make_view(scene, n, n)
        return Fast(scene).radiance(view, m, samples)

    scene, leaves = pose_tangent(lights, field, axis)
    color = image(scene)
    dr.enqueue(dr.ADMode.Forward, leaves)
    dr.traverse(dr.ADMode.Forward)
    found = numpy(dr.grad(color))
    h = 1e-7 if "shift" in field else 1e-5
    fd = (
        numpy(image(pose_scene(lights, field, axis, h)))
        - numpy(image(pose_scene(lights, field, axis, -h)))
    ) / (2 * h)
    norm = np.linalg.norm(found - fd) / np.linalg.norm(fd)
    assert norm < 1e-3, f"relative error {norm:.1e}"


@pytest.mark.parametrize(
    "lights, field, axis",
    [
        ("smooth", "screen_shift", 0),
        ("smooth", "screen_tilt", 1),
        ("smooth", "camera_shift", 0),
        ("smooth display", "screen_tilt", 1),
    ],
)
def test_pose_derivatives_mis(lights, field, axis):
    """The mean over pixels: mis's derivative, which has no visibility edge, is unbiased.

    Under smooth light; a lamp behind the screen's edge makes it noisy (measured: 5% at 1,024
    samples where it is 0.05% here), not wrong.
    """
    n = 24
    m = Material(0.4, 0.3, Float64(0.5), vector(Float64, 3)(0.1, -0.2, 1))

    def image(scene, samples, seed=0):
        view = make_view(scene, n, n, seed)
        return Mis(scene).radiance(view, m, samples)

    scene, leaves = pose_tangent(lights, field, axis)
    color = image(scene, 256)
    dr.enqueue(dr.ADMode.Forward, leaves)
    dr.traverse(dr.ADMode.Forward)
    found = numpy(dr.grad(color)).mean()
    h = 1e-3 if "shift" in field else 1.0
    fd = [
        (
            numpy(image(pose_scene(lights, field, axis, h), 2048, seed))
            - numpy(image(pose_scene(lights, field, axis, -h), 2048, seed))
        ).mean()
        / (2 * h)
        for seed in range(2)
    ]
    assert found == pytest.approx(np.mean(fd), rel=0.04)


def test_gradients_of_maps_and_lights_together():
    """Where lights carry gradients too, Dr.Jit's own reverse mode gives the maps' gradients."""
    scene = a_scene("both")
    view, m = configuration_view(scene, extreme_configurations(256, seed=5))
    m.roughness = dr.maximum(m.roughness, 0.05)

    def grads(with_gain):
        rho = Float64(m.roughness)
        n = vector(Float64, 3)(m.normal)
        dr.enable_grad(rho, n)
        gain = vector(Float64, 3)(scene.gain)
        if with_gain:
            dr.enable_grad(gain)
        renderer = Fast(replace(scene, gain=gain))
        color = renderer.radiance(view, replace(m, roughness=rho, normal=n), 16)
        dr.backward(dr.sum(dr.squared_norm(color)))
        return numpy(dr.grad(rho)), numpy(dr.grad(n))

    for a, b in zip(grads(False), grads(True), strict=True):
        assert np.allclose(a, b, rtol=1e-7, atol=1e-9 * np.abs(a).max())


@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_a_constant_map_has_a_gradient_in_every_pixel(estimator):
    """Each is that pixel's own, as its Jacobian has it: none is shared, and none is a sum."""
    scene = make_scene(Rig(), some_pattern(), some_environment(), 5.0)
    renderer, view = ESTIMATORS[estimator](scene), make_view(scene, 5, 7)
    leaves = Material.from_maps(constant_maps(5, 7))
    dr.enable_grad(leaves.diffuse, leaves.specular, leaves.roughness, leaves.normal)
    dr.backward(dr.sum(dr.sum(renderer.radiance(view, leaves, 16))))
    j = renderer.pixel_jacobian(view, dr.detach(leaves), 16)
    assert dr.width(dr.grad(leaves.roughness)) == 35
    assert np.array(dr.grad(leaves.normal)).shape == (3, 35)
    for gradient, own in (
        (leaves.roughness, dr.sum(j.roughness)),
        (leaves.diffuse, j.diffuse),
        (leaves.specular, j.specular),
    ):
        assert np.allclose(np.array(dr.grad(gradient)), np.array(own), rtol=1e-6)
        assert np.array(own).std(-1).min() > 0  # the pixels differ
