"""Denoising of frames and files, baselines, metrics, the evaluation and its report."""

import dataclasses
import json
import re

import numpy as np
import pytest
from skimage.metrics import structural_similarity

import spadwarp
from helpers.cli import run
from helpers.datasets import make, recipe
from helpers.scenes import scene as make_scene
from helpers.stepped_frames import GATE, noisy_frame, scene
from spadwarp import ArgumentError, FileError
from spadwarp.dataset import Plan
from spadwarp.denoise import baselines, files, network_files
from spadwarp.denoise.frames import depth_frames, fill_missing
from spadwarp.denoise.inference import estimate_frames
from spadwarp.evaluation import datasets, photon_counts
from spadwarp.frames import record_frames

# Baselines


def test_the_median_is_that_of_its_window_and_missing_pixels_take_their_nearest():
    depth = np.arange(81, dtype=np.float32).reshape(9, 9) / 81 + 14
    found = baselines.median_filter(depth_frames(depth, gate=GATE), window=3)
    assert found[0, 4, 4] == np.median(depth[3:6, 3:6])
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


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # of the packages that bmnd compiles with
def test_bm3d_smooths_a_small_crop():
    clean = np.full((24, 24), 15.0, np.float32)
    noisy = clean + np.random.default_rng(3).normal(0, 0.1, clean.shape).astype(np.float32)
    found = baselines.bm3d_filter(depth_frames(noisy, gate=GATE))
    assert np.std(found[0] - clean) < 0.5 * np.std(noisy - clean)


# Metrics


def test_scores_are_those_of_their_definitions():
    clean = np.full((32, 32), 15.0, np.float32)
    clean[:, 16:] = 14.5
    estimate = clean.copy()
    estimate[::2] += 0.02
    found = datasets.score(clean, estimate, gate=GATE)
    assert found.rmse_mm == pytest.approx(20.0 / np.sqrt(2), rel=1e-4)
    assert found.within_1cm == 0.5 and found.within_5cm == 1.0
    assert found.edge_mm == pytest.approx(10.0, rel=1e-3)
    step = 255 * 0.02 / 2.5  # 2 of 255
    assert found.psnr == pytest.approx(10 * np.log10(255**2 / (0.5 * round(step) ** 2)), abs=1e-6)

    images = (np.round((image - 13.5) / 2.5 * 255).astype(np.uint8) for image in (clean, estimate))
    options = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False, "win_size": 11}
    _, full = structural_similarity(*images, full=True, **options)
    assert found.ssim == pytest.approx(full.mean(), abs=1e-9)


def test_pixels_without_a_target_do_not_count_and_steps_do():
    clean = scene()
    found = datasets.score(clean, np.nan_to_num(clean, nan=13.5), gate=GATE)
    assert found.rmse_mm == 0.0 and found.psnr == 100.0 and found.ssim == pytest.approx(1.0)
    with pytest.raises(ValueError, match="no pixel sees a target"):
        datasets.score(np.full((16, 16), np.nan, np.float32), np.ones((16, 16), np.float32), gate=GATE)
    assert datasets.staircase_steps(clean, clean) == datasets.Steps(total=3, resolved=3)
    flat = np.where(clean < 14.99, 14.8, clean).astype(np.float32)  # the steps are gone, the wall is there
    assert datasets.staircase_steps(clean, flat).resolved < 3


# Evaluation on a dataset


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    folder = tmp_path_factory.mktemp("data") / "set"
    changes = {"frames.per_scene": 6, "frames.backscatter_fraction": [0.042, 0.48], "pose.yaw_deg": 0.0}
    changes |= {"scene.camera": {"preset": "lu2024", "width": 64, "height": 48}, "scenes_per_target": 1}
    return make(recipe(**changes), folder).folder


@pytest.mark.slow
def test_evaluation_and_report(dataset, tmp_path):
    found = spadwarp.evaluation.evaluate(dataset, models=("median", "gating"), frames=2)
    assert found.levels == ("0.042", "0.480") and found.targets == ("staircase",)
    for level in found.levels:
        assert found.mean("median", level=level).psnr > found.mean("input", level=level).psnr + 3
    assert found.ranking()[-1] == "input"
    assert found.windows["0.042"] <= found.windows["0.480"]
    assert found.steps["input", "0.042"].total > 0
    assert "seed" in found.summary and "photons" in found.summary and "attenuation lengths" in found.summary
    middle = spadwarp.evaluation.evaluate(dataset, models=("median",), frames=2, crop=(32, 24))
    assert "the middle 32 x 24 pixels" in middle.summary
    assert middle.samples["staircase", "0.480"].clean.shape == (24, 32)
    outcome = run("evaluate", dataset, "--models", "median", "--frames", 1, "--report", tmp_path, "--quiet")
    assert "median" in outcome.stdout and not outcome.stderr  # the result, and nothing about how far it is
    page = (tmp_path / "report.html").read_text()
    page, pictures = re.subn(r"data:image/png;base64,[\w+/=]+", "", page)  # any letters may follow there
    assert pictures == 5 and "http" not in page
    assert re.search(r"[+-]\d+\.\d\d\u00a0dB, [+-]\d+\u00a0%", page)
    scores = json.loads((tmp_path / "scores.json").read_text())
    assert {row["method"] for row in scores["scores"]} == {"input", "median"}


def test_evaluation_refuses_what_it_cannot_do(dataset, tmp_path):
    foreign = {"models": ("dncnn",), "weights": network_files.WEIGHTS / "histograms.safetensors"}
    for folder, options, message in (
        (dataset, {"models": ("unet",)}, "'unet' .* 'pyramid', 'dncnn', 'usdn', 'median', 'gating', 'bm3d'$"),
        (dataset, {"models": ("histograms",)}, "needs histograms with their background; evaluate a Monte Carlo result"),
        (dataset, {"models": ("median",), "crop": (65, 48)}, r"crop = \(65, 48\) is outside \(8, 8\) to \(64, 48\)"),
        (dataset, foreign, "of the network for histograms; evaluate a result"),
        (tmp_path, {}, "no dataset there"),
    ):
        with pytest.raises((ArgumentError, FileError), match=message):
            spadwarp.evaluation.evaluate(folder, **options)


def validation_psnr(dataset, method, windows=(5,), **options):
    """Mean over target and level of the PSNR of the frames, by its definition; with the best window at each."""
    levels = {}
    for item in spadwarp.dataset.FrameReader(dataset, "validation", fields=("noisy", "clean", "bound", "prior")):
        noisy, clean, bound, prior = (item[name][0] for name in ("noisy", "clean", "bound", "prior"))
        start, stop = map(float, item["gate"])
        frames = depth_frames(noisy, gate=(start, stop), density=prior)
        seen = np.isfinite(bound) & (clean >= start) & (clean < stop)
        of_level = levels.setdefault((int(item["target"]), f"{item['backscatter_fraction']:.3f}"), {})
        for window in windows:
            found = estimate_frames(frames, model=method, window=window, **options).depth[0]
            bits = [np.round(255 * np.clip((depth[seen] - start) / (stop - start), 0, 1)) for depth in (found, clean)]
            psnr = 20 * np.log10(255) - 10 * np.log10(np.mean(np.subtract(*bits) ** 2))
            of_level.setdefault(window, []).append(psnr)
    return np.mean([max(map(np.mean, of_level.values())) for of_level in levels.values()])


@pytest.mark.slow
def test_training_from_a_dataset(dataset, tmp_path):
    file, out, own = tmp_path / "recipe.toml", tmp_path / "run", tmp_path / "run" / "usdn.safetensors"
    file.write_text(f'model = "usdn"\ndata = "{dataset}"\n[optimiser]\nsteps = 2\nbatch = 2\ncrop = 32\n')
    printed = run("train", file, "--out", out, "--device", "cpu", "--json", tmp_path / "printed.json").stdout
    numbers = json.loads((tmp_path / "printed.json").read_text())
    options = {"input": {}, "median": {"windows": baselines.MEDIAN_WINDOWS}, "usdn": {"weights": own}}
    for name, method in {"input_psnr": "input", "median_psnr": "median", "psnr": "usdn"}.items():
        expected = validation_psnr(dataset, method, **options[method])
        assert numbers[name] == pytest.approx(expected, abs=2e-3) and f"{expected:.4g} dB" in printed, name
    assert {path.name for path in out.iterdir()} >= {"usdn.safetensors", "log.jsonl", "curves.png"}
    assert network_files.weights_metadata("usdn", own)["seed"] == "0"
    found = spadwarp.evaluation.evaluate(dataset, models=("usdn",), frames=1, weights=own, device="cpu")
    assert found.methods == ("input", "usdn", "own") and str(own) in found.summary
    assert found.mean("own").psnr < found.mean("usdn").psnr  # two steps against a whole training
    assert json.loads((out / "log.jsonl").read_text().splitlines()[-1])["input_psnr"] > 10


# Few photons


@pytest.fixture(scope="module")
def wall():
    """A Monte Carlo result of a plane at 3 m, 16 x 12 pixels."""
    plane = {"builtin": "plane", "size": [4.0, 4.0], "translation": [0.0, 0.0, 3.0], "reflectance": 0.5}
    one = make_scene(
        medium={"extinction": 0.3, "albedo": 0.7, "anisotropy": 0.9, "group_index": 1.36},
        laser={"half_angle_deg": 12.0, "pulse_fwhm_ps": 300.0, "position": [0.0, 0.0, 0.0]},
        camera={"width": 16, "height": 12, "horizontal_fov_deg": 20.0, "aperture_diameter": 0.02},
        gate={"start_ns": 18.0, "bin_width_ps": 200.0, "bins": 64},
        targets=[plane],
    )
    return spadwarp.simulate(one, photons=200_000, seed=2, device="cpu")


def test_counts_are_denoised_with_their_histograms(wall, tmp_path):
    """One detection in five pixels of a plane: an error below 2 cm, with the histograms or from depth alone, but in
    some corners, around which too few were counted to be sure."""
    result = dataclasses.replace(wall, scene=wall.scene.with_overrides({"laser.pulse_energy": 1e-13}))
    recorded = record_frames(result, tmp_path / "frames.h5", pulses=2000, frames=4, seed=1, device="cpu")
    assert 0.1 < recorded.detections / (4 * 16 * 12) < 0.4
    errors = []
    for weights in (None, network_files.WEIGHTS / "pyramid.safetensors"):
        found = files.denoise_file(tmp_path / "frames.h5", tmp_path / "out", weights=weights, device="cpu")
        assert ("denoised with its histograms" in found.notes) == (weights is None)
        errors.append(found.depth - result.truth.depth)
        assert np.isfinite(found.depth).mean() > 0.9
    rmse = np.sqrt(np.nanmean(np.square(errors), axis=(1, 2, 3)))
    assert max(rmse) < 0.02


def test_frames_of_many_photons_meet_the_bound(wall):
    frames = [photon_counts.photon_frame(wall, photons=2000.0, sbr=20.0, seed=seed) for seed in range(8)]
    sigma = frames[0][1]
    spread = np.std([frame.depth[0] for frame, *_ in frames], axis=0, ddof=1) / sigma
    # 192 pixels, each with 7 degrees of freedom; the estimator treats scattered light as a Gaussian return, too.
    assert 0.8 < np.sqrt(np.nanmedian(spread**2)) < 1.6


def test_a_sweep_over_photons(wall, tmp_path):
    sweep = photon_counts.photon_sweep(wall, photons=(1, 30), sbr=(0.3,), models=("median",), seed=3)
    assert (sweep.rmse["median"] < sweep.rmse["input"]).all()
    assert (sweep.bound < sweep.rmse["input"]).all()
    assert (np.diff(sweep.rmse["input"]) < 0).all()
    assert sweep.saving("input")[0, 0] == pytest.approx(1.0)
    assert photon_counts.draw_photon_sweep(sweep, tmp_path / "photons.png").stat().st_size > 10_000
    for options, message in (({"sbr": (0.0,)}, "sbr"), ({"models": ("poled",)}, "'histograms', .* mean 'pooled'")):
        with pytest.raises(ValueError, match=message):
            photon_counts.photon_sweep(wall, **options)


# No leakage


@pytest.mark.parametrize("test_recipe", ["lu2024", "small"])
def test_training_and_test_share_no_target_and_no_seed(test_recipe):
    parts = ("train", "validation", "test")
    plans = [Plan(spadwarp.dataset.load_recipe(f"configs/datasets/{name}.toml")) for name in ("training", test_recipe)]
    trained, tested = ([(target.name, target.split) for target in plan.targets] for plan in plans)
    seen, unseen = (
        {name for name, split in trained if split != "test"},
        {name for name, split in tested if split == "test"},
    )
    assert "staircase" in unseen and seen.isdisjoint(unseen)
    assert len({plan.split_seeds[split] for plan in plans for split in parts}) == 6
