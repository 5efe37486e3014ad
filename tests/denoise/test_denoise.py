"""Denoising of frames and files, baselines, metrics, the evaluation and its report."""

import dataclasses
import json
import os
import re
import subprocess
import sys
import time
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch
from skimage.metrics import structural_similarity
from typer.testing import CliRunner

import spadwarp
from helpers.stepped_frames import GATE, noisy_frame, scene
from spadwarp import ConfigError, FileError
from spadwarp.cli import app
from spadwarp.denoise import baselines, inference, metrics
from spadwarp.denoise import files as depth_files
from spadwarp.denoise import photon_counts as photons
from spadwarp.denoise.frames import depth_frames, fill_missing
from spadwarp.frames import record_frames
from spadwarp.io.exr import write_exr

torch.set_num_threads(1)


# Baselines


def test_the_median_is_that_of_its_window():
    depth = np.arange(81, dtype=np.float32).reshape(9, 9) / 81 + 14
    found = baselines.median_filter(depth_frames(depth, gate=GATE), window=3)
    assert found[0, 4, 4] == np.median(depth[3:6, 3:6])


def test_missing_pixels_take_their_nearest():
    image = np.full((5, 5), np.nan, np.float32)
    image[0, 0], image[4, 4] = 1.0, 2.0
    filled = fill_missing(image, 0.0)
    assert filled[1, 0] == 1.0 and filled[4, 3] == 2.0
    assert (fill_missing(np.full((3, 3), np.nan, np.float32), 7.0) == 7.0).all()


def test_gating_drops_what_the_water_explains():
    clean = np.nan_to_num(scene(), nan=15.0)
    noisy = noisy_frame(clean)
    found = baselines.gated_filter(depth_frames(noisy, gate=GATE))
    near = noisy < 14.4  # nearer than any target
    assert near.mean() > 0.1
    assert np.abs(found[0] - clean)[near].mean() < 0.05


def test_bm3d_smooths_a_small_crop():
    clean = np.full((24, 24), 15.0, np.float32)
    noisy = clean + np.random.default_rng(3).normal(0, 0.1, clean.shape).astype(np.float32)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the packages that bmnd compiles with
        found = baselines.bm3d_filter(depth_frames(noisy, gate=GATE))
    assert np.std(found[0] - clean) < 0.5 * np.std(noisy - clean)


# Metrics


def test_scores_are_those_of_their_definitions():
    clean = np.full((32, 32), 15.0, np.float32)
    clean[:, 16:] = 14.5
    estimate = clean.copy()
    estimate[::2] += 0.02
    one = metrics.score(clean, estimate, gate=GATE)
    assert one.rmse_mm == pytest.approx(20.0 / np.sqrt(2), rel=1e-4)
    assert one.within_1cm == 0.5 and one.within_5cm == 1.0
    assert one.edge_mm == pytest.approx(10.0, rel=1e-3)
    step = 255 * 0.02 / 2.5  # 2 of 255
    assert one.psnr == pytest.approx(10 * np.log10(255**2 / (0.5 * round(step) ** 2)), abs=1e-6)

    def eight(image):
        return np.round((image - 13.5) / 2.5 * 255).astype(np.uint8)

    options = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False, "win_size": 11}
    _, full = structural_similarity(eight(clean), eight(estimate), full=True, **options)
    assert one.ssim == pytest.approx(full.mean(), abs=1e-9)


def test_pixels_without_a_target_do_not_count():
    clean = scene()
    estimate = np.nan_to_num(clean, nan=13.5)
    one = metrics.score(clean, estimate, gate=GATE)
    assert one.rmse_mm == 0.0 and one.psnr == 100.0 and one.ssim == pytest.approx(1.0)
    with pytest.raises(ValueError, match="no pixel sees a target"):
        metrics.score(np.full((16, 16), np.nan, np.float32), np.ones((16, 16), np.float32), gate=GATE)


def test_steps_of_a_staircase():
    clean = scene()
    assert metrics.staircase_steps(clean, clean) == metrics.Steps(total=3, resolved=3)
    flat = np.where(clean < 14.99, 14.8, clean).astype(np.float32)  # the steps are gone, the wall is there
    assert metrics.staircase_steps(clean, flat).resolved < 3


# Files


def test_files_of_every_kind(tmp_path):
    clean = np.nan_to_num(scene(), nan=15.0)
    noisy = noisy_frame(clean)
    folder = tmp_path / "in"
    folder.mkdir()
    np.save(folder / "one.npy", noisy)
    write_exr(folder / "engine.exr", {"A": np.ascontiguousarray(100.0 * noisy)})

    def run(name, *options):
        common = ["--gate", "13.5", "16", "--model", "median", "--out", str(tmp_path / name)]
        result = CliRunner().invoke(app, ["denoise", *options, *common])
        assert result.exit_code == 0, result.output

    run("a", str(folder / "engine.exr"), "--scale", "0.01")
    run("b", str(folder / "one.npy"), "--json", str(tmp_path / "b.json"))
    first, second = np.load(tmp_path / "a" / "engine.npy"), np.load(tmp_path / "b" / "one.npy")
    assert np.nanmax(np.abs(first - second)) < 1e-4
    assert (tmp_path / "b" / "one.png").stat().st_size > 10_000
    assert json.loads((tmp_path / "b.json").read_text())["files"][0]["gate"] == [13.5, 16.0]
    folder_of_both = CliRunner().invoke(
        app, ["denoise", str(folder), "--model", "median", "--out", str(tmp_path / "c")]
    )
    assert folder_of_both.exit_code == 0, folder_of_both.output
    assert {one.name for one in (tmp_path / "c").glob("*.npy")} == {"engine.npy", "one.npy"}
    (folder / "bad.npy").write_bytes(b"junk")
    rest = CliRunner().invoke(app, ["denoise", str(folder), "--model", "median", "--out", str(tmp_path / "d")])
    assert rest.exit_code == 1 and "1 of 3 files could not be denoised" in rest.output
    assert {one.name for one in (tmp_path / "d").glob("*.npy")} == {"engine.npy", "one.npy"}


def test_histograms_become_depth_first(tmp_path):
    """Gaussian returns at 2.0 m of water in bins of 100 ps."""
    index, width = 1.3566, 100e-12
    time = 2 * 2.0 * index / 299_792_458
    generator = np.random.default_rng(5)
    arrivals = generator.normal(time, 150e-12, (32, 32, 50))
    edges = np.arange(257) * width + 10e-9
    counts = np.apply_along_axis(lambda one: np.histogram(one, edges)[0], -1, arrivals)
    np.save(tmp_path / "counts.npy", counts.astype(np.uint16))
    found = depth_files.denoise_file(
        tmp_path / "counts.npy",
        tmp_path / "out",
        model="median",
        bin_width_ps=100.0,
        gate_start_ns=10.0,
        group_index=index,
    )
    assert abs(np.median(found.depth) - 2.0) < 0.005
    assert found.gate == pytest.approx((299_792_458 / index / 2 * 10e-9, 299_792_458 / index / 2 * 35.6e-9))
    with pytest.raises(ValueError, match="another is needed"):
        depth_files.denoise_file(tmp_path / "counts.npy", tmp_path)
    with pytest.raises(ValueError, match="bin width is missing"):
        depth_files.read_depth(tmp_path / "counts.npy", group_index=index)


def test_what_cannot_be_read(tmp_path):
    with pytest.raises(FileError, match="no such file"):
        depth_files.read_depth(tmp_path / "none.npy")
    (tmp_path / "bad.npy").write_bytes(b"junk")
    with pytest.raises(FileError, match="damaged"):
        depth_files.read_depth(tmp_path / "bad.npy")
    np.save(tmp_path / "complex.npy", np.full((16, 16), 15.0 + 1.0j))
    with pytest.raises(FileError, match=r"complex128 \(16, 16\); depth is real numbers"):
        depth_files.read_depth(tmp_path / "complex.npy")
    np.save(tmp_path / "marked.npy", np.where(np.eye(16) > 0, -1.0, 15.0))
    marked = depth_files.read_depth(tmp_path / "marked.npy")
    assert "16 values below 0" in marked.source and np.isnan(marked.depth).sum() == 16
    (tmp_path / "text.txt").write_text("1")
    with pytest.raises(FileError, match=r"'.txt' is not one of"):
        depth_files.read_depth(tmp_path / "text.txt")
    (tmp_path / "empty").mkdir()
    with pytest.raises(FileError, match="no file that ends in"):
        depth_files.depth_files(tmp_path / "empty")


# Evaluation on a dataset


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    folder = tmp_path_factory.mktemp("data") / "set"
    recipe = spadwarp.load_recipe("configs/datasets/lu2024.toml").with_overrides(
        {
            "scenes_per_target": 1,
            "scenes_per_shard": 1,
            "targets.builtin": ["staircase", "anchor", "naval_mine"],
            "targets.validation": ["naval_mine"],
            "targets.test": ["staircase"],
            "frames.per_scene": 6,
            "frames.backscatter_fraction": [0.042, 0.48],
            "pose.yaw_deg": 0.0,
            "pose.pitch_deg": 0.0,
            "pose.roll_deg": 0.0,
            "scene.camera": {"preset": "lu2024", "width": 64, "height": 48},
        }
    )
    spadwarp.make_dataset(recipe, folder, device="cpu")
    return folder


def test_evaluation_and_report(dataset, tmp_path):
    found = spadwarp.denoise.evaluate(dataset, models=("median", "gating"), frames=2)
    assert found.levels == ("0.042", "0.480") and found.targets == ("staircase",)
    for level in found.levels:
        assert found.mean("median", level=level).psnr > found.mean("input", level=level).psnr + 3
    assert found.ranking()[-1] == "input"
    assert found.windows["0.042"] <= found.windows["0.480"]
    assert found.steps["input", "0.042"].total > 0
    assert "seed" in found.summary and "photons" in found.summary and "attenuation lengths" in found.summary
    middle = spadwarp.denoise.evaluate(dataset, models=("median",), frames=2, crop=(32, 24))
    assert "the middle 32 x 24 pixels" in middle.summary
    assert middle.samples["staircase", "0.480"].clean.shape == (24, 32)
    result = CliRunner().invoke(
        app, ["evaluate", str(dataset), "--models", "median", "--frames", "1", "--report", str(tmp_path)]
    )
    assert result.exit_code == 0, result.output
    page = (tmp_path / "report.html").read_text()
    assert page.count("data:image/png;base64,") == 5 and "http" not in page
    assert re.search(r"[+-]\d+\.\d\d\u00a0dB, [+-]\d+\u00a0%", page)
    scores = json.loads((tmp_path / "scores.json").read_text())
    assert {row["method"] for row in scores["scores"]} == {"input", "median"}


def test_evaluation_refuses_what_it_cannot_do(dataset, tmp_path):
    with pytest.raises(ValueError, match="'unet' is not one of"):
        spadwarp.denoise.evaluate(dataset, models=("unet",))
    with pytest.raises(ValueError, match="'histograms' needs histograms, which datasets do not keep"):
        spadwarp.denoise.evaluate(dataset, models=("histograms",))
    with pytest.raises(ValueError, match=r"crop = \(65, 48\) is outside \(8, 8\) to \(64, 48\)"):
        spadwarp.denoise.evaluate(dataset, models=("median",), crop=(65, 48))
    with pytest.raises(FileError, match="no dataset there"):
        spadwarp.denoise.evaluate(tmp_path)


def test_training_from_a_dataset(dataset, tmp_path):
    recipe = tmp_path / "recipe.toml"
    recipe.write_text(f'model = "usdn"\ndata = "{dataset}"\n[optimiser]\nsteps = 2\nbatch = 2\ncrop = 32\n')
    result = CliRunner().invoke(app, ["train", str(recipe), "--out", str(tmp_path / "run"), "--device", "cpu"])
    assert result.exit_code == 0, result.output
    assert {one.name for one in (tmp_path / "run").iterdir()} >= {"usdn.safetensors", "log.jsonl", "curves.png"}
    assert inference.weights_metadata("usdn", tmp_path / "run" / "usdn.safetensors")["seed"] == "0"
    own = tmp_path / "run" / "usdn.safetensors"
    trained = spadwarp.denoise.evaluate(dataset, models=("usdn",), frames=1, weights=own, device="cpu")
    shipped = spadwarp.denoise.evaluate(dataset, models=("usdn",), frames=1, device="cpu")
    assert trained.mean("usdn").psnr < shipped.mean("usdn").psnr  # two steps against a whole training
    assert trained.mean("input") == shipped.mean("input") and str(own) in trained.summary
    with pytest.raises(ValueError, match="'usdn', which is not among models: dncnn"):
        spadwarp.denoise.evaluate(dataset, models=("dncnn",), weights=own)
    recipe.write_text('model = "usdn"\n')
    assert CliRunner().invoke(app, ["train", str(recipe), "--out", str(tmp_path / "other")]).exit_code == 2
    with pytest.raises(ConfigError, match="data"):
        spadwarp.denoise.train(recipe, tmp_path / "other")


def test_two_processes_train_as_one_and_go_on_after_a_kill(dataset, tmp_path, monkeypatch):
    """torchrun, stopped in the middle and started again, against one process that takes both halves of each batch.

    They add up the same gradients in another order. Weights agree to a thousandth of the way they went, since Adam and
    the maxima in the network enlarge differences of rounding; half the batch alone would send them another way.
    """
    from spadwarp.denoise import training
    from spadwarp.denoise.recipe import load_training_recipe
    from spadwarp.denoise.training_run import read_scenes

    place, out = tmp_path / "recipe.toml", tmp_path / "two"
    optimiser = "steps = 16\nbatch = 4\ncrop = 32\nreport_every = 4\nwarm_up = 2\naveraging = 0.5"
    place.write_text(
        f'model = "usdn"\ndata = "{dataset}"\nseed = 3\n[optimiser]\n{optimiser}\n[noise]\ncounting = 0.0\n'
    )
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
    command += ["-m", "spadwarp", "train", str(place), "--out", str(out), "--device", "cpu"]
    paths = os.pathsep.join([str(Path(spadwarp.__file__).parents[1]), *filter(None, sys.path)])
    options = {"env": {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": paths}, "text": True}
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, **options) as run:
        while run.poll() is None and not (out / "checkpoint.pt").is_file():
            time.sleep(0.02)
        run.terminate()
        said = run.communicate(timeout=240)[1]
    assert (out / "checkpoint.pt").is_file(), said
    assert not (out / "usdn.safetensors").exists()
    with (out / "log.jsonl").open("a") as file:
        file.write('{"step": 1')  # of a kill between a line and its checkpoint
    again = subprocess.run(command, capture_output=True, timeout=240, **options)
    assert again.returncode == 0, again.stderr
    assert again.stdout.count("written") == 1 and "strides" not in again.stderr
    names = sorted(one.name for one in out.iterdir() if one.name[0] != ".")  # hidden: what was half written
    assert names == ["checkpoint.pt", "curves.png", "log.jsonl", "usdn.safetensors"]
    steps = [json.loads(line)["step"] for line in (out / "log.jsonl").read_text().splitlines()]
    assert steps == [4, 8, 12, 16]

    streams = [torch.Generator().manual_seed(3 * 1009 + rank) for rank in range(2)]
    draw, loss = training.draw_batch, training.loss_of

    def both(scenes, noise, *, size, generator, **others):
        if others.get("always_replaced"):  # of the validation
            return draw(scenes, noise, size=size, generator=generator, **others)
        halves = [draw(scenes, noise, size=size // 2, generator=one, **others) for one in streams]
        return training.Batch(*map(torch.cat, zip(*halves, strict=True)))

    def mean_loss(output, batch, *, kind):
        halves = zip(*(one.chunk(2) for one in (output, batch.frame, batch.clean, batch.hit)), strict=True)
        return sum(loss(one, training.Batch(*parts), kind=kind) for one, *parts in halves) / 2

    monkeypatch.setattr(training, "draw_batch", both)
    monkeypatch.setattr(training, "loss_of", mean_loss)
    scenes = [read_scenes(dataset, split) for split in ("train", "validation")]
    training.fit(load_training_recipe(place), *scenes, tmp_path / "one", device="cpu")
    torch.manual_seed(3)
    networks = training.build_network("usdn"), *(torch.load(one / "checkpoint.pt") for one in (out, tmp_path / "one"))
    states = [networks[0].state_dict(), *(one["network"] for one in networks[1:])]
    new, two, one = (torch.cat([values.flatten() for values in state.values()]) for state in states)
    assert (one - two).norm() < 1e-3 * (one - new).norm()


# Few photons


def wall(reflectance=0.5):
    """A Monte Carlo result of a plane at 3 m, 16 x 12 pixels."""
    scene = spadwarp.Scene.from_dict(
        {
            "medium": {"extinction": 0.3, "albedo": 0.7, "group_index": 1.36},
            "laser": {"half_angle_deg": 12.0, "pulse_fwhm_ps": 300.0},
            "camera": {"width": 16, "height": 12, "horizontal_fov_deg": 20.0, "aperture_diameter": 0.02},
            "gate": {"start_ns": 18.0, "bin_width_ps": 200.0, "bins": 64},
            "targets": [
                {"builtin": "plane", "size": [4.0, 4.0], "translation": [0.0, 0.0, 3.0], "reflectance": reflectance}
            ],
        }
    )
    return spadwarp.simulate(scene, photons=200_000, seed=2, device="cpu")


def test_counts_are_denoised_with_their_histograms(tmp_path):
    """One detection in five pixels: 2 cm with the histograms, of which depth alone is far."""
    result = wall()
    result = dataclasses.replace(result, scene=result.scene.with_overrides({"laser.pulse_energy": 1e-13}))
    recorded = record_frames(result, tmp_path / "frames.h5", pulses=2000, frames=4, seed=1, device="cpu")
    assert 0.1 < recorded.detections / (4 * 16 * 12) < 0.4
    errors = []
    for weights in (None, inference.WEIGHTS / "pyramid.safetensors"):
        found = depth_files.denoise_file(tmp_path / "frames.h5", tmp_path / "out", weights=weights, device="cpu")
        assert ("denoised with its histograms" in found.notes) == (weights is None)
        errors.append(np.nan_to_num(found.depth, nan=0.5 * sum(found.gate)) - result.truth.depth)
    rmse = np.sqrt(np.mean(np.square(errors), axis=(1, 2, 3)))
    assert rmse[0] < 0.02 < 0.1 < rmse[1]


def test_frames_of_few_photons_meet_the_bound_where_they_are_many(tmp_path):
    result = wall()
    frames = [photons.photon_frame(result, photons=2000.0, sbr=20.0, seed=seed) for seed in range(8)]
    sigma = frames[0][1]
    spread = np.std([frame.depth[0] for frame, _ in frames], axis=0, ddof=1) / sigma
    # 192 pixels, each with 7 degrees of freedom; the estimator treats scattered light as a Gaussian return, too.
    assert 0.8 < np.sqrt(np.nanmedian(spread**2)) < 1.6
    sweep = photons.photon_sweep(result, photons=(1, 30), sbr=(0.3,), models=("median",), seed=3)
    assert (sweep.rmse["median"] < sweep.rmse["input"]).all()
    assert (sweep.bound < sweep.rmse["input"]).all()
    assert (np.diff(sweep.rmse["input"]) < 0).all()
    assert sweep.saving("input")[0, 0] == pytest.approx(1.0)
    assert photons.draw_photon_sweep(sweep, tmp_path / "photons.png").stat().st_size > 10_000
    with pytest.raises(ValueError, match="sbr"):
        photons.photon_sweep(result, sbr=(0.0,))


# No leakage


@pytest.mark.parametrize("test_recipe", ["lu2024", "small"])
def test_training_and_test_share_no_target_and_no_seed(test_recipe):
    from spadwarp.dataset.sampling import Plan

    training = Plan(spadwarp.load_recipe("configs/datasets/training.toml"))
    tested = Plan(spadwarp.load_recipe(f"configs/datasets/{test_recipe}.toml"))
    learnt = {one.name for one in training.targets if one.split in ("train", "validation")}
    judged = {one.name for one in tested.targets if one.split == "test"}
    assert "staircase" in judged and learnt.isdisjoint(judged)
    seeds = [plan.split_seeds[split] for plan in (training, tested) for split in ("train", "validation", "test")]
    assert len(set(seeds)) == 6
