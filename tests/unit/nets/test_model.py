import json
from dataclasses import replace

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from safetensors.torch import save_file  # noqa: E402

from invrender.data.environments import procedural_environment  # noqa: E402
from invrender.lights import Lights  # noqa: E402
from invrender.maps import constant_maps  # noqa: E402
from invrender.pattern.default import block_pattern  # noqa: E402
from invrender.refine.evidence import MaterialEvidence  # noqa: E402
from invrender.render.scene import make_scene  # noqa: E402
from invrender.rig import Rig  # noqa: E402
from invrender.sphere import scale_environment  # noqa: E402
from invrender.types import InputError  # noqa: E402
from nets import clues, slopes, splitsum  # noqa: E402
from nets.batch import (  # noqa: E402
    COST_COUNT,
    EVIDENCE,
    EVIDENCE_CHANNELS,
    pack_evidence,
    positions,
    unpack_evidence,
)
from nets.blocks import NAFBlock, Upsample, pad_to  # noqa: E402
from nets.model import DIELECTRIC_F0, Network, normalise  # noqa: E402
from nets.predict import WEIGHTS, Reconstructor  # noqa: E402
from nets.store import build, load_weights, save_weights  # noqa: E402

RIG = Rig()
UNITLESS = ("position", "rig", "lobes", "evidence", "costs")
torch.set_num_threads(1)  # small tensors: more only get in each other's way


@pytest.fixture(scope="module")
def lights():
    env = scale_environment(procedural_environment(5, 32), 0.5)
    return clues.light_inputs(RIG, block_pattern(64), [1.0, 0.9, 1.1], env, samples=16)


def make_batch(lights, height, width, count=1, seed=0):
    rng = np.random.default_rng(seed)
    batch = {k: torch.from_numpy(v)[None].repeat(count, *[1] * v.ndim) for k, v in lights.items()}
    photo = rng.random((count, 3, height, width), np.float32) * 0.3
    batch["photo"] = torch.from_numpy(photo)
    batch["position"] = positions(height, width)[None].repeat(count, 1, 1, 1)
    for key, channels in (("lobes", 7), ("evidence", EVIDENCE_CHANNELS)):
        images = rng.random((count, channels, height, width), np.float32)
        batch[key] = torch.from_numpy(images)
    batch["costs"] = torch.from_numpy(rng.random((count, COST_COUNT), np.float32))
    return batch


def shaken(network, seed=0):
    """Fresh blocks are the identity: give every parameter a share."""
    torch.manual_seed(seed)
    with torch.no_grad():
        for name, p in network.named_parameters():
            if name.endswith(("beta", "gamma")):
                p.normal_(0, 0.3)
    return network.eval()


def radiance_of(scene, maps):
    from invrender.render import Fast, Material
    from invrender.render.scene import make_view

    view = make_view(scene, *maps.shape)
    return np.asarray(Fast(scene).radiance(view, Material.from_maps(maps), 64)).T.reshape(
        *maps.shape, 3
    )


# --- blocks ---------------------------------------------------------------------------------------


def test_fresh_block_is_the_identity():
    x = torch.randn(2, 8, 6, 6)
    block = NAFBlock(8)
    torch.testing.assert_close(block(x), x)
    assert not torch.allclose(shaken(block)(x), x)


def test_block_is_the_formula():
    """The fused form against y = x + β·W₃(SCA(SG(DW(W₁ LN x)))), z = y + γ·W₅(SG(W₄ LN y))."""
    block = shaken(NAFBlock(4)).double()
    x = torch.randn(2, 4, 5, 7, dtype=torch.float64)

    def point(m, u):
        return torch.einsum("oc,bchw->bohw", m.weight, u) + m.bias[:, None, None]

    def norm(m, u):
        centred = u - u.mean(1, keepdim=True)
        v = centred / torch.sqrt((centred**2).mean(1, keepdim=True) + 1e-6)
        return v * m.weight[:, None, None] + m.bias[:, None, None]

    u = block.depthwise(point(block.conv1, norm(block.norm1, x)))
    u = u[:, :4] * u[:, 4:]
    u = u * point(block.attention, u.mean((2, 3), keepdim=True))
    y = x + block.beta[:, None, None] * point(block.conv3, u)
    u = point(block.conv4, norm(block.norm2, y))
    z = y + block.gamma[:, None, None] * point(block.conv5, u[:, :4] * u[:, 4:])
    torch.testing.assert_close(block(x), z)


def test_padding_repeats_the_border():
    x = torch.arange(6.0).reshape(1, 1, 2, 3)
    y = pad_to(x, 4)
    assert y.shape == (1, 1, 4, 4)
    assert y[0, 0, 3].tolist() == [3, 4, 5, 5]
    assert pad_to(torch.ones(1, 1, 1, 1), 16).shape == (1, 1, 16, 16)


def test_upsampling_is_torchs_pixel_shuffle():
    up, x = Upsample(4), torch.randn(2, 8, 3, 5)
    expected = torch.pixel_shuffle(torch.einsum("oc,bchw->bohw", up[0].weight, x), 2)
    torch.testing.assert_close(up(x), expected)


# --- light ----------------------------------------------------------------------------------------


def test_dark_screen_hides_the_room():
    """With no gain the screen still blocks the light behind it."""
    pattern, room = np.ones((32, 32, 3)), np.ones((16, 32, 3))
    free = clues.plane_clues(make_scene(RIG, None, room), 8, 16)[0][..., 9:]
    dark = clues.plane_clues(make_scene(RIG, pattern, room, gain=0.0), 8, 16)[0][..., 9:]
    lit = clues.plane_clues(make_scene(RIG, pattern, None), 8, 16)[0][..., 9:]
    # White room and white screen of the same radiance: what is hidden is what the screen adds.
    np.testing.assert_allclose(dark + lit, free, rtol=0.02)
    assert dark.max() < 0.85 * free.min()


def test_mirror_clue_is_the_pattern_where_the_pixel_looks():
    """A glossy white material over a half-red screen: red on the side whose mirror ray hits red."""
    pattern = np.zeros((32, 32, 3))
    pattern[:, :16, 0] = 1  # red at -x
    pattern[:, 16:, 1] = 1
    image = clues.plane_clues(make_scene(RIG, pattern, None), 16, 64)[0][..., :3]
    assert np.all(image[4:12, 2, 0] > 3 * image[4:12, 2, 1])
    assert np.all(image[4:12, 13, 1] > 3 * image[4:12, 13, 0])


def test_slope_clues_are_derivatives():
    """Against a rough white plane that is tilted a little, lit by the room and the screen."""
    env = scale_environment(procedural_environment(5, 32), 0.5)
    lit = clues.light_inputs(RIG, block_pattern(64), 1.0, env, size=8)
    scene = make_scene(RIG, block_pattern(64), env)
    for k, slope in enumerate(((0.02, 0.0), (0.0, 0.02))):
        ends = []
        for sign in (-1, 1):
            normal = np.array([sign * slope[0], sign * slope[1], 1.0])
            maps = constant_maps(8, 8, 0.6, 0.0, 0.6, normal / np.linalg.norm(normal))
            ends.append(radiance_of(scene, maps))
        difference = ((ends[1] - ends[0]) / 0.04).transpose(2, 0, 1)
        clue = lit["slope_clues"][9 * k : 9 * k + 3]
        assert np.abs(clue - difference).max() < 0.03 * np.abs(difference).max()


def test_slopes_are_found_in_coloured_shading():
    """Random slopes under known derivatives, with and without grey texture on top."""
    torch.manual_seed(0)
    g_p, g_q = 2 * torch.randn(2, 1, 3, 64, 64)
    slope = 0.2 * torch.randn(1, 2, 64, 64)
    detail = g_p * slope[:, :1] + g_q * slope[:, 1:]
    found = slopes.posteriors(detail, g_p, g_q, [(0.05, 0.03)])[0]
    assert (found - slope).std() < 0.15 * slope.std()
    textured = detail + 0.3 * torch.randn(1, 1, 64, 64)
    plain = slopes.posteriors(textured, g_p, g_q, [(0.05, 0.03)])[0]
    aware = slopes.posteriors(textured, g_p, g_q, [(0.3, 0.03)])[0]
    assert (aware - slope).std() < 0.5 * (plain - slope).std()


def test_asinh_is_torchs():
    x = torch.tensor([-100.0, -1.0, -1e-4, 0.0, 1e-3, 3.0, 100.0])
    torch.testing.assert_close(slopes.asinh(x), torch.asinh(x), rtol=1e-6, atol=2e-7)


def test_slope_posterior_is_the_formula():
    d, g_p, g_q = torch.randn(3, 1, 3, 4, 4, dtype=torch.float64)
    g = torch.stack([g_p, g_q], -1).permute(0, 2, 3, 1, 4)
    prior, noise = slopes.SLOPE**2, 0.03**2 + slopes.LOG_NOISE**2
    spread = prior * g @ g.mT + 0.3**2 * torch.ones(3, 3) + noise * torch.eye(3)
    dense = prior * g.mT @ torch.linalg.solve(spread, d.permute(0, 2, 3, 1)[..., None])
    torch.testing.assert_close(
        slopes.posteriors(d, g_p, g_q, [(0.3, 0.03)])[0], dense[..., 0].permute(0, 3, 1, 2)
    )


def test_six_materials_from_four():
    rng = np.random.default_rng(0)
    e, b, a = rng.random((3, 4, 4, 3))
    of = lambda k_d: e * k_d + b * (0.6 - k_d) + a  # noqa: E731
    four = np.concatenate([of(0), of(0.6), of(0), of(0.6)], -1)
    np.testing.assert_allclose(clues.six(four)[..., 3:6], of(0.2))


def test_prefilter_keeps_a_constant_sky():
    levels = splitsum.prefilter_sky(np.full((16, 32, 3), 2.0), (0.2, None))
    centre = levels[:, 18:22, 18:22]
    np.testing.assert_allclose(centre, 2, rtol=0.01)
    assert splitsum.prefilter_sky(np.ones((8, 16, 3))).shape[0] == 8


def test_prefilter_screen_keeps_an_even_screen():
    """Near by it fills the lobe; far off it does not, and beside it there is only a tail."""
    near, far = (
        splitsum.prefilter_screen(np.full((32, 32, 3), 3.0), (0.2, 0.6), h)[..., 0]
        for h in (0.5, 2.0)
    )
    assert near[0, 24, 24] == pytest.approx(3, rel=0.05)
    assert near[0, 24, 24] > far[0, 24, 24] > far[1, 24, 24]
    assert near[0, 24, 2] < 0.1


def test_table_is_what_the_file_holds():
    np.testing.assert_allclose(splitsum.brdf_table(), splitsum.compute_brdf_table(), atol=1e-6)


def test_table_conserves_energy():
    """A white surface reflects nearly all when smooth, and never more than comes."""
    total = splitsum.brdf_table().sum(0)
    assert total.max() <= 1 + 1e-4
    assert total[0, 1:].min() > 0.99


def test_split_sum_resembles_the_exact_light():
    """On a plane without a screen, and of the screen alone."""
    env = scale_environment(procedural_environment(11, 64, kind="sky"), 0.5)
    lit = clues.light_inputs(RIG, block_pattern(64), 1.0, None)
    stack = splitsum.prefilter_sky(env, (*clues.CLUE_RHO, None))
    lit["sky"] = np.concatenate(list(stack), -1).transpose(2, 0, 1)
    exact = clues.plane_clues(make_scene(RIG, None, env), 12, 64)[0].transpose(2, 0, 1)
    b = make_batch(lit, 12, 12)
    up = torch.zeros(1, 3, 12, 12)
    up[:, 2] = 1
    at, rig = b["position"], b["rig"]
    images, active = splitsum.normal_clues(
        up, at, splitsum.view_directions(at, rig), rig, b["sky"], b["screen"],
        splitsum.brdf_table(), clues.BASIS,
    )  # fmt: skip
    for k in range(4):
        ratio = images[0, 3 * k : 3 * k + 3].mean() / exact[3 * k : 3 * k + 3].mean()
        assert 0.85 < ratio < 1.15, clues.BASIS[k]
    shown = splitsum.sample(b["active_clues"], b["position"])
    assert (active[:, :3] - shown[:, :3]).abs().mean() < 0.15 * shown[:, :3].mean()


def test_mask_hides_the_union():
    """The zenith is behind the screen, the far side is not, and nothing comes from below."""
    env = splitsum.mask_environment(np.ones((32, 64, 3)), RIG)
    assert env[1].max() == 0 and env[16:].max() == 0
    assert env[13].min() == 1


def test_split_sum_gradients():
    """Against central differences in float64."""
    torch.manual_seed(0)
    grid = lambda c, s: torch.nn.functional.interpolate(  # noqa: E731
        torch.rand(1, c, 4, 4, dtype=torch.float64), (s, s), mode="bicubic"
    )
    sky, screen = grid(9, 16), grid(6, 16)
    rig = torch.from_numpy(splitsum.pack_rig(RIG)).double()[None]
    position = positions(3, 3)[None].double()
    to_camera = splitsum.view_directions(position, rig)
    table = splitsum.brdf_table().double()
    slope = (0.3 * torch.randn(1, 2, 3, 3, dtype=torch.float64)).requires_grad_()
    weights = torch.rand(1, 18, 3, 3, dtype=torch.float64)

    def f(p):
        n = torch.nn.functional.normalize(torch.cat([p, torch.ones_like(p[:, :1])], 1), dim=1)
        images, active = splitsum.normal_clues(
            n, position, to_camera, rig, sky, screen, table, clues.BASIS
        )
        return (torch.cat([images, active], 1) * weights).sum()

    f(slope).backward()
    eps = 1e-7
    with torch.no_grad():
        for i in range(slope.numel()):
            d = torch.zeros_like(slope)
            d.view(-1)[i] = eps
            numeric = (f(slope + d) - f(slope - d)) / (2 * eps)
            assert slope.grad.view(-1)[i] == pytest.approx(float(numeric), rel=1e-5, abs=1e-6)


# --- network --------------------------------------------------------------------------------------


def test_maps_have_the_photos_size(lights):
    network = shaken(build("tiny"))
    out = network(make_batch(lights, 9, 13, count=2))
    assert out["normal"].shape == (2, 3, 9, 13) and out["roughness"].shape == (2, 1, 9, 13)
    assert out["sigma"].shape == (2, 4, 9, 13) and out["sigma"].min() > 0
    assert all(torch.isfinite(v).all() for v in out.values())
    torch.testing.assert_close(out["normal"].norm(dim=1), torch.ones(2, 9, 13))


def test_presets_build():
    assert sum(p.numel() for p in build("small").parameters()) < 6e6
    with pytest.raises(InputError, match="no preset"):
        build("huge")


def test_exposure_does_not_matter(lights):
    """All radiance in another unit: the same maps."""
    network = shaken(build("tiny"))
    a = make_batch(lights, 8, 8)
    b = {k: v if k in UNITLESS else v * 1e3 for k, v in a.items()}
    c = {k: v if k in UNITLESS else v * 1e-4 for k, v in a.items()}
    expected = network(a)
    for other in (network(b), network(c)):
        for k, v in expected.items():
            torch.testing.assert_close(other[k], v, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("value", [0.0, 1e9, float("nan"), float("inf")])
@pytest.mark.parametrize("dark", [False, True])
def test_nan_never_leaves(lights, value, dark):
    network = shaken(build("tiny"))
    batch = make_batch(lights, 8, 8)
    batch["photo"][..., 2:5] = value
    if dark:
        batch = {k: v if k in ("position", "rig", "photo") else v * 0 for k, v in batch.items()}
    assert all(torch.isfinite(v).all() for v in network(batch).values())


def test_training_mode_passes_gradients_everywhere(lights):
    network = shaken(build("tiny")).train()
    out = network(make_batch(lights, 8, 8, count=2))
    sum(v.square().sum() for v in out.values()).backward()
    for name, p in network.named_parameters():
        assert p.grad is not None and torch.isfinite(p.grad).all(), name


def test_white_plane_is_the_unit(lights):
    batch = normalise(make_batch(lights, 4, 4))
    white = batch["env_clues"][:, 9:12] + batch["active_clues"][:, 9:12]
    assert float(white.mean()) == pytest.approx(0.6)
    assert clues.white_level(lights) > clues.white_level(lights, environment=False) > 0


def test_weights_come_back(lights, tmp_path):
    network = shaken(build("tiny"))
    save_weights(tmp_path / "w.safetensors", network, {"step": 3})
    again, notes = load_weights(tmp_path / "w.safetensors")
    assert notes == {"step": 3} and again.config == network.config
    batch = make_batch(lights, 8, 8)
    torch.testing.assert_close(again(batch)["diffuse"], network(batch)["diffuse"])
    save_weights(tmp_path / "h.safetensors", network, {}, half=True)
    half, _ = load_weights(tmp_path / "h.safetensors")
    torch.testing.assert_close(half(batch)["diffuse"], network(batch)["diffuse"], atol=0.01, rtol=0)


def old_header(tmp_path, **changes):
    """The shipped weights with the header of version 0.1."""
    tensors = {
        k: v.half().contiguous()
        for k, v in load_weights(WEIGHTS / "small.safetensors")[0].state_dict().items()
    }
    config = {"width": 16, "encoder": [1, 1, 2, 4], "middle": 4, "decoder": [1, 1, 1, 1]}
    config |= {"clues": "full", "active": True, "slopes": True, "lobes": True}
    config |= {"clue_skips": True, "narrow_fusion": True, "denoiser": False, "correction": False}
    path = tmp_path / "old.safetensors"
    save_file(tensors, path, {"config": json.dumps({**config, **changes}), "notes": "{}"})
    return path


def test_headers_of_version_0_1_are_read(tmp_path):
    network, _ = load_weights(old_header(tmp_path))
    assert type(network) is Network and network.config.encoder == (1, 1, 2, 4)
    with pytest.raises(InputError, match="ablation"):
        load_weights(old_header(tmp_path, clues="none"))


@pytest.mark.parametrize("metal", [False, True])
def test_material_maps_are_the_photos_evidence_where_trusted(lights, metal):
    """With all weight on one case, the maps are those of the dielectric, or of bare metal."""
    network = shaken(build("tiny"))
    ending = network.material_decoder.ending
    with torch.no_grad():
        ending.weight[13:] = 0
        ending.bias[13:] = torch.tensor([-40.0, 40.0] if metal else [40.0, -40.0]).repeat(3)
    batch = make_batch(lights, 8, 8)
    out, evidence = network(batch), unpack_evidence(batch)
    black = torch.zeros(1, 3, 8, 8)
    specular = evidence.metal_material_specular if metal else black + DIELECTRIC_F0
    rough = evidence.metal_roughness if metal else evidence.dielectric_roughness
    torch.testing.assert_close(out["diffuse"], black if metal else evidence.dielectric_diffuse)
    torch.testing.assert_close(out["specular"], specular)
    torch.testing.assert_close(out["roughness"], rough.clamp(min=0.02))


def test_evidence_is_packed_and_unpacked():
    """Every field comes back, in a place of its own; the model's weights depend on the order."""
    rng = np.random.default_rng(0)
    images = {k: rng.random((4, 5, n) if n > 1 else (4, 5)) for k, n in EVIDENCE.items()}
    costs = {k: rng.random((2, 10)) for k in ("residual_costs", "texture_costs")}
    packed = pack_evidence(MaterialEvidence(**images, **costs))
    assert packed["evidence"].shape == (16, 4, 5) and packed["costs"].shape == (40,)
    np.testing.assert_allclose(packed["evidence"][4:7], images["metal_specular"].transpose(2, 0, 1))
    np.testing.assert_allclose(packed["evidence"][9], images["sample_odds"], rtol=1e-6)
    again = unpack_evidence({k: torch.from_numpy(v)[None] for k, v in packed.items()})
    for k, v in images.items():
        got = getattr(again, k)[0].permute(1, 2, 0).numpy()
        np.testing.assert_allclose(got, np.atleast_3d(v), rtol=1e-6, err_msg=k)
    for k, v in costs.items():
        np.testing.assert_allclose(getattr(again, k)[0], v, rtol=1e-6)


@pytest.mark.parametrize("content", [b"", b"nothing of the kind", None])
def test_bad_weights_are_refused(tmp_path, content):
    path = tmp_path / "w.safetensors"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(InputError, match=r"w\.safetensors"):
        load_weights(path)


# --- inference ------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def reconstructor(tmp_path_factory):
    path = tmp_path_factory.mktemp("weights") / "w.safetensors"
    save_weights(path, shaken(build("tiny")), {})
    return Reconstructor(path)


@pytest.mark.parametrize("shape", [(1, 1), (17, 30), (5, 64)])
def test_inference_at_any_size(reconstructor, shape):
    rng = np.random.default_rng(0)
    env = scale_environment(procedural_environment(5, 32), 0.5)
    steps = []
    result = reconstructor(
        rng.random((*shape, 3)), Lights(RIG, block_pattern(64), env), progress=steps.append
    )
    assert result.maps.shape == shape and set(result.sigma) == set(result.maps.encoded())
    assert all(v.shape == shape and (v > 0).all() for v in result.sigma.values())
    for v in (result.maps.diffuse, result.maps.specular, result.maps.roughness):
        assert v.min() >= 0 and v.max() <= 1
    assert steps[0] == 0 and steps[-1] == 1 and steps == sorted(steps)


def test_lobes_are_those_of_the_photo_in_any_unit(reconstructor):
    """What the network is told of the lobes is the fit, which the correction takes over."""
    env = scale_environment(procedural_environment(5, 32), 0.5)
    maps = constant_maps(24, 24, diffuse=0.3, roughness=0.3, specular=0.04)
    photo = radiance_of(make_scene(RIG, block_pattern(64), env, 1.0), maps)
    found = reconstructor(photo, Lights(RIG, block_pattern(64), env)).lobes.maps
    assert np.abs(found.diffuse - 0.3).mean() < 0.03
    assert np.abs(found.roughness - 0.3).mean() < 0.1
    for k in (1e-9, 1e9):
        again = reconstructor(photo * k, Lights(RIG, block_pattern(64), env * k, k)).lobes.maps
        np.testing.assert_allclose(again.roughness, found.roughness)
        np.testing.assert_allclose(again.diffuse, found.diffuse, atol=1e-3)


def test_inference_without_a_room_or_with_a_bad_photo(reconstructor):
    result = reconstructor(np.zeros((8, 8, 3)), Lights(RIG, block_pattern(64)))
    assert np.isfinite(result.maps.diffuse).all()
    with pytest.raises(InputError, match="photo"):
        reconstructor(np.zeros((8, 8)), Lights(RIG, block_pattern(64)))


def test_rig_in_other_units(lights):
    """Lengths enter in units of the sample: a rig ten times as large gives the same numbers."""
    big = replace(
        RIG,
        screen_size=RIG.screen_size * 10,
        screen_height=RIG.screen_height * 10,
        camera_offset=RIG.camera_offset * 10,
    )
    np.testing.assert_allclose(splitsum.pack_rig(big), splitsum.pack_rig(RIG), rtol=1e-6)
