"""The weights of the package: what they make of frames, and what they say about themselves."""

import os
from pathlib import Path

import numpy as np
import pytest
import torch

import spadwarp
from helpers.stepped_frames import GATE, noisy_frame, scene
from spadwarp import DeviceError, FileError
from spadwarp.denoise import baselines, inference, metrics
from spadwarp.denoise.frames import depth_frames
from spadwarp.denoise.recipe import MODELS
from spadwarp.io.exr import read_exr

torch.set_num_threads(1)

OF_DEPTH = [name for name in MODELS if name != "histograms"]


# Networks with the weights of the package


@pytest.mark.parametrize("model", OF_DEPTH)
def test_each_network_improves_a_frame_it_has_never_seen(model):
    clean = scene(96, 128)
    noisy = noisy_frame(clean)
    seen = np.isfinite(clean)
    found = np.where(seen, spadwarp.denoise.apply(noisy, gate=GATE, model=model, device="cpu"), np.nan)
    before = metrics.score(clean, np.nan_to_num(noisy, nan=14.75), gate=GATE)
    after = metrics.score(clean, np.nan_to_num(found, nan=14.75), gate=GATE)
    assert after.psnr > before.psnr + 3
    assert after.ssim > before.ssim


def test_pyramid_beats_the_median_and_knows_where_nothing_is():
    clean = scene(96, 128)
    clean[:40, :40] = np.nan
    noisy = noisy_frame(clean, 0.48)
    frames = depth_frames(noisy, gate=GATE)
    found, seen = inference.denoise_frames(frames, model="pyramid", device="cpu")
    median = baselines.median_filter(frames, window=5)
    assert metrics.score(clean, found[0], gate=GATE).psnr > metrics.score(clean, median[0], gate=GATE).psnr + 6
    assert np.mean(seen[0] == np.isfinite(clean)) > 0.97


@pytest.mark.parametrize("shape", [(32, 32), (41, 67), (8, 100)])
@pytest.mark.parametrize("model", OF_DEPTH)
def test_any_size(model, shape):
    depth = np.full(shape, 15.0, np.float32)
    found = spadwarp.denoise.apply(np.stack([depth, depth]), gate=GATE, model=model, device="cpu")
    assert found.shape == (2, *shape) and found.dtype == np.float32


def test_a_large_frame():
    depth = np.full((768, 1024), 15.0, np.float32)
    found = spadwarp.denoise.apply(depth, gate=GATE, device="cpu")
    assert found.shape == depth.shape
    assert abs(np.nanmedian(found) - 15.0) < 0.01


@pytest.mark.parametrize("missing", [0.5, 0.9])
@pytest.mark.parametrize("model", OF_DEPTH)
def test_frames_with_few_reports(model, missing):
    """Nine of ten pixels may be missing: half of all are within 1.5 times what they are when all report."""
    clean = np.nan_to_num(scene(96, 128), nan=15.0)
    noisy = noisy_frame(clean, 0.05)
    few = np.where(np.random.default_rng(5).random(noisy.shape) < missing, np.nan, noisy)
    errors = []
    for depth in (noisy, few):
        frames = depth_frames(depth, gate=GATE)
        found, seen = inference.denoise_frames(frames, model=model, device="cpu")
        if model == "pyramid":
            assert seen.mean() > 0.97
        errors.append(np.median(np.abs(found[0] - clean)))
    assert errors[1] < 1.5 * errors[0] + 0.001


@pytest.mark.parametrize("share", [0.1, 0.4])
@pytest.mark.parametrize("decay", [0.0, 5.0])
def test_backscatter_alone_is_no_target(share, decay):
    """A frame of open water, where few pixels report and none of them a target, stays empty."""
    generator = np.random.default_rng(6)
    profile = np.exp(-decay * np.arange(64) / 64)
    place = generator.choice(64, size=(96, 128), p=profile / profile.sum()) + generator.random((96, 128))
    depth = GATE[0] + (GATE[1] - GATE[0]) * place / 64
    depth[generator.random(depth.shape) >= share] = np.nan
    found = spadwarp.denoise.apply(depth, gate=GATE, profile=profile, device="cpu")
    assert np.isfinite(found).mean() < 0.01


def test_nothing_stands_for_what_lies_beside_a_target():
    """The nearest report stands for a pixel missing inside a disc, none for the pixels about the disc."""
    y, x = np.mgrid[:96, :128]
    inside = np.hypot(y - 48, x - 64) < 30
    depth = np.where(inside & (np.random.default_rng(7).random(inside.shape) > 0.2), 15.0, np.nan)
    told = depth_frames(depth, gate=GATE).network_input()[0, 1] > 0
    distance = np.hypot(y - 48, x - 64)
    assert told[distance < 26].all() and not told[distance > 33].any()
    whole = depth_frames(np.where(inside, 15.0, np.nan), gate=GATE).network_input()[0, 1] > 0
    assert np.count_nonzero(whole & ~inside) < 0.05 * np.count_nonzero(inside)


@pytest.mark.parametrize("model", [*OF_DEPTH, "median", "gating"])
def test_an_empty_frame_stays_empty(model):
    assert np.isnan(spadwarp.denoise.apply(np.full((32, 40), np.nan), gate=GATE, model=model)).all()
    assert np.isnan(spadwarp.denoise.apply(np.zeros((2, 32, 40), np.float32), gate=GATE, model=model)).all()


def test_pyramid_fills_what_the_camera_missed():
    clean = np.full((64, 64), 15.0, np.float32)
    dead = np.random.default_rng(1).random(clean.shape) < 0.1
    found = spadwarp.denoise.apply(np.where(dead, np.nan, clean), gate=GATE, device="cpu")
    assert np.isfinite(found[dead]).mean() > 0.99
    assert np.nanpercentile(np.abs(found - clean), 99) < 0.01


@pytest.mark.parametrize("model", OF_DEPTH)
def test_a_frame_takes_no_part_in_the_next(model):
    frames = np.stack([noisy_frame(scene(), seed=seed) for seed in range(2)])
    both = spadwarp.denoise.apply(frames, gate=GATE, model=model, device="cpu")
    for frame, found in zip(frames, both, strict=True):
        alone = spadwarp.denoise.apply(frame, gate=GATE, model=model, device="cpu")
        assert np.nanmax(np.abs(alone - found)) < 1e-4


def test_distance_does_not_matter_but_the_place_in_the_gate_does():
    clean = scene()
    noisy = noisy_frame(clean)
    near = spadwarp.denoise.apply(noisy, gate=GATE, device="cpu")
    far = spadwarp.denoise.apply(noisy + 35.0, gate=(GATE[0] + 35.0, GATE[1] + 35.0), device="cpu")
    assert np.nanmax(np.abs(far - 35.0 - near)) < 2e-3


def test_depth_outside_the_gate_is_said_and_left_out():
    depth = np.full((32, 32), 15.0, np.float32)
    depth[:4] = 40.0
    with pytest.warns(UserWarning, match="128 of 1024 depths lie outside the gate of 13.5 to 16 m"):
        found = spadwarp.denoise.apply(depth, gate=GATE, device="cpu")
    assert np.nanmax(found) <= 16.0


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ({"depth": np.zeros(5)}, "depth is float64"),
        ({"depth": np.ones((4, 40))}, "4 x 40 pixels"),
        ({"depth": -np.ones((32, 32))}, "outside"),
        ({"gate": (16.0, 13.5)}, "gate"),
        ({"gate": (1.0, np.inf)}, "gate"),
        ({"model": "unet"}, "model = 'unet'"),
        ({"profile": [-1.0, 2.0]}, "profile"),
    ],
)
def test_errors_name_what_is_wrong(arguments, said):
    with pytest.raises(ValueError, match=said):
        spadwarp.denoise.apply(**{"depth": np.full((32, 32), 15.0), "gate": GATE, **arguments})


def test_weights_must_be_weights(tmp_path):
    depth = np.full((32, 32), 15.0)
    with pytest.raises(FileError, match="no such file"):
        spadwarp.denoise.apply(depth, gate=GATE, weights=tmp_path / "none.safetensors")
    (tmp_path / "junk.safetensors").write_bytes(b"\x00" * 100)
    with pytest.raises(FileError, match=r"junk.safetensors"):
        spadwarp.denoise.apply(depth, gate=GATE, weights=tmp_path / "junk.safetensors")
    with pytest.raises(FileError, match="weights of 'usdn', not of 'dncnn'"):
        spadwarp.denoise.apply(depth, gate=GATE, model="dncnn", weights=inference.WEIGHTS / "usdn.safetensors")
    with pytest.raises(DeviceError, match="cuda:77"):
        spadwarp.denoise.apply(depth, gate=GATE, device="cuda:77")


@pytest.mark.parametrize("model", MODELS)
def test_the_weights_say_how_they_were_made(model):
    card = inference.weights_metadata(model)
    assert card["model"] == model
    assert card["recipe"]["model"] == model
    assert float(card["hours"]) < 8 / 60
    assert min(card["validation_psnr"].values()) > 10
    assert sum(one.stat().st_size for one in inference.WEIGHTS.iterdir()) < 8e6


@pytest.mark.parametrize("model", MODELS)
def test_the_weights_of_the_package_come_from_the_training_set(model):
    assert inference.weights_metadata(model)["recipe"]["data"] == "data/training"


EXTRA = Path(os.environ.get("SPADWARP_EXTRA_DATA", "")) / "ue_exr"


@pytest.mark.skipif(
    not os.environ.get("SPADWARP_EXTRA_DATA") or not EXTRA.is_dir(), reason="SPADWARP_EXTRA_DATA holds no ue_exr"
)
@pytest.mark.parametrize("name", ["babiao", "cat"])
def test_exports_of_an_engine_are_denoised_as_well_as_other_frames(name):
    """A game engine's depth, in steps of a centimetre, with strays: 20 dB or more are gained at BS 0.264."""
    channels, _ = read_exr(EXTRA / f"{name}_RGBD.EXR")
    clean = channels["A"].astype(np.float32) / 100
    clean[(clean < GATE[0]) | (clean >= GATE[1])] = np.nan
    noisy = noisy_frame(clean, 0.264)
    frames = depth_frames(noisy, gate=GATE)
    found, _ = inference.denoise_frames(frames, model="pyramid", device="cpu")
    before = metrics.score(clean, np.nan_to_num(noisy, nan=14.75), gate=GATE)
    assert metrics.score(clean, found[0], gate=GATE).psnr > before.psnr + 18
