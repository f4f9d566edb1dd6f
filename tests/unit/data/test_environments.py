"""Integrals, resampling and files of environments, and the procedural ones."""

import logging

import numpy as np
import pytest

from invrender.data.environments import (
    KINDS,
    add_light,
    find_environments,
    procedural_environment,
    read_environment,
)
from invrender.files.write import write_exr
from invrender.sphere import (
    directions,
    irradiance,
    resample_environment,
    rotate_environment,
    scale_environment,
    solid_angles,
)
from invrender.types import InputError


def flux(env):
    """∫ L dω over the sphere, (3,)."""
    return np.einsum("hwc,h->c", env.astype(np.float64), solid_angles(*env.shape[:2]))


def random_env(height=16, seed=0):
    return np.random.default_rng(seed).random((height, 2 * height, 3)).astype(np.float32)


def test_solid_angles_add_to_the_sphere():
    assert 48 * solid_angles(24, 48).sum() == pytest.approx(4 * np.pi)


def test_directions_follow_the_convention():
    d = directions(64, 128)
    assert d[0, 0, 2] > 0.99
    middle = d[31, [0, 32, 64, 96]]
    assert np.allclose(middle[:, :2], [(1, 0), (0, 1), (-1, 0), (0, -1)], atol=0.05)


@pytest.mark.parametrize("height", [1, 7, 32])
def test_constant_light_gives_pi(height):
    assert irradiance(np.full((height, 2 * height, 3), 2.0)) == pytest.approx(2 * np.pi)


def test_irradiance_of_tilted_normals():
    env = np.ones((256, 512, 3))
    # Half the sky: a wall's normal sees a quarter sphere above the table.
    assert irradiance(env, (1, 0, 0)) == pytest.approx(np.pi / 2, rel=1e-3)
    for angle in (30, 60):
        n = np.sin(np.radians(angle)), 0, np.cos(np.radians(angle))
        # View factor of a tilted plane to the sky: (1 + cos) / 2.
        expected = np.pi * (1 + n[2]) / 2
        assert irradiance(env, n) == pytest.approx(expected, rel=2e-3)
    assert irradiance(env, (0, 0, 5)) == pytest.approx(np.pi)  # its length does not matter


def test_light_below_the_table_does_not_count():
    env = np.zeros((32, 64, 3), np.float32)
    env[16:] = 5
    assert not irradiance(env).any()


def test_irradiance_turns_with_the_surroundings():
    env = random_env(64)
    c, s = np.cos(np.pi / 4), np.sin(np.pi / 4)
    before = irradiance(env, (0.6, 0, 0.8))
    after = irradiance(rotate_environment(env, np.pi / 4), (0.6 * c, 0.6 * s, 0.8))
    assert after == pytest.approx(before, rel=1e-4)


def test_rotation_is_counter_clockwise_and_keeps_rows():
    env = np.zeros((8, 16, 3), np.float32)
    env[3, 0] = 1  # towards +x
    assert rotate_environment(env, np.pi / 2)[3, 4, 0] == 1  # towards +y
    part = rotate_environment(random_env(), 0.123)
    assert np.allclose(part.sum(1), random_env().sum(1), rtol=1e-5)
    full = rotate_environment(random_env(), 2 * np.pi)
    assert np.allclose(full, random_env(), atol=1e-5)


@pytest.mark.parametrize("height", [5, 12, 16, 31, 64])
def test_resampling_keeps_the_flux(height):
    env = random_env(32)
    env[4, 9] = 1e5  # a lamp of one pixel
    new = resample_environment(env, height)
    assert new.shape == (height, 2 * height, 3) and new.dtype == np.float32
    assert flux(new) == pytest.approx(flux(env), rel=1e-5)


def test_scaling():
    env = random_env()
    scaled = scale_environment(env, 0.7)
    assert irradiance(scaled).mean() == pytest.approx(0.7, rel=1e-5)
    assert np.allclose(scaled / env, (scaled / env)[0, 0, 0], rtol=1e-4)  # colours kept
    white = scale_environment(env, (1.0, 2.0, 3.0))
    assert irradiance(white) == pytest.approx((1, 2, 3), rel=1e-5)
    with pytest.raises(InputError, match="black above the table"):
        scale_environment(np.zeros((4, 8, 3)), 1.0)


# --- lamps ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("radius", [0.002, 0.05, 0.6])
@pytest.mark.parametrize("centre", [(1, 0.2, 0.3), (0.05, 0.02, 1), (-1, 0.01, 0.5)])
def test_lamps_keep_their_flux_at_any_size(radius, centre):
    # A disc whose half angle has tangent r covers 2π(1 - cos).
    expected = 3 * 2 * np.pi * (1 - 1 / np.hypot(1, radius))
    for height in (32, 128):
        env = np.zeros((height, 2 * height, 3), np.float32)
        add_light(env, centre, (radius, radius), 3.0, disc=True)
        assert flux(env) == pytest.approx(expected, rel=0.03)
        # It is where it should be.
        d = directions(height, 2 * height)
        mean = np.einsum("hwc,hw,h->c", d, env[..., 0], solid_angles(height, 2 * height))
        mean /= np.linalg.norm(mean)
        assert mean @ (np.array(centre) / np.linalg.norm(centre)) > np.cos(np.pi / height)


def test_a_wide_lamp_is_even():
    env = np.zeros((64, 128, 3), np.float32)
    add_light(env, (1, 0, 0.4), (0.5, 0.5), 7.0)
    inside = env[..., 0] > 6
    assert inside.sum() > 200
    assert np.std(env[inside]) < 0.1 * 7
    assert env.max() < 1.3 * 7


# --- procedural -----------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS)
def test_procedural_environments_are_lit_and_finite(kind):
    for seed in range(8):
        env = procedural_environment(seed, 32, kind)
        assert env.shape == (32, 64, 3) and env.dtype == np.float32
        assert np.all(np.isfinite(env)) and env.min() > 0
        assert np.all(irradiance(env) > 0)


def test_procedural_environments_by_seed():
    a, b = procedural_environment(4, 32), procedural_environment(4, 32)
    assert np.array_equal(a, b)
    assert not np.array_equal(a, procedural_environment(5, 32))
    c, d = (procedural_environment(np.random.default_rng(1), 16) for _ in range(2))
    assert np.array_equal(c, d)


@pytest.mark.parametrize("kind", KINDS)
def test_light_does_not_depend_on_the_resolution(kind):
    ratios = []
    for seed in range(6):
        a = irradiance(procedural_environment(seed, 64, kind))
        b = irradiance(procedural_environment(seed, 128, kind))
        ratios.append(np.abs(np.log(a / b)).max())
    assert np.median(ratios) < 0.1


def test_lamps_are_as_bright_as_real_ones():
    contrast = []
    for seed in range(60):
        upper = procedural_environment(seed, 64)[:32].mean(-1)
        contrast.append(np.log10(upper.max() / np.median(upper)))
    assert 2 < np.median(contrast) < 5
    assert max(contrast) > 4


def test_bad_requests():
    with pytest.raises(InputError, match="no kind of environment 'cave'"):
        procedural_environment(0, 32, "cave")
    with pytest.raises(InputError, match="at least 4"):
        procedural_environment(0, 2)


# --- files ----------------------------------------------------------------------------------------


def write_hdr(path, env, run_length):
    """Radiance RGBE, flat or run-length encoded (literal runs and one constant run)."""
    h, w = env.shape[:2]
    top = env.max(-1)
    exponent = np.ceil(np.log2(np.maximum(top, 1e-30))).astype(int)
    mantissa = np.clip(np.floor(env / 2.0 ** (exponent - 8)[..., None]), 0, 255).astype(np.uint8)
    rgbe = np.concatenate([mantissa, (exponent + 128)[..., None].astype(np.uint8)], -1)
    data = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n" + f"-Y {h} +X {w}\n".encode()
    for row in rgbe:
        if not run_length:
            data += row.tobytes()
            continue
        data += bytes([2, 2, w >> 8, w & 255])
        for channel in row.T:
            if np.all(channel == channel[0]) and w < 128:
                data += bytes([128 + w, channel[0]])
            else:
                for i in range(0, w, 128):
                    part = channel[i : i + 128].tobytes()
                    data += bytes([len(part)]) + part
    path.write_bytes(data)


@pytest.mark.parametrize("run_length", [False, True])
def test_radiance_files(tmp_path, run_length):
    env = random_env(8) * 100 + 1
    env[2] = 3.0
    write_hdr(tmp_path / "room.hdr", env, run_length)
    back = read_environment(tmp_path / "room.hdr")
    assert back.shape == env.shape
    assert np.allclose(back, env, atol=env.max() / 100)


def test_exr_files_and_resampling(tmp_path):
    env = random_env(32)
    env[3, 7] = 1e4
    write_exr(tmp_path / "a.exr", env)
    assert np.allclose(read_environment(tmp_path / "a.exr"), env)
    small = read_environment(tmp_path / "a.exr", 8)
    assert small.shape == (8, 16, 3)
    assert flux(small) == pytest.approx(flux(env), rel=1e-5)
    assert find_environments(tmp_path) == [tmp_path / "a.exr"]


def test_negative_radiance_becomes_zero(tmp_path, caplog):
    env = random_env(8)
    env[1, 1] = -1
    write_exr(tmp_path / "a.exr", env)
    with caplog.at_level(logging.WARNING, "invrender"):
        assert read_environment(tmp_path / "a.exr").min() == 0
    assert "negative" in caplog.text


@pytest.mark.parametrize(
    ("name", "make", "why"),
    [
        ("a.exr", lambda p: write_exr(p, np.ones((8, 8, 3))), "twice as wide"),
        ("a.exr", lambda p: write_exr(p, np.zeros((8, 16, 3))), "black above"),
        ("a.exr", lambda p: p.write_bytes(b"junk"), "not a readable"),
        ("a.hdr", lambda p: p.write_bytes(b"junk"), "not a readable image"),
        ("a.hdr", lambda p: p.write_bytes(b"#?RADIANCE\n\n-Y 8 +X 16\n\2\2\0\x10"), "Radiance"),
        ("a.hdr", lambda p: p.write_bytes(b"#?RADIANCE\n\n-Y 99999 +X 99999\n"), "pixels"),
        ("a.hdr", lambda p: None, "does not exist"),
    ],
)
def test_bad_files(tmp_path, name, make, why):
    make(tmp_path / name)
    with pytest.raises(InputError, match=why):
        read_environment(tmp_path / name)


def test_no_environments(tmp_path):
    with pytest.raises(InputError, match="holds no"):
        find_environments(tmp_path)
