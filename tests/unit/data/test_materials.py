"""Procedural materials, readers of material folders, and augmentation."""

import logging
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from invrender.colour import linear_to_srgb
from invrender.data.materials import (
    PRESETS,
    augment,
    check_maps,
    find_materials,
    handedness,
    is_directx,
    jitter_maps,
    load_materials,
    mix,
    normals_from_height,
    procedural_material,
    read_material,
)
from invrender.data.materials.files import material_files
from invrender.data.materials.noise import Canvas, noise
from invrender.data.materials.patterns import WEAVES, bricks, voronoi, weave
from invrender.files.maps import write_maps
from invrender.files.write import write_exr
from invrender.maps import NAMES, Maps, constant_maps, resize_maps, rotate_maps, turn_maps
from invrender.types import InputError

FIELDS = ("diffuse", "specular", "roughness", "normal")


def hills(n=64, seed=0):
    """A smooth height field (n, n) in units of pixels, with no symmetry."""
    return noise(Canvas(n, n), np.random.default_rng(seed), 7, 3) * np.float32(n / 25)


def maps_of(height):
    """Maps whose every channel differs, with the normals of a height field."""
    h, w = height.shape
    rng = np.random.default_rng(1)
    maps = constant_maps(h, w)
    return Maps(
        rng.random((h, w, 3), dtype=np.float32),
        rng.random((h, w, 3), dtype=np.float32) * np.float32(0.5),
        rng.random((h, w), dtype=np.float32) * np.float32(0.9) + np.float32(0.1),
        normals_from_height(height, 1.0) if height.any() else maps.normal,
    )


def save(path, image, bits=8):
    """(H, W[, 3]) values in [0, 1] as a PNG, TIFF or JPEG, as they are."""
    if bits == 16:
        Image.fromarray((image * 65535 + 0.5).astype(np.uint16)).save(path)
    else:
        Image.fromarray((image * 255 + 0.5).astype(np.uint8)).save(path)


# --- procedural -----------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", PRESETS)
def test_every_kind_is_valid(kind):
    for seed in range(4):
        maps = procedural_material(seed, 64, 48, kind)
        check_maps(maps)
        assert maps.shape == (64, 48)
        for name in FIELDS:
            assert getattr(maps, name).dtype == np.float32
        assert np.allclose(np.linalg.norm(maps.normal, axis=-1), 1, atol=1e-5)
        assert maps.normal[..., 2].min() > np.cos(np.radians(80))
        assert maps.roughness.min() >= 0.05
        # Energy: what is not reflected at the surface is all that can be scattered below it.
        assert (maps.diffuse + maps.specular).max() <= 1


def test_deterministic_by_seed_and_generator():
    a, b = (procedural_material(5, 40, 40) for _ in range(2))
    c, d = (procedural_material(np.random.default_rng(3), 40, 40) for _ in range(2))
    other = procedural_material(6, 40, 40)
    for name in FIELDS:
        assert np.array_equal(getattr(a, name), getattr(b, name))
        assert np.array_equal(getattr(c, name), getattr(d, name))
    assert not np.array_equal(a.diffuse, other.diffuse)


@pytest.mark.parametrize("kind", PRESETS)
def test_finer_images_show_the_same_material(kind):
    fine = resize_maps(procedural_material(2, 192, 192, kind), 96, 96)
    coarse = procedural_material(2, 96, 96, kind)
    for name in ("diffuse", "specular", "roughness"):
        a, b = getattr(coarse, name), getattr(fine, name)
        assert np.abs(a - b).mean() < 0.05
        if a.std() > 0.05:
            assert np.corrcoef(a.ravel(), b.ravel())[0, 1] > 0.7


def test_variety_of_kinds_metals_and_gloss():
    many = [procedural_material(s, 32, 32) for s in range(150)]
    metal = np.array([(m.specular.mean(-1) > 0.12).mean() for m in many])
    rough = np.array([m.roughness.mean() for m in many])
    tilt = np.array([np.percentile(np.degrees(np.arccos(m.normal[..., 2])), 95) for m in many])
    assert 0.1 < (metal > 0.5).mean() < 0.4
    assert ((metal > 0.02) & (metal < 0.98)).any()
    assert np.percentile(rough, 5) < 0.2 and np.percentile(rough, 95) > 0.75
    assert np.percentile(tilt, 10) < 4 and np.percentile(tilt, 95) > 30


def test_bad_requests():
    with pytest.raises(InputError, match="no kind of material 'cheese'"):
        procedural_material(0, 8, 8, "cheese")
    with pytest.raises(InputError, match="at least 1"):
        procedural_material(0, 0, 8)


def test_tiny_and_oblong_sizes():
    for kind in PRESETS:
        for shape in ((1, 1), (2, 9), (17, 3)):
            assert procedural_material(1, *shape, kind).shape == shape


def test_noise_has_zero_mean_and_unit_variance():
    canvas = Canvas(64, 64)
    for octaves in (1, 4):
        for at in (None, canvas.turned(0.4)):
            fields = [noise(canvas, np.random.default_rng(s), 9, octaves, at=at) for s in range(40)]
            assert abs(np.mean(fields)) < 0.12
            assert np.std(fields) == pytest.approx(1, abs=0.07)


def test_noise_at_its_own_points_is_the_same_noise():
    canvas = Canvas(64, 64)
    a = noise(canvas, np.random.default_rng(1), 5, 3)
    b = noise(canvas, np.random.default_rng(1), 5, 3, at=canvas.points)
    assert np.abs(a - b).mean() < 0.03 * a.std()


def test_cells_measure_their_borders():
    canvas = Canvas(60, 60)
    square = bricks(np.random.default_rng(0), canvas.points, 0.25, 0.25)
    assert square.inside.min() >= 0 and square.inside.max() == pytest.approx(0.125, abs=0.02)
    comb = voronoi(canvas, np.random.default_rng(0), 8, 0.0, hexagonal=True)
    # A regular hexagon whose centres are 1/8 apart reaches 1/16 to its sides.
    assert comb.inside.max() == pytest.approx(1 / 16, abs=0.01)
    assert np.hypot(comb.x, comb.y).max() == pytest.approx(1 / 16 / np.cos(np.pi / 6), abs=0.01)


@pytest.mark.parametrize("kind", WEAVES)
def test_weaves_pass_over_and_under(kind):
    height, up, _, _ = weave(Canvas(80, 80).points, 20, kind)
    assert height.min() >= 0 and height.max() <= 1.001
    assert 0.1 < up.mean() < 0.9
    assert np.all(len(row) == len(WEAVES[kind][0]) for row in WEAVES[kind])


# --- augmentation ---------------------------------------------------------------------------------


@pytest.mark.parametrize("quarters", range(4))
@pytest.mark.parametrize("mirror", [False, True])
def test_turned_normals_are_those_of_the_turned_surface(quarters, mirror):
    height = hills()
    turned = np.rot90(height[:, ::-1] if mirror else height, quarters)
    maps = turn_maps(maps_of(height), quarters, mirror)
    assert np.allclose(maps.normal, normals_from_height(turned, 1.0), atol=1e-5)


def test_free_rotation_turns_normals_counter_clockwise():
    height = hills(96)
    quarter = rotate_maps(maps_of(height), np.pi / 2, 96)
    exact = turn_maps(maps_of(height), 1)
    for name in FIELDS:
        assert np.allclose(getattr(quarter, name), getattr(exact, name), atol=2e-4)
    # A ramp that rises to the right, turned by 30 degrees, rises at 30 degrees.
    ramp = np.tile(np.arange(64, dtype=np.float32) * 0.5, (64, 1))
    normal = rotate_maps(maps_of(ramp), np.pi / 6, 40).normal[20, 20]
    assert np.arctan2(-normal[1], -normal[0]) == pytest.approx(np.pi / 6, abs=1e-4)


def test_free_rotation_must_fit():
    with pytest.raises(InputError, match="does not fit"):
        rotate_maps(maps_of(hills(32)), 0.5, 32)


def test_resizing_keeps_means_and_unit_normals():
    maps = maps_of(hills(60))
    small = resize_maps(maps, 13, 17)
    for name in ("diffuse", "specular", "roughness"):
        assert getattr(small, name).mean((0, 1)) == pytest.approx(
            getattr(maps, name).mean((0, 1)), abs=1e-5
        )
    assert np.allclose(np.linalg.norm(small.normal, axis=-1), 1, atol=1e-6)
    big = resize_maps(small, 60, 60)
    assert big.diffuse.min() >= small.diffuse.min() and big.shape == (60, 60)


def test_augment_gives_what_is_asked_for_by_seed():
    maps = maps_of(hills(80))
    for seed in range(12):
        for shape in ((32, 32), (20, 48), (120, 100)):
            a = augment(maps, np.random.default_rng(seed), *shape, free_rotation=0.5)
            check_maps(a)
            assert a.shape == shape
    b = augment(maps, np.random.default_rng(11), 120, 100, free_rotation=0.5)
    assert np.array_equal(a.normal, b.normal) and np.array_equal(a.diffuse, b.diffuse)


def test_augment_without_jitter_keeps_values():
    maps = constant_maps(50, 50, (0.1, 0.2, 0.3), 0.04, 0.4)
    piece = augment(maps, np.random.default_rng(0), 16, 16, jitter=0)
    assert np.allclose(piece.diffuse, (0.1, 0.2, 0.3), atol=1e-6)
    assert np.allclose(piece.roughness, 0.4, atol=1e-6)


def test_jitter_recolours_metals_in_specular_and_keeps_dielectric_f0():
    gold = constant_maps(4, 4, 0.0, (0.9, 0.7, 0.3))
    clay = constant_maps(4, 4, (0.4, 0.2, 0.1), 0.04)
    moved = []
    for seed in range(20):
        g, c = (jitter_maps(m, np.random.default_rng(seed)) for m in (gold, clay))
        assert not g.diffuse.any()
        moved.append(abs(g.specular - gold.specular).max() > 0.01)
        assert c.specular.min() >= 0.02 and c.specular.max() <= 0.08
    assert all(moved)
    same = jitter_maps(clay, np.random.default_rng(0), 0)
    assert np.allclose(same.diffuse, clay.diffuse) and np.allclose(same.specular, clay.specular)


def test_mix_follows_its_mask():
    a, b = constant_maps(8, 8, 0.1, 0.04, 0.2), constant_maps(8, 8, 0.5, 0.9, 0.8)
    mask = np.zeros((8, 8), np.float32)
    mask[:, 4:] = 1
    m = mix(a, b, mask)
    assert np.allclose(m.diffuse[:, 0], 0.1) and np.allclose(m.roughness[:, 7], 0.8)
    assert np.allclose(m.normal, (0, 0, 1))
    # b lies higher, to the right: the step's slope rises towards +x, its normal leans to -x.
    step = mix(a, b, mask, step=2.0)
    assert step.normal[4, 4, 0] < -0.5 and step.normal[4, 0, 0] == 0
    with pytest.raises(InputError, match="cannot mix"):
        mix(a, b, np.zeros((4, 4)))


@pytest.mark.parametrize(
    ("change", "why"),
    [
        (lambda m: m.diffuse.fill(np.nan), "NaN"),
        (lambda m: m.roughness.fill(1.5), "leaves"),
        (lambda m: m.roughness.fill(0.0), "roughness is zero"),
        (lambda m: (m.diffuse.fill(0.0), m.specular.fill(0.0)), "black"),
        (lambda m: m.diffuse.fill(1.0), "clipped"),
        (lambda m: m.normal.__imul__(0.5), "unit"),
        (lambda m: m.normal.__imul__(np.float32([1, 1, -1])), "into the surface"),
    ],
)
def test_degenerate_maps_are_named(change, why):
    maps = maps_of(hills(16))
    check_maps(maps)
    change(maps)
    with pytest.raises(InputError, match=why):
        check_maps(maps)


def test_constant_maps_are_degenerate():
    with pytest.raises(InputError, match="constant"):
        check_maps(constant_maps(8, 8))


# --- files ----------------------------------------------------------------------------------------


def write_set(folder, names, maps=None, directx=False):
    """A metal-rough set under the names for colour, normal, roughness[, metallic]."""
    folder.mkdir(parents=True, exist_ok=True)
    maps = maps or maps_of(hills(32))
    sign = np.float32([1, -1 if directx else 1, 1])
    save(folder / names[0], linear_to_srgb(maps.diffuse))
    save(folder / names[1], maps.normal * sign / 2 + 0.5)
    save(folder / names[2], maps.roughness)
    if len(names) > 3:
        save(folder / names[3], np.zeros(maps.shape))
    return maps


LAYOUTS = {
    "plain": ("basecolor.png", "normal.png", "roughness.png", "metallic.png"),
    "ambientcg": (
        "Metal009_1K-PNG_Color.png",
        "Metal009_1K-PNG_NormalGL.png",
        "Metal009_1K-PNG_Roughness.png",
        "Metal009_1K-PNG_Metalness.png",
    ),
    "polyhaven": (
        "rusty_metal_05_diff_1k.png",
        "rusty_metal_05_nor_gl_1k.png",
        "rusty_metal_05_rough_1k.png",
    ),
    "generic": ("wall_albedo.png", "wall_nrm.png", "wall_roughness.tif"),
    "camel": ("WallBaseColor.png", "WallNormal.png", "WallRoughness.png"),
    "camel and numbers": ("Wall01BaseColor.png", "Wall01NormalOpenGL.png", "Wall01Roughness.png"),
    "letters": ("wall_d.png", "wall_n.png", "wall_r.png"),
    "substance": ("Wall_Base_Color.png", "Wall_Normal_OpenGL.png", "Wall_Roughness.png"),
    "texturecan": ("wall_color_4k.png", "wall_normal_opengl_4k.png", "wall_roughness_4k.png"),
    "poliigon": (
        "Wall_COL_2K_METALNESS.png",
        "Wall_NRM_2K_METALNESS.png",
        "Wall_ROUGHNESS_2K_METALNESS.png",
    ),
    "poliigon's variants": ("Wall_COL_VAR1_3K.png", "Wall_NRM_3K.png", "Wall_ROUGHNESS_3K.png"),
    "megascans": ("vlkh_4K_Albedo.png", "vlkh_4K_Normal.png", "vlkh_4K_Roughness.png"),
    "freepbr": ("wall-albedo.png", "wall-normal-ogl.png", "wall-rough.png"),
    "maps": ("Wall_BaseMap.png", "Wall_NormalMap.png", "Wall_RoughnessMap.png"),
}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_layouts(tmp_path, layout):
    truth = write_set(tmp_path, LAYOUTS[layout])
    maps = read_material(tmp_path)
    assert np.abs(maps.diffuse - truth.diffuse).max() < 0.01
    assert np.allclose(maps.specular, 0.04, atol=1e-6)
    assert np.abs(maps.roughness - truth.roughness).max() < 0.003
    assert np.abs(maps.normal - truth.normal).max() < 0.02
    assert find_materials(tmp_path) == [tmp_path]


@pytest.mark.parametrize(
    ("target", "convention"),
    [(t, c) for t in ("unreal", "unity", "blender") for c in ("opengl", "directx")]
    + [("godot", "opengl"), ("ambientcg", "directx"), ("polyhaven", "directx")],
)
def test_our_own_exports_are_read(tmp_path, target, convention):
    from invrender.export import export

    hilly = maps_of(hills(64))
    truth = replace(hilly, diffuse=hilly.diffuse * 0.9, specular=np.full_like(hilly.diffuse, 0.04))
    (tmp_path / "maps").mkdir()
    write_maps(tmp_path / "maps", truth)
    export(tmp_path / "maps", tmp_path / "out", target, normal_convention=convention)
    folder = next(p.parent for p in (tmp_path / "out").rglob("*") if p.suffix == ".png")
    maps = read_material(folder)
    assert np.abs(maps.diffuse - truth.diffuse).max() < 0.02
    assert np.abs(maps.specular - truth.specular).max() < 0.01
    assert np.abs(maps.roughness - truth.roughness).max() < 0.006
    assert np.abs(maps.normal - truth.normal).max() < 0.02


def test_unreal_normals_without_a_clear_side_are_directx(tmp_path):
    up = np.full((16, 16, 3), 0.5)
    up[..., 1], up[..., 2] = 0.6, 0.99
    for name, image in (("BC", 0.5 + 0 * up), ("N", up), ("ORM", 0.5 + 0 * up)):
        save(tmp_path / f"T_Wall_{name}.png", image)
    assert read_material(tmp_path).normal[..., 1].max() < 0


@pytest.mark.parametrize(
    "name",
    ["Wall_EmissionColor", "wall_id", "Wall_AmbientOcclusion", "wall_h", "wall", "readme_4k"],
)
def test_other_files_play_no_role(tmp_path, name):
    truth = write_set(tmp_path, LAYOUTS["letters"])
    save(tmp_path / f"{name}.png", np.ones(truth.shape))
    assert np.abs(read_material(tmp_path).diffuse - truth.diffuse).max() < 0.01


def test_metals_convert(tmp_path):
    truth = write_set(tmp_path, LAYOUTS["plain"])
    metallic = np.zeros(truth.shape)
    metallic[:, 16:] = 1
    save(tmp_path / "metallic.png", metallic)
    maps = read_material(tmp_path)
    assert not maps.diffuse[:, 16:].any() and np.allclose(maps.specular[:, :16], 0.04)
    assert np.abs(maps.specular[:, 16:] - truth.diffuse[:, 16:]).max() < 0.01


def test_packed_arm_map(tmp_path):
    truth = write_set(tmp_path, LAYOUTS["polyhaven"])
    (tmp_path / LAYOUTS["polyhaven"][2]).unlink()
    ones = np.ones(truth.shape, np.float32)
    save(tmp_path / "rusty_metal_05_arm_1k.png", np.stack([ones, truth.roughness, ones], -1))
    maps = read_material(tmp_path)
    assert np.abs(maps.roughness - truth.roughness).max() < 0.003
    assert not maps.diffuse.any()


def test_specular_gloss_set(tmp_path):
    truth = maps_of(hills(24))
    save(tmp_path / "x_diffuse.png", linear_to_srgb(truth.diffuse))
    save(tmp_path / "x_specular.png", linear_to_srgb(truth.specular))
    save(tmp_path / "x_glossiness.png", 1 - truth.roughness)
    save(tmp_path / "x_normal.png", truth.normal / 2 + 0.5)
    maps = read_material(tmp_path)
    assert np.abs(maps.specular - truth.specular).max() < 0.01
    assert np.abs(maps.roughness - truth.roughness).max() < 0.003


def test_matsynth_takes_the_base_colour(tmp_path):
    truth = write_set(tmp_path, LAYOUTS["plain"])
    save(tmp_path / "diffuse.png", np.zeros((8, 8, 3)))
    save(tmp_path / "specular.png", np.zeros((8, 8, 3)))
    save(tmp_path / "height.png", np.zeros((8, 8)))
    assert np.abs(read_material(tmp_path).diffuse - truth.diffuse).max() < 0.01


def test_our_own_files(tmp_path):
    truth = maps_of(hills(16))
    write_maps(tmp_path, truth)
    maps = read_material(tmp_path)
    for name in FIELDS:
        assert np.allclose(getattr(maps, name), getattr(truth, name), atol=1e-5)
    assert read_material(tmp_path, max_size=8).shape == (8, 8)


def test_a_results_expected_errors_are_no_maps(tmp_path):
    maps = procedural_material(5, 16, 16, kind="plastic")
    write_maps(tmp_path, maps)
    for name in NAMES:
        write_exr(tmp_path / f"sigma_{name}.exr", np.full((16, 16, 3), 0.01))
    (tmp_path / "roughness.exr").unlink()
    with pytest.raises(InputError, match="no roughness map"):
        read_material(tmp_path)
    save(tmp_path / "roughness.png", maps.roughness)
    np.testing.assert_allclose(read_material(tmp_path).roughness, maps.roughness, atol=0.01)
    # Without its specular map a result would pass for a dielectric.
    (tmp_path / "report.json").write_text("{}")
    (tmp_path / "specular.exr").unlink()
    with pytest.raises(InputError, match="without its specular map"):
        read_material(tmp_path)


def test_opengl_is_preferred_where_both_exist(tmp_path):
    truth = write_set(tmp_path, LAYOUTS["ambientcg"])
    save(tmp_path / "Metal009_1K-PNG_NormalDX.png", truth.normal * [1, -1, 1] / 2 + 0.5)
    assert material_files(tmp_path)["normal"].name.endswith("NormalGL.png")


@pytest.mark.parametrize("name", ["a_NormalDX.png", "a_nor_dx_2k.png", "a_Normal_DirectX.png"])
def test_directx_by_name(tmp_path, caplog, name):
    truth = write_set(tmp_path, ("a_color.png", name, "a_rough.png"), directx=True)
    with caplog.at_level(logging.INFO, "invrender"):
        maps = read_material(tmp_path)
    assert np.abs(maps.normal - truth.normal).max() < 0.02
    assert "DirectX" in caplog.text and "by its name" in caplog.text


def test_directx_by_its_slopes(tmp_path, caplog):
    truth = write_set(tmp_path, LAYOUTS["plain"], maps_of(hills(64)), directx=True)
    with caplog.at_level(logging.INFO, "invrender"):
        maps = read_material(tmp_path)
    assert np.abs(maps.normal - truth.normal).max() < 0.02
    assert "as its slopes show" in caplog.text


def test_handedness_is_unknown_where_nothing_tells():
    flat = constant_maps(64, 64).normal
    ridges = normals_from_height(
        np.sin(np.arange(64, dtype=np.float32))[None] * np.ones((64, 1)), 1
    )
    rng = np.random.default_rng(0)
    junk = rng.normal(size=(64, 64, 3)).astype(np.float32) * 0.2 + np.float32([0, 0, 1])
    junk /= np.linalg.norm(junk, axis=-1, keepdims=True)
    for normal in (flat, ridges, junk, flat[:4, :4]):
        assert abs(handedness(normal)) < 0.2 and not is_directx(normal)
    surface = normals_from_height(hills(), 1.0)
    assert handedness(surface) > 0.4
    assert handedness(surface * np.float32([1, -1, 1])) < -0.4


def test_procedural_surfaces_are_never_taken_for_directx():
    for seed in range(60):
        assert not is_directx(procedural_material(seed, 96, 96).normal)


def test_grey_16_bit_and_other_sizes(tmp_path, caplog):
    truth = write_set(tmp_path, LAYOUTS["plain"])
    save(tmp_path / "basecolor.png", np.full(truth.shape, 0.5))
    save(tmp_path / "roughness.png", np.full((64, 64), 0.25), bits=16)
    with caplog.at_level(logging.INFO, "invrender"):
        maps = read_material(tmp_path)
    assert maps.shape == truth.shape
    assert np.allclose(maps.roughness, 0.25, atol=1e-3)
    assert np.allclose(maps.diffuse, 0.214, atol=2e-3)  # 128/255 in sRGB
    assert "resized from 64 × 64 to 32 × 32" in caplog.text


def test_large_maps_are_averaged_down(tmp_path):
    write_set(tmp_path, LAYOUTS["plain"], maps_of(hills(64)))
    assert read_material(tmp_path, max_size=16).shape == (16, 16)


@pytest.mark.parametrize(("missing", "what"), [(0, "colour"), (1, "normal"), (2, "roughness")])
def test_missing_maps_are_named(tmp_path, missing, what):
    write_set(tmp_path, LAYOUTS["plain"])
    (tmp_path / LAYOUTS["plain"][missing]).unlink()
    with pytest.raises(InputError, match=f"no {what} map"):
        read_material(tmp_path)


def test_what_is_no_normal_map(tmp_path):
    write_set(tmp_path, LAYOUTS["plain"])
    save(tmp_path / "normal.png", np.full((32, 32, 3), 0.2))
    with pytest.raises(InputError, match="does not look like"):
        read_material(tmp_path)


def test_two_channel_normals(tmp_path):
    truth = write_set(tmp_path, LAYOUTS["plain"])
    stored = truth.normal / 2 + 0.5
    stored[..., 2] = 0
    save(tmp_path / "normal.png", stored)
    assert np.abs(read_material(tmp_path).normal - truth.normal).max() < 0.05


def test_a_library_with_broken_folders(tmp_path, caplog):
    write_set(tmp_path / "good", LAYOUTS["plain"])
    write_set(tmp_path / "nested" / "good", LAYOUTS["ambientcg"])
    write_set(tmp_path / "corrupt", LAYOUTS["plain"])
    (tmp_path / "corrupt" / "normal.png").write_bytes(b"\x89PNG\r\n\x1a\nbroken")
    write_set(tmp_path / "rough_missing", LAYOUTS["plain"])
    (tmp_path / "rough_missing" / "roughness.png").unlink()
    write_set(tmp_path / "black", LAYOUTS["plain"])
    save(tmp_path / "black" / "basecolor.png", np.zeros((32, 32, 3)))
    save(tmp_path / "black" / "metallic.png", np.ones((32, 32)))
    (tmp_path / "empty").mkdir()
    write_exr(tmp_path / "empty" / "photo.exr", np.ones((2, 2, 3)))
    with caplog.at_level(logging.WARNING, "invrender"):
        found = [p.relative_to(tmp_path).as_posix() for p, _ in load_materials(tmp_path)]
    assert found == ["good", "nested/good"]
    assert caplog.text.count("left out") == 3
    assert all(w in caplog.text for w in ("corrupt", "no roughness map", "is black"))


def test_no_materials(tmp_path):
    with pytest.raises(InputError, match="no material folders"):
        find_materials(tmp_path)
    with pytest.raises(InputError, match="not a folder"):
        read_material(tmp_path / "nowhere")
