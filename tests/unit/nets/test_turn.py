"""Turned captures against the network's own geometry, and against a scene that is built turned."""

from dataclasses import replace

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from invrender.pattern.default import block_pattern  # noqa: E402
from invrender.rig import Rig  # noqa: E402
from nets.batch import positions  # noqa: E402
from nets.clues import light_inputs  # noqa: E402
from nets.store import build  # noqa: E402
from nets.training.turn import WAYS, turned, turned_image  # noqa: E402

SIZE = 16


def room(rng):
    """A room with a lamp to one side."""
    env = 0.2 + 0.1 * rng.random((32, 64, 3))
    env[4:8, 5:9] += (20, 10, 5)
    return env.astype(np.float32)


@pytest.fixture(scope="module")
def batch():
    rng = np.random.default_rng(5)
    rig = replace(Rig(), screen_tilt=(4, -3, 6), screen_shift=(0.004, 0.008, 0.003))
    lights = light_inputs(rig, block_pattern(16, 4, rng), 3.0, room(rng))
    out = {k: torch.from_numpy(v)[None].float() for k, v in lights.items()}
    photo = torch.from_numpy(rng.random((1, 3, SIZE, SIZE), np.float32))
    maps = torch.from_numpy(rng.integers(0, 256, (1, 9, SIZE, SIZE)).astype(np.uint8))
    return {**out, "photo": photo, "maps": maps, "position": positions(SIZE, SIZE)[None]}


@pytest.mark.parametrize("way", range(WAYS))
def test_the_network_sees_the_same_scene(batch, way):
    """What a pixel mirrors of the screen and the room, and the slopes that its colour tells, turn
    with the pixel."""
    network = build("small")
    a, b = network.view(batch), network.view(turned(batch, way))
    torch.testing.assert_close(b.position, positions(SIZE, SIZE)[None])
    torch.testing.assert_close(b.mirrored, turned_image(a.mirrored, way), rtol=1e-4, atol=1e-4)
    up = torch.zeros(1, 3, SIZE, SIZE)
    up[:, 2] = 1
    for x, y in zip(*(network.normal_clues(up, v, v.batch["screen"]) for v in (a, b)), strict=True):
        torch.testing.assert_close(y, turned_image(x, way), rtol=1e-3, atol=1e-3)
    first, second = (network.slope_inputs(v)[1] for v in (a, b))
    expected = turned({"position": first}, way)["position"]
    torch.testing.assert_close(second, expected, rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("way", range(WAYS))
def test_turning_is_undone_by_its_inverse(batch, way):
    """Quarter turns undo each other, all others themselves."""
    back = {3: 5, 5: 3}.get(way, way)
    there = turned(batch, way)
    assert way == 0 or not torch.equal(there["maps"], batch["maps"])
    for k, v in turned(there, back).items():
        torch.testing.assert_close(v, batch[k])


def test_a_scene_that_is_built_turned():
    """A quarter turn: the camera at +y, the screen beside it, the lamp moved along."""
    rng = np.random.default_rng(1)
    pattern, env, rig = block_pattern(16, 4, rng), room(rng), Rig()
    x = rig.camera[0]
    centre = rig.screen_corner + sum(rig.screen_edges) / 2
    there = replace(
        rig, camera_shift=(-x, x, 0.0), screen_shift=(-float(centre[0]), float(centre[0]), 0.0)
    )
    quarter = np.roll(env, env.shape[1] // 4, axis=1)  # azimuth grows with the column
    inputs = [
        light_inputs(rig, pattern, 3.0, env),
        light_inputs(there, np.rot90(pattern).copy(), 3.0, quarter),
    ]
    a, b = ({k: torch.from_numpy(v)[None] for k, v in one.items()} for one in inputs)
    a = turned(a, 3)  # (x, y) → (-y, x)
    torch.testing.assert_close(a["rig"], b["rig"], rtol=1e-5, atol=1e-5)
    for k in ("pattern", "screen", "sky", "ball"):
        assert (a[k] - b[k]).abs().mean() < 0.02 * b[k].abs().mean(), k
    for k in ("active_clues", "env_clues"):
        assert (a[k] - b[k]).abs().mean() < 0.05 * b[k].abs().mean(), k
    error = (a["slope_clues"] - b["slope_clues"]).abs().mean()
    assert error < 0.15 * b["slope_clues"].abs().mean()
    with pytest.raises(ValueError, match="between 0 and 7"):
        turned(a, 8)
