"""Values of the two estimators: analytic cases, Mitsuba, each other, and what must cost nothing."""

from dataclasses import replace

import numpy as np
import pytest
from forward_scenes import ESTIMATORS, rendered, some_environment, some_maps, some_pattern

from invrender.maps import Maps, constant_maps
from invrender.render.backend import dr
from invrender.render.fast.estimator import Fast
from invrender.render.renderer import Material
from invrender.render.scene import make_scene, make_view
from invrender.rig import Rig
from invrender.types import InputError

GAIN = (4.0, 3.0, 5.0)


def diffuse_only(n=8, normal=(0, 0, 1)):
    return constant_maps(n, n, 0.6, 0.0, 1.0, normal)


@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_constant_environment(estimator):
    """E = πL for a flat sample, πL(1 + cos θ)/2 for a tilted one: the table hides the rest."""
    env = np.full((16, 32, 3), 2.0)
    for degrees in (0, 40):
        a = np.radians(degrees)
        scene = make_scene(Rig(), None, env)
        view = make_view(scene, 8, 8)
        m = Material.from_maps(diffuse_only(normal=(np.sin(a), 0, np.cos(a))))
        shading = ESTIMATORS[estimator](scene).shade(view, m.roughness, m.normal, 256)
        e = np.array(shading.irradiance)
        assert e.mean() == pytest.approx(2 * np.pi * (1 + np.cos(a)) / 2, rel=5e-3)
        assert np.abs(e / e.mean() - 1).max() < (0.01 if estimator == "fast" else 0.05)


def form_factor(rig, x, normal):
    """Lambert's formula: ∫ n·l dl over the screen's solid angle, for a screen above the horizon."""
    e_x, e_y = rig.screen_edges
    corners = [rig.screen_corner + v for v in (0 * e_x, e_y, e_x + e_y, e_x)]
    d = [(c - x) / np.linalg.norm(c - x) for c in corners]
    total = 0.0
    for a, b in zip(d, [*d[1:], d[0]], strict=True):
        cross = np.cross(a, b)
        total += np.arccos(np.clip(a @ b, -1, 1)) * (cross @ normal) / np.linalg.norm(cross)
    return abs(total) / 2


@pytest.mark.parametrize("estimator", ESTIMATORS)
@pytest.mark.parametrize("tilt", [0, 20])
def test_screen_form_factor(estimator, tilt):
    """A white screen's irradiance is its form factor."""
    rig = Rig(screen_tilt=(2.0, -3.0, 1.0))
    a = np.radians(tilt)
    normal = np.array([-np.sin(a), 0, np.cos(a)])
    scene = make_scene(rig, np.ones((4, 4, 3)), None)
    m = Material.from_maps(diffuse_only(4, normal))
    shading = ESTIMATORS[estimator](scene).shade(
        make_view(scene, 4, 4), m.roughness, m.normal, 2048
    )
    expected = [form_factor(rig, x, normal) for x in rig.sample_points(4, 4).reshape(-1, 3)]
    assert np.allclose(np.array(shading.irradiance)[0], expected, rtol=4e-3)


@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_mirror_shows_the_pattern_and_the_environment(estimator):
    """A near-mirror reflects the pattern where its mirror direction meets the screen."""
    rig = Rig()
    n = 9
    maps = constant_maps(n, n, 0.0, 1.0, 0.01)
    ramp = np.linspace(0, 1, 64)
    pattern = np.stack(np.broadcast_arrays(ramp[None, :], ramp[::-1, None], 0.5), -1)
    image = rendered(rig, maps, pattern, None, estimator=estimator, samples=1024)
    points = rig.sample_points(n, n)
    away = points - rig.camera
    hit = points + away * [1, 1, -1] * (rig.screen_height / rig.camera[2])
    st = (hit - rig.screen_corner)[..., :2] / rig.screen_size
    inside = (st > 0.02).all(-1) & (st < 0.98).all(-1)
    expected = np.clip((st * 64 - 0.5) / 63, 0, 1)
    assert inside.sum() > 50
    worst = np.abs(image[inside][:, :2] - expected[inside]).max()
    assert worst < 8e-3, worst
    # With normals turned away from the screen, it shows the environment at the reflected direction.
    env = np.full((16, 32, 3), 0.25)
    env[:, :16] = 0.75  # towards +y
    a = np.radians(35.0)
    maps = constant_maps(1, 1, 0.0, 1.0, 0.02, (0, np.sin(a), np.cos(a)))
    image = rendered(rig, maps, pattern, env, estimator=estimator, samples=64)
    assert image[0, 0] == pytest.approx([0.75] * 3, rel=0.02)


@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_dark_scenes(estimator):
    """Nothing in, nothing out; a black pattern still hides the environment."""
    maps = some_maps(8, "glossy")
    env = np.full((16, 32, 3), 1.0)
    black = np.zeros((4, 4, 3))
    dark = rendered(Rig(), maps, None, None, estimator=estimator)
    assert dark.shape == (8, 8, 3) and not dark.any()
    assert not rendered(Rig(), maps, black, 0 * env, estimator=estimator).any()
    with_screen = rendered(Rig(), maps, black, env, estimator=estimator, samples=256)
    without = rendered(Rig(), maps, None, env, estimator=estimator, samples=256)
    assert with_screen.mean() < 0.8 * without.mean()
    unlit = rendered(Rig(), maps, 1 - black, env, 0.0, estimator=estimator, samples=256)
    assert np.array_equal(with_screen, unlit)
    black_maps = constant_maps(8, 8, 0.0, 0.0, 1.0)
    only_schlick = rendered(Rig(), black_maps, None, env, estimator=estimator, samples=256)
    assert 0 < only_schlick.mean() < 0.02


@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_what_a_scene_lacks_changes_nothing(estimator):
    """The specialised kernel of a part equals the general one with that part's light at zero."""
    maps = some_maps(16, "glossy")
    pattern, env = some_pattern(), some_environment()
    run = lambda p, e: rendered(  # noqa: E731
        Rig(), maps, p, e, GAIN, estimator=estimator, samples=512
    )
    both, screen = run(pattern, env), run(pattern, None)
    behind = run(np.zeros_like(pattern) + 1e-12, env)
    tolerance = 0.01 if estimator == "fast" else 0.03
    assert np.abs(both - screen - behind).max() < tolerance * both.max()
    constant = constant_maps(16, 16, 0.3, 0.2, 0.4)
    wide = replace(constant, roughness=constant.roughness.copy())
    wide.roughness[0, 0] += 1e-6  # no longer constant: a full-size array
    wide.diffuse[0, 0] += 1e-6
    a = rendered(Rig(), constant, pattern, env, estimator=estimator)
    b = rendered(Rig(), wide, pattern, env, estimator=estimator)
    assert np.allclose(a, b, rtol=1e-4)


@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_tiles_change_nothing(estimator, monkeypatch):
    maps, pattern, env = some_maps(32, "tilted"), some_pattern(), some_environment()
    args = (Rig(), maps, pattern, env)
    whole = rendered(*args, estimator=estimator, samples=16)
    monkeypatch.setattr("invrender.render.renderer.TILE", 300)
    assert np.allclose(whole, rendered(*args, estimator=estimator, samples=16), rtol=1e-5)


@pytest.mark.parametrize("unit", [1e-3, 1e3])
def test_units_do_not_matter(unit):
    """The rig in kilometres or millimetres gives the same picture."""
    rig = Rig()
    lengths = ("screen_size", "screen_height", "camera_offset", "ball_radius")
    scaled = replace(rig, **{k: getattr(rig, k) * unit for k in lengths})
    maps, pattern, env = some_maps(16, "glossy"), some_pattern(), some_environment()
    for estimator in ESTIMATORS:
        a, b = (
            rendered(r, maps, pattern, env, estimator=estimator, samples=32) for r in (rig, scaled)
        )
        assert np.abs(a - b).max() < 2e-3 * a.max(), estimator


CASES = ["rough", "glossy", "metal", "tilted", "mirror"]


@pytest.mark.parametrize("kind", CASES)
def test_mis_agrees_with_mitsuba(kind):
    """Mean differences over 16 regions × RGB, in standard errors of both: Student-like around 0."""
    from invrender.render import path_traced as photograph

    rig = Rig(screen_tilt=(1.0, 2.0, 0.5), camera_shift=(0.002, -0.001, 0.003))
    n, regions, runs = 32, 4, 16
    maps = some_maps(n, kind, seed=4)
    pattern, env = some_pattern(seed=2), some_environment(seed=CASES.index(kind))
    scene = photograph.sample_scene(rig, maps, pattern, env, np.array(GAIN))

    def pooled(image):
        k = n // regions
        return image.reshape(regions, k, regions, k, 3).mean((1, 3))

    path = np.array(
        [pooled(photograph.path_traced(scene, rig, n, n, 64, seed)) for seed in range(runs)]
    )
    ours = np.array(
        [
            pooled(rendered(rig, maps, pattern, env, GAIN, estimator="mis", samples=64, seed=s))
            for s in range(runs)
        ]
    )
    error = np.sqrt((path.var(0, ddof=1) + ours.var(0, ddof=1)) / runs)
    z = (path.mean(0) - ours.mean(0)) / error
    assert np.abs(z).max() < 4.5 and 0.5 < np.abs(z).mean() < 1.15, (np.abs(z).max(), z.mean())
    assert error.mean() < 0.02 * path.mean(), "the test must be able to see something"


#              bias bound at 16, 64 and 1024 samples, of the mean
BIAS = {
    "rough": (0.01, 0.004, 0.003),
    "glossy": (0.01, 0.004, 0.003),
    "metal": (0.05, 0.02, 0.004),
    "tilted": (0.03, 0.012, 0.004),
    "mirror": (0.02, 0.008, 0.004),
}


@pytest.mark.parametrize("kind", CASES)
def test_fast_approaches_mis(kind):
    """RMS difference over the image, under small bright lamps that the screen's edge cuts."""
    n = 48
    maps, pattern, env = some_maps(n, kind), some_pattern(64), some_environment(64)
    run = lambda estimator, samples, seed: rendered(  # noqa: E731
        Rig(), maps, pattern, env, GAIN, estimator=estimator, samples=samples, seed=seed
    )
    halves = [np.mean([run("mis", 1024, s + k) for s in range(4)], 0) for k in (0, 10)]
    reference = sum(halves) / 2
    noise = np.sqrt(np.mean((halves[0] - halves[1]) ** 2)) / 2
    errors = [
        np.sqrt(max(np.mean((run("fast", s, 3) - reference) ** 2) - noise**2, 0)) / reference.mean()
        for s in (16, 64, 1024)
    ]
    assert all(e < b for e, b in zip(errors, BIAS[kind], strict=True)), errors


@pytest.mark.parametrize("roughness, few, many", [(0.03, 0.3, 0.2), (0.1, 0.06, 0.03),
                                                  (0.2, 0.02, 0.006)])  # fmt: skip
def test_a_sun_in_a_near_mirror(roughness, few, many):
    """The image of a sun of one texel in lobes narrower than it, about as wide, and wider: the
    radiance and its derivatives at few samples and at many. Bounds: relative norm of the error of
    the derivative along roughness; much of the first is the reference's own noise."""
    n, h = 24, 64
    rig, normal = Rig(), np.array([0.0, 0.42, 0.91])
    maps = constant_maps(n, n, 0.1, 0.5, roughness, normal)
    v, normal = rig.camera / np.linalg.norm(rig.camera), maps.normal[0, 0]
    d = 2 * (normal @ v) * normal - v  # where the middle of the sample mirrors the sun
    env = np.full((h, 2 * h, 3), 0.3)
    column = np.arctan2(d[1], d[0]) % (2 * np.pi) / np.pi * h
    env[int(np.arccos(d[2]) / np.pi * h), int(column)] = 2000
    scene = make_scene(rig, some_pattern(64), env)
    material = Material.from_maps(maps)

    def jacobian(estimator, samples, seed):
        renderer = ESTIMATORS[estimator](scene)
        j = renderer.pixel_jacobian(make_view(scene, n, n, seed), material, samples)
        return [np.array(x) for x in (j.radiance, j.roughness, j.tangent_s, j.tangent_t)]

    runs = [jacobian("mis", 2048, seed) for seed in range(4)]
    reference = [np.mean(x, 0) for x in zip(*runs, strict=True)]
    assert reference[0].max() > 10 * np.median(reference[0]), "the sun must be seen"
    for samples, bounds in ((4, (0.006, few, 0.03, 0.04)), (1024, (0.002, many, 0.012, 0.012))):
        found = jacobian("fast", samples, 7)
        errors = [
            np.linalg.norm(x - y) / np.linalg.norm(y) for x, y in zip(found, reference, strict=True)
        ]
        assert all(e < b for e, b in zip(errors, bounds, strict=True)), (samples, errors)


def test_fast_is_exact_without_lamps():
    """Where no light is small, the error falls with samples to the tables' own, below 0.2%."""
    n = 32
    maps, pattern, env = some_maps(n, "metal"), some_pattern(64), some_environment(32, 0, 0, 0)
    run = lambda estimator, samples, seed: rendered(  # noqa: E731
        Rig(), maps, pattern, env, GAIN, estimator=estimator, samples=samples, seed=seed
    )
    reference = np.mean([run("mis", 4096, s) for s in range(6)], 0)
    rms = [np.sqrt(np.mean((run("fast", s, 1) - reference) ** 2)) for s in (16, 64, 256, 4096)]
    rms = np.array(rms) / reference.mean()
    assert np.all(np.diff(rms) < 0) and rms[1] < 0.015 and rms[3] < 0.002, rms


@pytest.mark.slow  # seconds and gigabytes
def test_detail_lowers_the_error_of_the_tables():
    """Irradiance has no samples: its error is the tables', and falls with their size."""
    n = 24
    scene = make_scene(Rig(), some_pattern(64), some_environment(32, 0, 0, 0), GAIN)
    m, view = Material.from_maps(some_maps(n, "rough")), make_view(scene, n, n)

    def irradiance(detail):
        renderer = Fast(scene, detail)
        return np.array(renderer.shade(view, m.roughness, m.normal, 1).irradiance)

    finest = irradiance(4)
    errors = [np.sqrt(np.mean((irradiance(k) - finest) ** 2)) / finest.mean() for k in (1, 2)]
    assert errors[0] < 1e-3 and errors[1] < 0.5 * errors[0], errors


@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_nothing_is_recompiled(estimator):
    """New seeds, sample counts, maps, gains, lights and rigs reuse the first call's kernels; and a
    Jacobian that is asked for again is the same, with other maps and seeds too."""
    rng = np.random.default_rng(0)

    def call(k):
        maps = some_maps(16, "glossy", seed=k)
        rig = Rig(screen_size=0.18 + 0.001 * k, screen_height=0.15 + 0.002 * k)
        # Five small lamps or more, at least one of them cut by the screen's edge.
        env = some_environment(32, seed=3, lamps=1 + k) * (1 + k)
        env[8, ::13] += 50 + k
        scene = make_scene(rig, rng.uniform(0, 1, (16, 16, 3)), env, 1.0 + k, 2.0 + k)
        view = make_view(scene, 16, 16, seed=k)
        renderer = ESTIMATORS[estimator](scene)
        material = Material.from_maps(maps)
        dr.eval(renderer.radiance(view, material, 8 + k))
        for again in range(3):
            view = make_view(scene, 16, 16, seed=k + again)
            material = Material.from_maps(some_maps(16, "glossy", seed=k + again))
            traced, recorded = (
                np.array([*j.radiance, *j.roughness, *j.tangent_s, *j.s])
                for j in (
                    renderer.pixel_jacobian(view, material, 9 + k),
                    renderer.jacobian_again(view, material, 9 + k),
                )
            )
            np.testing.assert_array_equal(traced, recorded)

    call(0)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        for k in (1, 2):
            call(k)
        history = [k for k in dr.kernel_history() if k["type"] == dr.KernelType.JIT]
    assert history
    assert all(k["cache_hit"] for k in history), [k["hash"] for k in history if not k["cache_hit"]]


def test_inputs_are_checked():
    good = np.ones((4, 4, 3))
    with pytest.raises(InputError, match="pattern must be"):
        make_scene(Rig(), np.ones((4, 5)), None)
    with pytest.raises(InputError, match="environment must be"):
        make_scene(Rig(), None, np.ones((4, 4, 3)))
    with pytest.raises(InputError, match="negative or non-finite"):
        make_scene(Rig(), -good, None)
    with pytest.raises(InputError, match="negative or non-finite"):
        make_scene(Rig(), good * np.nan, None)


@pytest.mark.slow
def test_4096_in_bounded_memory():
    """4096² in tiles: the process grows by less than 4 GB."""
    import resource

    n = 4096
    small = some_maps(64, "glossy")
    grow = lambda a: np.repeat(np.repeat(a, n // 64, 0), n // 64, 1)  # noqa: E731
    maps = Maps(*(grow(getattr(small, k)) for k in ("diffuse", "specular", "roughness", "normal")))
    image = rendered(Rig(), maps, some_pattern(), some_environment(), samples=4)
    assert np.all(np.isfinite(image))
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss < 4 << 20
