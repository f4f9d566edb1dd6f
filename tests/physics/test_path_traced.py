from dataclasses import replace

import numpy as np
import pytest
from forward_scenes import rendered, some_environment, some_maps, some_pattern

from invrender.data.simulate_setup import without_screen
from invrender.maps import constant_maps
from invrender.render import path_traced as photograph
from invrender.rig import Rig


def sample_region(rig, photo, n):
    """The photo's pixels that show the sample, averaged to n × n."""
    height, width = photo.shape[:2]
    half = rig.sample_size / 2
    corners = rig.project(np.array([[-half, half, 0.0], [half, -half, 0.0]]), height, width)
    (x0, y0), (x1, _) = np.rint(corners).astype(int)
    k = (x1 - x0) // n
    crop = photo[y0 : y0 + n * k, x0 : x0 + n * k]
    return crop.reshape(n, k, n, k, 3).mean((1, 3))


def test_whole_photograph_agrees_on_the_sample():
    """Without table and ball in the light path (depth 2, black table) the sample is ours."""
    # A width at which the sample covers whole pixels: 8 per map texel.
    rig = Rig()
    n = 16
    maps, pattern, env = some_maps(n, "glossy"), some_pattern(), some_environment(sun=0)
    width = 4 * 8 * n
    fov = np.degrees(2 * np.arctan(0.5 * width * rig.sample_size / (8 * n) / rig.screen_height))
    rig = Rig(fov=float(fov))
    photo = photograph.photograph(
        rig, maps, pattern, env, 3.0, height=width // 2, width=width, spp=32, max_depth=2, table=0.0
    )
    ours = rendered(rig, maps, pattern, env, 3.0, samples=256)
    seen = sample_region(rig, photo, n)
    difference = np.abs(seen - ours).mean() / ours.mean()
    assert difference < 0.02, difference


def test_a_lamp_lights_the_sample_as_a_sphere_does():
    """E = π L (r / d)² cos θ from a sphere above the horizon; no screen is in its way."""
    rig = without_screen(Rig())
    centre, radius, level = (0.2, 0.1, 0.4), 0.05, 30.0
    white = constant_maps(4, 4, diffuse=1.0, specular=0.0)
    scene = photograph.sample_scene(rig, white, None, None, lamp=(centre, radius, (level,) * 3))
    seen = photograph.path_traced(scene, rig, 4, 4, 256)
    to = np.array(centre) - rig.sample_points(4, 4)
    d = np.linalg.norm(to, axis=-1)
    expected = level * radius**2 * to[..., 2] / d**3
    # Fresnel's share of a dielectric without f0 is small away from grazing angles.
    np.testing.assert_allclose(seen, expected[..., None] * np.ones(3), rtol=0.02)


def test_ball_and_table_are_where_the_rig_says():
    """The photo's centre shows the mirror ball; beside it lies the table."""
    rig = Rig()
    env = np.full((16, 32, 3), 1.0)
    photo = photograph.photograph(
        rig, constant_maps(8, 8), np.ones((4, 4, 3)), env, 2.0, height=240, width=320, spp=16
    )
    assert np.all(np.isfinite(photo))
    # The ball's apex looks back at the camera: the reflected environment beside the screen.
    assert photo[120, 160] == pytest.approx([0.9] * 3, rel=0.05)


def test_table_and_ball_only_add_light():
    """What the estimators leave out is positive and small: light by way of table and ball."""
    rig = Rig()
    maps, pattern, env = some_maps(8, "rough"), some_pattern(), some_environment(sun=0, lamps=0)
    kw = {"height": 240, "width": 320, "spp": 64}
    direct = photograph.photograph(rig, maps, pattern, env, max_depth=2, table=0.0, **kw)
    whole = photograph.photograph(rig, maps, pattern, env, max_depth=5, table=0.3, **kw)
    a, b = sample_region(rig, direct, 8).mean(), sample_region(rig, whole, 8).mean()
    assert 0.97 < b / a < 1.1, b / a


def test_a_result_is_a_mitsuba_scene_in_one_call():
    """What Mitsuba renders of its description is what `render` renders, the camera off its place;
    its maps carry gradients."""
    import drjit as dr
    import mitsuba as mi

    from invrender.lights import Lights
    from invrender.maps import NAMES
    from invrender.render.image import render

    rig = Rig(camera_shift=(0.004, -0.006, 0.01), camera_tilt=(3.0, -2.0, 1.0))
    maps = some_maps(16, "glossy")
    lights = Lights(rig, some_pattern(), some_environment(sun=0), gain=3.0)
    scene = mi.load_dict(photograph.scene_dict(maps, lights, samples=512))
    image = np.array(mi.render(scene))
    ours = render(maps, lights)
    # Mitsuba averages over a pixel, ours is at its centre.
    assert np.abs(image - ours).mean() < 0.03 * ours.mean()
    parameters = mi.traverse(scene)
    keys = [f"sample.bsdf.{name}" for name in NAMES]
    assert set(keys) <= set(parameters.keys())
    dr.enable_grad(parameters[keys[0]])
    parameters.update()
    dr.backward(dr.mean(mi.render(scene, parameters, spp=4)))
    assert np.abs(np.array(dr.grad(parameters[keys[0]]))).max() > 0


def test_a_ramp_is_a_plane_whose_normals_lean():
    """Under distant light only the normal counts; a relief's triangles face as its heights say."""
    rig, n, slope = without_screen(Rig()), 12, 0.2
    x = rig.sample_points(n, n)[..., 0]
    env = some_environment(sun=0)
    lean = np.array([-slope, 0, 1]) / np.hypot(slope, 1)
    flat = constant_maps(n, n, diffuse=0.6, specular=0.04, roughness=0.6)
    leaning = replace(flat, normal=np.broadcast_to(lean, (n, n, 3)).astype(np.float32))
    options = {"spp": 128, "height": 240, "width": 240, "table": 0.0, "max_depth": 2}
    seen = [
        sample_region(rig, photograph.photograph(rig, maps, None, env, relief=relief, **options), 4)
        for maps, relief in ((leaning, None), (leaning, slope * x), (flat, 0 * x))
    ]
    by_normals, by_heights, even = (s[1:-1, 1:-1] for s in seen)
    np.testing.assert_allclose(by_heights.mean((0, 1)), by_normals.mean((0, 1)), rtol=0.02)
    assert np.abs(even.mean((0, 1)) / by_normals.mean((0, 1)) - 1).max() > 0.04


def test_a_groove_hides_the_sky_from_itself():
    """Of an even sky a V-shaped groove's walls, inclined by a, receive cos a: their opening's width
    over theirs. Normals alone would say (1 + cos a) / 2."""
    rig, n, wall = without_screen(Rig()), 96, 6
    pixel = rig.sample_size / n
    up = (np.arange(n) // wall) % 2 == 0
    slope = np.where(up, 1.0, -1.0)
    height = np.cumsum(slope) * pixel
    relief = np.tile(height - height.mean(), (n, 1))
    normal = np.stack([-slope, 0 * slope, 1 + 0 * slope], -1) / np.sqrt(2)
    white = constant_maps(n, n, diffuse=1.0, specular=0.0, roughness=1.0)
    grooved = replace(white, normal=np.tile(normal, (n, 1, 1)).astype(np.float32))
    sky = np.ones((16, 32, 3))
    sky[8:] = 0
    seen = []
    for maps, heights in ((white, None), (grooved, None), (grooved, relief)):
        scene = photograph.sample_scene(rig, maps, None, sky, relief=heights)
        # A shift: rays through the mesh's vertices may pass between its triangles.
        moved = replace(rig, camera_shift=(0.21 * pixel, 0.13 * pixel, 0.0))
        image = photograph.path_traced(scene, moved, n, n, 32)
        seen.append(float(image[n // 4 : -n // 4, 2 * wall : -2 * wall].mean()))
    flat, normals, heights = seen
    assert normals / flat == pytest.approx((1 + np.sqrt(0.5)) / 2, rel=0.04)
    assert heights / flat == pytest.approx(np.sqrt(0.5), rel=0.04)
