"""Real displays and rigs in the forward model, against Mitsuba's path tracer."""

import numpy as np
import pytest
from forward_scenes import ESTIMATORS, some_environment, some_maps, some_pattern

from invrender.lights import Device, Lights
from invrender.render.backend import dr
from invrender.render.path_traced import path_traced, sample_scene
from invrender.render.renderer import Material
from invrender.render.scene import make_view, scene_under
from invrender.rig import Rig

MIXED = ((0.92, 0.05, 0.03), (0.04, 0.94, 0.02), (0.0, 0.08, 0.92))
RIGS = {
    "dims to the sides": (Rig(), Device(falloff=1.4)),
    "bezel": (Rig(screen_bezel=0.012), Device()),
    "rectangle": (Rig(screen_size=(0.228, 0.16), sample_side=0.07), Device()),
    "high camera": (Rig(camera_height=0.2), Device()),
    "all": (
        Rig(
            screen_size=(0.228, 0.16), sample_side=0.07, screen_bezel=0.01, camera_height=0.19,
            screen_tilt=(2.0, -3.0, 1.0), screen_shift=(0.004, -0.002, 0.003),
        ),
        Device(falloff=0.9, gamma=(1.1, 1.0, 0.95), black=0.01, mixing=MIXED),
    ),
}  # fmt: skip


def lights_of(rig, device):
    """A pattern of 12 × 16 pixels and a smooth room."""
    room = some_environment(32, sun=0, lamps=0)
    return Lights(rig, some_pattern(16)[:12], room, 3.0, device=device)


@pytest.mark.parametrize("name", RIGS)
def test_agrees_with_the_path_tracer(name):
    """1,024 paths a pixel leave 2% of noise; the mean over 256 pixels is good to 0.2%."""
    rig, device = RIGS[name]
    maps, lights = some_maps(16, "glossy"), lights_of(rig, device)
    scene = sample_scene(rig, maps, lights.pattern, lights.environment, 3.0, device=device)
    reference = path_traced(scene, rig, 16, 16, 1024, seed=5)
    for estimator, samples in (("mis", 1024), ("fast", 256)):
        image = ESTIMATORS[estimator].under(lights).render(maps, samples)
        error = np.sqrt(np.mean((image - reference) ** 2)) / reference.mean()
        assert error < 0.03, (estimator, error)
        assert image.mean() == pytest.approx(reference.mean(), rel=0.004), estimator


@pytest.mark.parametrize("name", ["dims to the sides", "bezel", "all"])
def test_what_each_does_is_more_than_the_tolerance(name):
    """Left out, each changes the picture by more than the test above would let pass."""
    rig, device = RIGS[name]
    maps = some_maps(16, "glossy")
    square = Rig(rig.screen_size, sample_side=rig.sample_side, camera_height=rig.camera_height)
    images = [
        ESTIMATORS["fast"].under(lights_of(*case)).render(maps, 64)
        for case in ((rig, device), (square, Device()))
    ]
    assert images[0].mean() < 0.97 * images[1].mean()


@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_what_a_display_does_not_do_costs_nothing(estimator):
    """An ideal device, another camera height and a rectangle run the kernels of the nominal rig, as
    many of them; a curve, black level and mixing too. A new exponent or bezel compiles once."""

    def kernels(rig, device):
        """(launches, compiled anew)"""
        scene = scene_under(lights_of(rig, device))
        view, material = make_view(scene, 16, 16), Material.from_maps(some_maps(16, "glossy"))
        renderer = ESTIMATORS[estimator](scene)
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            dr.kernel_history_clear()
            dr.eval(renderer.radiance(view, material, 8))
            renderer.pixel_jacobian(view, material, 8)
            history = [k for k in dr.kernel_history() if k["type"] == dr.KernelType.JIT]
        return len(history), sum(not k["cache_hit"] for k in history)

    launches, _ = kernels(Rig(), Device())
    wide = Rig(screen_size=(0.228, 0.16), sample_side=0.07, camera_height=0.2)
    driven = Device(gamma=(1.1, 1.0, 0.9), black=0.01, mixing=MIXED)
    assert kernels(wide, Device()) == (launches, 0)
    assert kernels(Rig(), driven) == (launches, 0)
    kernels(Rig(screen_bezel=0.01), Device(falloff=0.5))
    assert kernels(Rig(screen_bezel=0.02), Device(falloff=0.6)) == (launches, 0)


def test_a_bezel_hides_the_room_and_emits_nothing():
    """A white room behind a screen as bright as it: only the bezel is missing."""
    maps = some_maps(8, "rough")
    room, white = np.ones((16, 32, 3)), np.ones((4, 4, 3))

    def image(**values):
        return ESTIMATORS["fast"].under(Lights(Rig(**values), white, room)).render(maps, 256)

    plain, framed = image(), image(screen_bezel=0.02)
    larger = image(screen_size=0.22, sample_side=0.09, screen_shift=(0.02, 0.0, 0.0))
    np.testing.assert_allclose(larger, plain, rtol=2e-3)
    black = Lights(
        Rig(screen_size=0.22, sample_side=0.09, screen_shift=(0.02, 0.0, 0.0)), 0 * white, room
    )
    hidden = plain - ESTIMATORS["fast"].under(black).render(maps, 256)
    lit = Lights(Rig(), white)
    own = ESTIMATORS["fast"].under(lit).render(maps, 256)
    np.testing.assert_allclose(plain - framed, hidden - own, atol=4e-3 * plain.max())
