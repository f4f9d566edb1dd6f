import csv
import json
import shutil
from dataclasses import replace

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from safetensors.numpy import load_file, save_file  # noqa: E402

from invrender.data.materials import augment  # noqa: E402
from invrender.files.maps import write_maps  # noqa: E402
from invrender.files.write import write_exr  # noqa: E402
from invrender.lights import IDEAL  # noqa: E402
from invrender.maps import constant_maps  # noqa: E402
from invrender.pattern.default import block_pattern  # noqa: E402
from invrender.tasks import map_tasks  # noqa: E402
from invrender.types import InputError  # noqa: E402
from nets.batch import positions  # noqa: E402
from nets.model import MAPS  # noqa: E402
from nets.store import build, load_weights  # noqa: E402
from nets.training import dataset as data  # noqa: E402
from nets.training import draw, gpu, noise, sheet, train  # noqa: E402
from nets.training.calibrate import calibrate  # noqa: E402
from nets.training.loader import batches, read_batch, shards  # noqa: E402
from nets.training.loss import SPREADS, compare, total_loss, truth  # noqa: E402
from nets.training.sheet import problems  # noqa: E402

OPTIONS = data.Options(size=16, samples=8, seed=3)
torch.set_num_threads(1)  # small tensors: more only get in each other's way


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    out = tmp_path_factory.mktemp("shards")
    for i in range(2):
        data.write_shard(out, i, OPTIONS, 6)
    return out


# --- shards ---------------------------------------------------------------------------------------


def test_a_shard_holds_captures_in_units_of_white(folder):
    shard = load_file(shards(folder)[0])
    assert shard["photo"].shape == (6, 3, 16, 16) and shard["maps"].shape == (6, 9, 16, 16)
    assert shard["maps"].dtype == np.uint8 and shard["photo"].dtype == np.float16
    white = shard["env_clues"][:, 9:].astype(float) + shard["active_clues"][:, 9:]
    np.testing.assert_allclose(white.mean((1, 2, 3)), 0.6, rtol=0.01)
    assert all(np.isfinite(v.astype(float)).all() for v in shard.values())
    assert (
        shard["lobes"].shape == (6, 7, 16, 16)
        and 0 <= shard["lobes"].min() <= shard["lobes"].max() <= 1
    )
    assert shard["evidence"].shape == (6, 16, 16, 16) and shard["costs"].shape == (6, 40)
    assert 0.01 < shard["photo"].astype(float).mean() < 1


def test_a_shard_is_read_as_it_was_made(folder):
    """Whatever the memory order of the captures' arrays."""
    made = data.captures(OPTIONS, 0)
    shard = load_file(shards(folder)[0])
    for i in range(len(shard["photo"])):
        for k, v in next(made).items():
            np.testing.assert_array_equal(shard[k][i], v, err_msg=k)


def test_shards_are_reproducible_and_differ(folder, tmp_path):
    again = load_file(data.write_shard(tmp_path, 1, OPTIONS, 6))
    first, second = (load_file(p) for p in shards(folder))
    for k, v in second.items():
        np.testing.assert_array_equal(again[k], v)
    assert np.any(first["maps"] != second["maps"])
    other = load_file(data.write_shard(tmp_path, 2, replace(OPTIONS, seed=4), 2))
    assert np.any(other["maps"][:2] != first["maps"][:2])


def test_what_is_there_is_not_made_again(folder):
    path = shards(folder)[0]
    before = path.stat().st_mtime_ns
    assert data.write_shard(folder, 0, OPTIONS, 6) == path
    assert path.stat().st_mtime_ns == before
    assert not list(folder.glob("*.part")) and not list(folder.glob(".*.part"))


def command(monkeypatch, *words):
    monkeypatch.setattr("sys.argv", ["data", *map(str, words)])
    return data.main()


SMALL = ("--size", 8, "--samples", 2, "--workers", 1)


def test_command_makes_what_is_missing(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(data, "_single_thread", lambda: None)
    monkeypatch.setattr(data, "SHARD", 2)
    options = ("--out", tmp_path, "--count", 5, "--first", 3, *SMALL)
    assert command(monkeypatch, *options) == 0
    names = [f"shard_{i:06d}.safetensors" for i in (3, 4, 5)]
    assert [p.name for p in shards(tmp_path)] == names
    assert [len(load_file(p)["photo"]) for p in shards(tmp_path)] == [2, 2, 1]
    before = [p.stat().st_mtime_ns for p in shards(tmp_path)]
    whole = load_file(tmp_path / names[1])
    (tmp_path / names[1]).unlink()
    assert command(monkeypatch, *options) == 0
    after = [p.stat().st_mtime_ns for p in shards(tmp_path)]
    assert [a == b for a, b in zip(after, before, strict=True)] == [True, False, True]
    again = load_file(tmp_path / names[1])
    assert all(np.array_equal(again[k], whole[k]) for k in whole)
    # A shard that cannot be written does not stop the others.
    (tmp_path / names[0]).unlink()
    write = data.write_shard
    monkeypatch.setattr(data, "write_shard", lambda f, i, *a: write(f, i, *a) if i != 3 else 1 / 0)
    capsys.readouterr()
    assert command(monkeypatch, *options) == 1
    assert "shard 3 failed: division by zero" in capsys.readouterr().out


@pytest.mark.parametrize(
    "words, why",
    [
        (("--materials", "nowhere"), "not a folder"),
        (("--envs", "nowhere"), "no .exr or .hdr"),
        (("--pattern", "nowhere.png"), "nowhere.png"),
        (("--procedural", 2), "share"),
        (("--size", 0), "positive"),
        (("--fold", "3/2"), "fold"),
        (("--follow", "--keep", 0), "--keep"),
    ],
)
def test_command_refuses_bad_input_before_it_starts(words, why, tmp_path, monkeypatch, capsys):
    assert command(monkeypatch, "--out", tmp_path / "new", *SMALL, *words) == 2
    assert why in capsys.readouterr().out and not (tmp_path / "new").exists()


def test_following_never_ends_and_bounds_the_disk(tmp_path, monkeypatch):
    """Always new shards after the newest, and of the old ones at most so many."""
    monkeypatch.setattr(data, "_single_thread", lambda: None)
    monkeypatch.setattr(data, "SHARD", 1)
    monkeypatch.setattr(data, "ROUND", 2)
    rounds, drop_old = [], data.drop_old

    def until_three_rounds(folder, keep):
        drop_old(folder, keep)
        rounds.append([int(p.stem[-6:]) for p in shards(folder)])
        if len(rounds) == 3:
            raise KeyboardInterrupt

    monkeypatch.setattr(data, "drop_old", until_three_rounds)
    assert command(monkeypatch, "--out", tmp_path, "--follow", "--keep", 3, *SMALL) == 130
    assert rounds == [[0, 1], [1, 2, 3], [3, 4, 5]]
    assert data.next_index(tmp_path) == 6 and not list(tmp_path.glob("*.part"))


def test_a_trainer_goes_on_when_shards_are_dropped(folder, tmp_path):
    for path in shards(folder):
        shutil.copy(path, tmp_path)
    stream = batches(tmp_path, 2, 8, 0)
    next(stream)
    data.drop_old(tmp_path, 1)
    (left,) = shards(tmp_path)
    later = [next(stream)["photo"] for _ in range(12)][-3:]  # of the next epochs
    whole = torch.cat([b["photo"] for b in read_batch(left, 6)])
    assert all(torch.isin(p, whole).all() for p in later)


@pytest.mark.slow
def test_a_cluster_loses_nothing_when_a_worker_dies(folder, tmp_path):
    """Two Dask workers make shards, one is killed half-way: the same shards as in one process."""
    distributed = pytest.importorskip("distributed")
    jobs = [(tmp_path, i, OPTIONS, 6) for i in range(8)]
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, dashboard_address=None
    ) as cluster:
        seen = []
        for done in map_tasks(data._work, jobs, scheduler=cluster.scheduler_address):
            seen.append(done.unwrap()[0])
            if len(seen) == 3:
                next(iter(cluster.workers.values())).process.process.kill()
    assert sorted(seen) == list(range(8)) and len(shards(tmp_path)) == 8
    for mine, theirs in zip(shards(folder), shards(tmp_path), strict=False):
        a, b = load_file(mine), load_file(theirs)
        assert all(np.array_equal(a[k], b[k]) for k in a)


def test_photo_is_the_ideal_one_but_for_display_and_sensor(folder):
    """Same scene: they correlate, and agree in level within the screen's errors."""
    shard = load_file(shards(folder)[0])
    for photo, ideal in zip(
        shard["photo"].astype(float), shard["ideal"].astype(float), strict=True
    ):
        top = photo.max()
        ratio = np.minimum(ideal, top).mean() / photo.mean()
        assert 0.7 < ratio < 1.4


def test_held_out_names_are_kept_apart(tmp_path):
    for name in ("acg_Wood048", "mine", "acg_Bricks056"):
        maps = constant_maps(8, 8, diffuse=0.3)
        maps.diffuse[:4] = 0.5
        (tmp_path / name).mkdir()
        write_maps(tmp_path / name, maps)
    (tmp_path / "broken").mkdir()
    for n in ("basecolor", "normal", "roughness"):
        (tmp_path / "broken" / f"{n}.png").write_bytes(b"no image")
    assert len(draw._folder_materials(str(tmp_path), "train")) == 1
    assert len(draw._folder_materials(str(tmp_path), "holdout")) == 2
    (tmp_path / "rooms").mkdir()
    for n in ("venice_sunset", "other"):
        write_exr(tmp_path / "rooms" / f"{n}.exr", np.ones((8, 16, 3), np.float32))
    rooms = str(tmp_path / "rooms")
    assert len(draw._folder_environments(rooms, "train", 8)) == 1
    assert len(draw._folder_environments(rooms, "holdout", 8)) == 1
    old, new = draw.held_out("holdout"), draw.held_out("families")
    assert len(old) == 24 and len(new) == 33 and not old & new


def test_folds_part_the_families():
    names = [
        f"acg_{kind}{i:03d}" for kind in ("Wood", "Bricks", "Metal", "Tiles") for i in range(9)
    ]
    names += ["ph_rock_wall_08", "ph_rock_wall_02", "moss", "acg_Wallpaper001A"]
    one, two, rest = ({n for n in names if draw.in_fold(n, f)} for f in ("1/2", "2/2", "-1/2"))
    assert one | two == set(names) and not one & two and rest == two and one and two
    assert {draw.family(n) for n in one}.isdisjoint(draw.family(n) for n in two)
    assert draw.family("ph_rock_wall_08") == draw.family("ph_rock_wall_02") == "ph_rock_wall"
    assert all(draw.in_fold(n, "") for n in names)
    for bad in ("3/2", "0/2", "1", "a/b"):
        with pytest.raises(InputError, match="fold"):
            draw.in_fold("moss", bad)


def test_pieces_of_a_material_are_of_every_scale_and_never_enlarged():
    """A ramp's slope tells how many source pixels a pixel holds."""
    rng = np.random.default_rng(0)
    maps = constant_maps(256, 256, diffuse=0.5)
    maps.roughness = np.tile(np.linspace(0.1, 0.9, 256, dtype=np.float32), (256, 1))
    steps = []
    for _ in range(60):
        r = augment(maps, rng, 32, 32, jitter=0, free_rotation=0).roughness
        steps.append(max(np.ptp(r[:, 16]), np.ptp(r[16])) / (0.8 / 255) / 31)
    assert min(steps) > 0.99 and min(steps) < 1.5 and max(steps) > 5


def test_display_and_sensor_noise_are_small_and_seeded():
    rng = np.random.default_rng(0)
    pattern = block_pattern(32)
    assert pattern.min() >= 0 and pattern.max() <= 1
    shown = data.display(rng, pattern)
    assert shown.min() >= 0 and np.corrcoef(shown.ravel(), pattern.ravel())[0, 1] > 0.95
    # Two gains in three are known to 1%, the others as from a small JPEG.
    gains = [data.fit_gain(pattern * np.array([1, 2, 3]), pattern, rng) for _ in range(200)]
    error = np.abs(np.log(np.array(gains) / [1, 2, 3]))
    assert np.median(error) < 0.02 and 0.05 < error.max() < 0.4
    image = np.full((32, 32, 3), 0.4)
    a, b = (data.sensor(np.random.default_rng(5), image) for _ in range(2))
    np.testing.assert_array_equal(a, b)
    assert abs(a.mean() / 0.4 - 1) < 0.25 and a.std() < 0.1
    assert data.capture_pattern(rng, shown).shape == (64, 64, 3)


def test_built_rigs_are_of_many_proportions():
    """Displays, heights and samples as people have them; what they really are is near by."""
    rng = np.random.default_rng(0)
    pairs = [draw.draw_built_rigs(rng) for _ in range(60)]
    sizes = np.array([known.sample_size / min(known.screen_sides) for known, _ in pairs])
    heights = np.array([known.screen_height / max(known.screen_sides) for known, _ in pairs])
    cameras = np.array([known.camera[2] / known.screen_height for known, _ in pairs])
    assert np.ptp(sizes) > 0.1 and np.ptp(heights) > 0.2 and np.ptp(cameras) > 0.5
    off = np.array([np.subtract(k.camera, t.camera) for k, t in pairs])
    assert 8 < (off == 0).all(1).sum() < 30 and 0 < np.abs(off).max() < 0.01


def test_lens_darkens_away_from_where_it_looks_and_a_curve_keeps_the_order():
    rig, image = draw.draw_rigs(np.random.default_rng(1))[0], np.full((16, 16, 3), 0.4)
    lens = [noise.lens_and_curve(np.random.default_rng(k), image, rig) for k in range(40)]
    slopes = np.array([x[:, -1].mean() / x[:, 0].mean() for x in lens])  # the camera is at +x
    assert (slopes > 1 - 1e-9).all() and 10 < (slopes > 1.001).sum() < 30
    ramp = np.linspace(0.1, 0.9, 16 * 16 * 3).reshape(16, 16, 3)
    curves = [noise.lens_and_curve(np.random.default_rng(k), ramp, rig) for k in range(40)]
    spans = [np.log(x[8, -1] / x[7, 0]).mean() for x in curves]
    assert np.std(spans) > 0 and all(np.all(x > 0) for x in curves)


def test_half_of_the_displays_are_real_and_nearly_known():
    """Found falloff and mixing are those of the display within their errors; white stays white."""
    rng = np.random.default_rng(0)
    pairs = [noise.draw_devices(rng) for _ in range(400)]
    real = [(found, true) for found, true in pairs if true != IDEAL]
    assert 150 < len(real) < 250 and all(found == IDEAL for found, true in pairs if true == IDEAL)
    falloff = np.array([[d.falloff for d in pair] for pair in real])
    assert np.std(np.diff(falloff)) == pytest.approx(noise.FALLOFF_ERROR, rel=0.2)
    mixing = np.array([[d.mixing for d in pair] for pair in real])
    np.testing.assert_allclose(mixing.sum(-1), 1, atol=1e-9)
    assert 0 < np.abs(np.diff(mixing, axis=1)).max() < 6 * noise.MIXING_ERROR
    white = np.ones((2, 2, 3), np.float32)
    np.testing.assert_allclose(real[0][1].shown(white), white, rtol=1e-6)
    mirrors = np.log([noise.mirror_error(rng) for _ in range(400)])
    assert 150 < (mirrors == 0).all(1).sum() < 250
    assert np.std(mirrors) < 1.2 * noise.MIRROR_ERROR


def test_degenerate_captures_are_named(folder):
    good = {k: v[0] for k, v in load_file(shards(folder)[0]).items()}
    assert problems(good) == []
    photo = good["photo"]
    cases = {
        "black": photo * 0,
        "clipped": np.minimum(photo, np.percentile(photo, 5)).astype(np.float16),
        "not finite": np.where(photo == photo.max(), np.nan, photo),
    }
    for word, bad in cases.items():
        (found,) = problems({**good, "photo": bad})
        assert word in found
    # Half of it at the sensor's limit is still of use.
    middle = np.percentile(photo.max(0), 60)
    assert problems({**good, "photo": np.minimum(photo, middle).astype(np.float16)}) == []


def test_sheet_reports_and_draws(folder, tmp_path, monkeypatch, capsys):
    out = tmp_path / "sheet.png"
    monkeypatch.setattr("sys.argv", ["s", "--data", str(folder), "--out", str(out), "--count", "2"])
    assert sheet.main() == 0 and out.stat().st_size > 1000
    assert "12 captures, 0 of them degenerate" in capsys.readouterr().out
    shard = load_file(shards(folder)[0])
    shard["photo"] = np.zeros_like(shard["photo"])
    (tmp_path / "bad").mkdir()
    save_file(shard, tmp_path / "bad" / "shard_000000.safetensors")
    monkeypatch.setattr(
        "sys.argv", ["s", "--data", str(tmp_path / "bad"), "--out", str(out), "--count", "1"]
    )
    assert sheet.main() == 1
    assert "shard_000000[5]: the photo is black" in capsys.readouterr().out
    monkeypatch.setattr("sys.argv", ["s", "--data", str(tmp_path), "--out", str(out)])
    assert sheet.main() == 2
    kinds = tmp_path / "kinds.png"
    words = ["s", "--kinds", "foam", "skin", "--count", "2", "--out", str(kinds)]
    monkeypatch.setattr("sys.argv", words)
    assert sheet.main() == 0 and kinds.stat().st_size > 1000
    monkeypatch.setattr("sys.argv", [*words[:2], "cheese", *words[4:]])
    assert sheet.main() == 2


# --- loading --------------------------------------------------------------------------------------


def test_batches_repeat_by_seed_and_go_on_from_a_step(folder):
    take = lambda stream, n: [next(stream) for _ in range(n)]  # noqa: E731
    a = take(batches(folder, 4, 8, 0), 7)
    b = take(batches(folder, 4, 8, 0), 7)
    later = take(batches(folder, 4, 8, 0, start=5), 2)
    for x, y in [*zip(a, b, strict=True), *zip(a[5:], later, strict=True)]:
        assert all(torch.equal(x[k], y[k]) for k in x)
    other = next(batches(folder, 4, 8, 1))
    assert not torch.equal(other["photo"], a[0]["photo"])
    assert a[0]["photo"].shape == (4, 3, 8, 8) and a[0]["position"].shape == (4, 2, 8, 8)


def test_processes_share_a_batch(folder):
    whole = next(batches(folder, 4, 8, 0))
    parts = [next(batches(folder, 2, 8, 0, rank=r, world=2)) for r in range(2)]
    assert torch.equal(torch.cat([p["photo"] for p in parts]), whole["photo"])


def test_a_crop_knows_where_it_lies(folder):
    whole = torch.cat([b["photo"] for p in shards(folder) for b in read_batch(p, 6)])
    crop = next(batches(folder, 4, 8, 0))
    grid = positions(16, 16)
    for photo, position in zip(crop["photo"], crop["position"], strict=True):
        column = int((grid[0, 0] - position[0, 0, 0]).abs().argmin())
        row = int((grid[1, :, 0] - position[1, 0, 0]).abs().argmin())
        cut = whole[:, :, row : row + 8, column : column + 8]
        assert (cut == photo).all(3).all(2).all(1).any()


def test_no_shards(tmp_path):
    with pytest.raises(InputError, match="no shards"):
        next(batches(tmp_path, 4, 8, 0))


# --- training -------------------------------------------------------------------------------------


def options(folder, out, *more):
    words = ["--data", folder, "--out", out, "--valid", f"val={folder}", "--preset", "tiny"]
    words += ["--batch", 4, "--crop", 16, "--every", 5, *more]
    return train.parser().parse_args([str(w) for w in words])


def test_loss_is_least_at_the_truth(folder):
    batch = next(read_batch(shards(folder)[0], 6))
    t = truth(batch)
    out = {k: v.clone() for k, v in t.items()} | {"sigma": torch.full((6, 4, 16, 16), 0.01)}
    out["normal"] = out["normal"] * 2 - 1
    out["normal0"] = out["normal"]
    _, best = total_loss(out, batch)
    assert all(best[k] == pytest.approx(0, abs=1e-5) for k in (*MAPS, "normal0"))
    assert all(float(s.max()) < 1e-9 for s, _ in compare(out, batch).values())
    out["roughness"] = out["roughness"] + SPREADS["roughness"]
    _, worse = total_loss(out, batch)
    assert worse["roughness"] == pytest.approx(1, rel=0.01)
    assert worse["sigma"] > best["sigma"]


def test_network_overfits_a_batch(folder):
    torch.manual_seed(0)
    network = build("tiny").train()
    batch = next(batches(folder, 4, 16, 0))
    optimiser = torch.optim.AdamW(network.parameters(), 3e-3, betas=(0.9, 0.9))
    losses = []
    for _ in range(120):
        optimiser.zero_grad()
        loss, parts = total_loss(network(batch), batch)
        loss.backward()
        optimiser.step()
        losses.append(sum(parts[k] for k in MAPS))
    assert losses[-1] < 0.5 * losses[0]


def test_training_resumes_to_the_same_weights(folder, tmp_path):
    whole = train.train(options(folder, tmp_path / "a", "--steps", 10))
    first = options(folder, tmp_path / "b", "--steps", 10)
    # Stop after five steps, start again.
    stop = train.Trainer.update

    def until_five(self, batch, rate):
        if self.step == 5:
            raise KeyboardInterrupt
        return stop(self, batch, rate)

    train.Trainer.update = until_five
    try:
        with pytest.raises(KeyboardInterrupt):
            train.train(first)
    finally:
        train.Trainer.update = stop
    resumed = train.train(first)
    mean = resumed.mean.module.state_dict()
    for k, v in whole.mean.module.state_dict().items():
        torch.testing.assert_close(mean[k], v, rtol=1e-5, atol=1e-6)
    with open(tmp_path / "b" / "log.csv", newline="") as f:
        rows = list(csv.DictReader(f))
    assert [r["step"] for r in rows] == ["5", "10"] and float(rows[-1]["val_average"]) > 0
    assert (tmp_path / "b" / "curve.png").stat().st_size > 1000
    network, notes = load_weights(tmp_path / "b" / "weights.safetensors")
    assert notes["step"] == 10 and not network.training
    assert json.loads((tmp_path / "b" / "options.json").read_text())["steps"] == 10


def test_steps_that_are_not_finite_are_skipped(folder, tmp_path):
    trainer = train.Trainer(build("tiny"), tmp_path, torch.device("cpu"), 1e-3)
    batch = next(batches(folder, 4, 16, 0))
    before = {k: v.clone() for k, v in trainer.network.state_dict().items()}
    with torch.no_grad():
        trainer.network.encoder.intro.bias[0] = float("nan")
    trainer.update(batch, 1e-3)
    assert trainer.skipped == 1 and trainer.step == 1
    for k, v in trainer.network.state_dict().items():
        if k != "encoder.intro.bias":
            assert torch.equal(v, before[k])


def test_schedule():
    rates = [train.learning_rate(s, 1000, 1e-3) for s in (0, 199, 200, 750, 875, 1000)]
    assert rates[0] == pytest.approx(5e-6) and rates[1] == rates[2] == pytest.approx(1e-3)
    assert rates[3] == rates[1] and rates[4] == pytest.approx(5e-4, rel=0.01)
    assert rates[5] == pytest.approx(1e-7)


def test_calibration_and_baseline(folder):
    network = build("tiny")
    result = train.validate(network, folder, torch.device("cpu"))
    calibrate(network, [folder])
    again = train.validate(network, folder, torch.device("cpu"))
    for k, scale in zip(MAPS, network.calibration.tolist(), strict=True):
        assert again[k] == pytest.approx(result[k])
        if 0.01 < scale < 3:  # sigma is limited
            assert again[f"coverage_{k}"] == pytest.approx(0.68, abs=0.03)
    guess = train.baseline(folder)
    assert 0.02 < guess["normal"] < 0.3 and 0.02 < guess["diffuse"] < 0.4


def test_a_loan_of_some_minutes_draws_and_trains(folder, tmp_path):
    """The GPU's script on a CPU, for three seconds: new captures, steps, weights and two rows."""
    words = ["--minutes", 0.05, "--out", tmp_path, "--data", folder, "--valid", f"val={folder}"]
    words += ["--preset", "tiny", "--size", 16, "--batch", 4, "--valid-count", 4]
    args = gpu.parser().parse_args([str(w) for w in words])
    args.weights = None
    trainer = gpu.train(args)
    with open(tmp_path / "log.csv", newline="") as f:
        first, last = csv.DictReader(f)
    assert first["step"] == "0" and int(last["step"]) == trainer.step > 0
    assert int(last["drawn"]) >= 0 and float(last["val_average"]) > 0
    assert load_weights(tmp_path / "weights.safetensors")[1]["step"] == trainer.step


def test_the_pool_keeps_the_newest_captures():
    pool = gpu.Pool(torch.device("cpu"), size=4)
    pool.stop.set()
    pool.draw(OPTIONS)
    assert pool.drawn == len(pool.samples) == 1 and not pool.failed
    for _ in range(5):
        pool.add({k: v.numpy() for k, v in pool.samples[0].items()})
    batch = pool.batch(np.random.default_rng(0), 3)
    assert len(pool.samples) == 4 and batch["photo"].shape == (3, 3, 16, 16)
    assert batch["position"].shape == (3, 2, 16, 16) and batch["maps"].dtype == torch.uint8
    pool.draw(replace(OPTIONS, materials="nowhere"))
    with pytest.raises(InputError, match="nowhere"):
        pool.batch(np.random.default_rng(0), 1)
