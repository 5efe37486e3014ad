"""Networks, the noise that they are trained on, and their training."""

import json
import signal

import numpy as np
import pytest
import torch
from safetensors.torch import load_file
from torch.utils.flop_counter import FlopCounterMode

from spadwarp import ConfigError, FileError
from spadwarp.denoise import network_files, networks
from spadwarp.denoise.recipe import Noise, TrainingRecipe, load_training_recipe
from spadwarp.denoise.synthetic_noise import BINS, Batch, CleanScenes, draw_batch, procedural_scenes
from spadwarp.denoise.training import Muon, fit, histogram_loss, loss_of


def scenes(count=4, size=64):
    """Tilted planes with a step, 14–15.5 m; a corner sees nothing."""
    y, x = torch.meshgrid(torch.linspace(0, 1, size), torch.linspace(0, 1, size), indexing="ij")
    depth = torch.stack([14.0 + 0.3 * k * x + 0.5 * (y > 0.3 + 0.1 * k) for k in range(count)])
    depth[:, : size // 8, : size // 8] = torch.nan
    gate = torch.tensor([13.5, 16.0]).expand(count, 2).contiguous()
    profile = torch.linspace(1.8, 0.2, BINS).expand(count, BINS).contiguous()
    return CleanScenes(depth, torch.full_like(depth, 0.002), gate, profile)


# No other noise than what a test asks for.
PLAIN = {"sigma_scale": (1.0, 1.0), "own_gate": 1.0, "own_profile": 1.0}
PLAIN |= dict.fromkeys(("slanted_gate", "counting", "scattered", "dead", "unknown_water"), 0.0)
PLAIN |= dict.fromkeys(("hot", "sparse", "tail", "two_returns", "wide_gate"), 0.0)


def draw(plain, *, size=64, crop=64, seed=3):
    generator = torch.Generator().manual_seed(seed)
    return draw_batch(scenes(), plain, size=size, crop=crop, generator=generator, always_replaced=True)


def test_networks_have_the_weights_and_the_cost_that_they_state():
    """DehazeNet has 8 240 weights for three channels of input, of which USDN has one."""
    layers = [one for one in networks.USDN().modules() if isinstance(one, torch.nn.Conv2d)]
    assert sum(one.weight.numel() for one in layers) + 2 * 5 * 5 * 16 == 8240
    multiply_adds = {}
    for name in ("pyramid", "dncnn"):
        with torch.no_grad(), FlopCounterMode(display=False) as counter:
            networks.NETWORKS[name]().eval()(torch.zeros(1, 3, 64, 64))
        multiply_adds[name] = counter.get_total_flops() // 2
    assert multiply_adds["dncnn"] == 64 * 64 * (9 * 64 * 2 + 15 * 9 * 64 * 64) > 6 * multiply_adds["pyramid"]


def test_order_statistics_are_those_of_a_sort():
    image = torch.rand(2, 1, 11, 9, generator=torch.Generator().manual_seed(1))
    padded = torch.nn.functional.pad(image, (1, 1, 1, 1), mode="replicate")[:, 0]
    expected = padded.unfold(1, 3, 1).unfold(2, 3, 1).flatten(3).sort(dim=-1).values
    for rank, values in zip((2, 4, 6), networks.ranks(image), strict=True):
        assert torch.equal(values[:, 0], expected[..., rank])


def test_muon_moves_all_directions_alike_and_as_far_as_adamw():
    """Of a gradient whose singular values differ by a thousand; AdamW's have a root mean square of about 0.2 rates."""
    generator = torch.Generator().manual_seed(7)
    for shape in ((48, 16), (16, 9, 3, 3)):
        rows, columns = torch.zeros(shape).flatten(1).shape
        left, right = (torch.linalg.qr(torch.randn(n, 16, generator=generator))[0] for n in (rows, columns))
        parameter = torch.nn.Parameter(torch.zeros(shape))
        parameter.grad = (left * torch.logspace(-3, 0, 16) @ right.T).view(shape)
        Muon([parameter], {"lr": 0.01, "weight_decay": 0.1}).step()
        step = parameter.detach().flatten(1)
        found = torch.linalg.svdvals(step)
        assert found[-1] > 0.1 * found[0] and found[3:12].min() > 0.5 * found[0]
        assert step.square().mean().sqrt().item() == pytest.approx(0.01 * 0.2, rel=0.3)
        assert -(parameter.grad.flatten(1) * step).sum() > 0.0


def test_pyramid_turns_with_its_frame():
    """All eight turns and reflections, with weights drawn at random; and the way with derivatives gives the same."""
    torch.manual_seed(3)
    network = networks.NETWORKS["pyramid"]().eval()
    with torch.no_grad():
        for values in network.parameters():
            values.add_(0.02 * torch.randn(values.shape))
    frame = torch.rand(1, 3, 32, 32)
    frame[:, 1] = (frame[:, 1] > 0.2).float()
    learning = network(frame).detach()
    with torch.inference_mode():
        found = network(frame)
        assert torch.allclose(found, learning, atol=1e-5)
        for turn in range(8):
            turned = [torch.rot90(x.flip(-1) if turn >= 4 else x, turn % 4, (-2, -1)) for x in (frame, found)]
            close = torch.isclose(network(turned[0]), turned[1], atol=1e-3)
            assert close.float().mean() > 0.99  # a pixel may choose between candidates that are equally good


def test_pyramid_takes_no_depth_from_pixels_that_report_nothing():
    """Where nothing is reported the answer is the network's own value, whatever stands in place of a depth."""
    network = networks.PyramidNet().eval()
    frame = torch.rand(1, 3, 32, 32, generator=torch.Generator().manual_seed(2))
    frame[:, 1] = 0.0
    with torch.no_grad():
        network.scalars.weight.zero_()
        assert torch.allclose(network(frame)[:, 0], torch.tensor(0.5), atol=1e-4)


def test_drawn_scenes_are_varied_and_repeatable():
    first, again = (procedural_scenes(40, 48, seed=5, device="cpu") for _ in range(2))
    assert torch.equal(first.depth.nan_to_num(), again.depth.nan_to_num())
    seen = torch.isfinite(first.depth)
    share = seen.float().mean(dim=(1, 2))
    assert (share < 0.02).any() and (share == 1.0).any() and ((share > 0.1) & (share < 0.9)).sum() > 6
    low, high = first.gate[:, 0, None, None], first.gate[:, 1, None, None]
    assert (((first.depth > low) & (first.depth < high)) | ~seen).all()
    assert (first.sigma[seen] > 0).all() and torch.isnan(first.sigma[~seen]).all()
    one, same, other = (draw(Noise(), size=8, seed=seed) for seed in (1, 1, 2))
    assert torch.equal(one.inputs[0], same.inputs[0]) and torch.equal(one.clean, same.clean)
    assert not torch.equal(one.inputs[0], other.inputs[0])


@pytest.mark.parametrize("level", [0.042, 0.48])
def test_the_backscatter_fraction_is_that_of_the_recipe(level):
    batch = draw(Noise(backscatter=(level, level), behind=1.0, **PLAIN))
    seen = batch.hit > 0
    off = (batch.inputs[0][:, :1] - batch.clean).abs() > 5 * 0.002 / 2.5
    missed = 2 * 5 * 0.002 / 2.5  # backscatter at the target's depth by chance, at most twice the mean density
    share, count = float(off[seen].float().mean()), int(seen.sum())
    error = np.sqrt(level * (1 - level) / count)
    assert level * (1 - 1.8 * missed) - 4 * error < share < level + 4 * error


def test_backscatter_follows_the_profile_up_to_the_target():
    batch = draw(Noise(backscatter=(1.0, 1.0), behind=0.0, **PLAIN))
    seen = batch.hit > 0
    reported, clean = batch.inputs[0][:, :1][seen], batch.clean[seen]
    assert (reported <= clean + 1e-5).all()
    # Distribution of the profile 1.8 … 0.2: its integral to u is 1.8 u − 0.8 u².
    share = (1.8 * reported - 0.8 * reported**2) / (1.8 * clean - 0.8 * clean**2)
    counts = torch.histc(share, 20, 0.0, 1.0).numpy()
    expected = len(share) / 20
    chi2 = float(((counts - expected) ** 2 / expected).sum())
    assert chi2 < 43.8  # p > 1e-3 at 19 degrees of freedom


def test_the_input_holds_the_density_at_the_reported_depth():
    frame = draw(Noise(backscatter=(0.5, 0.5), **PLAIN)).inputs[0]
    reported = frame[:, 1] > 0
    depth, density = frame[:, 0], frame[:, 2]
    assert torch.allclose(density[reported].exp(), 1.8 - 1.6 * depth[reported].clamp(0, 1), atol=0.03)
    assert (depth[~reported] == 1.0).all() and (density[~reported] == 0.0).all()


@pytest.mark.parametrize("photons", [4.0, 100.0])
def test_frames_of_counts_reach_the_bound_where_background_is_rare(photons):
    """Centroid of n photons: σ/√n, besides 1/12 of a bin's square; σ is 0.6 to 5 of 192 bins."""
    plain = Noise(photons=(photons, photons), sbr=(8.0, 8.0), **{**PLAIN, "counting": 1.0})
    batch = draw(plain, size=12)
    inner = (batch.hit > 0) & (batch.inputs[0][:, 1:2] > 0)
    error = (batch.inputs[0][:, :1] - batch.clean)[inner].abs() * 192
    median = 0.6745 * np.sqrt((1.75**2 + 1 / 12) / photons)
    assert 0.7 * median < float(error.median()) < 1.7 * median


def test_crops_without_a_target_do_not_count_for_depth():
    frame, clean, hit = torch.rand(2, 3, 32, 32), torch.full((2, 1, 32, 32), 0.4), torch.ones(2, 1, 32, 32)
    hit[1], clean[1] = 0.0, 1.0
    for some in (1, 2):
        batch = Batch((frame[:some],), clean[:some], hit[:some])
        output = torch.full((some, 1, 32, 32), 0.5)
        assert loss_of(output, batch) == pytest.approx(0.1 * np.log(0.01), rel=1e-3)
    hit = (torch.rand(1, 1, 32, 32) > 0.5).float()
    depth = torch.full((1, 1, 32, 32), 0.5)
    wrong, right = (torch.cat([depth, 9 * sign * (2 * hit - 1), depth, depth], dim=1) for sign in (-1, 1))
    batch = Batch((frame[:1],), depth, hit)
    more = loss_of(wrong, batch) - loss_of(right, batch)
    assert more == pytest.approx(0.3 * 9, rel=1e-4)


def test_the_loss_of_a_distribution_is_least_at_the_truth():
    """The truth lies between bins 20 and 21; a crop of water counts for the target alone."""
    clean, hit = torch.full((2, 1, 8, 8), 20.9 / 32), torch.ones(2, 1, 8, 8)
    hit[1] = 0.0
    batch, logit = Batch((), clean, hit), 20.0 * (2.0 * hit[:, 0] - 1.0)

    def loss(probability, logit=logit):
        return float(histogram_loss(torch.tensor(probability).log().expand(2, 8, 8, 32), logit, batch))

    right, beside, even = np.full((3, 32), 1e-6, np.float32)
    right[20:22], beside[21:23], even[:] = (0.6, 0.4), (0.6, 0.4), 1 / 32
    assert loss(right) + 1.0 < loss(beside) < loss(even)
    assert loss(right, -logit) == pytest.approx(loss(right) + 20.0, rel=1e-3)


OPTIMISER = {"steps": 6, "batch": 2, "crop": 32, "report_every": 3, "warm_up": 2}
COUNTS = {"model": "histograms", "noise": {"counting": 1.0}}
RECIPE = {"model": "usdn", "data": "none", "seed": 4, "optimiser": OPTIMISER}


def train(folder, given=None, *, progress=None, **changes):
    recipe, given = TrainingRecipe.from_dict({**RECIPE, **changes}), given or scenes()
    return fit(recipe, given, given, folder, device="cpu", progress=progress)


@pytest.mark.parametrize("wide", [0.0, 0.5])
def test_an_interrupted_run_ends_like_one_that_was_not(tmp_path, wide):
    """After a checkpoint of the first step (Ctrl-C), one between two reports (SIGTERM), and one that died after it."""

    def at(step, action, *arguments):
        return lambda stage, done, total: action(*arguments) if done == step else None

    optimiser = {**OPTIMISER, "wide": wide}
    whole = train(tmp_path / "whole", optimiser=optimiser)
    for step, number in ((1, signal.SIGINT), (4, signal.SIGTERM)):
        with pytest.raises(KeyboardInterrupt, match=rf"interrupted at step {step} of 6; .*checkpoint\.pt"):
            train(tmp_path / "parts", progress=at(step, signal.raise_signal, number), optimiser=optimiser)
        assert torch.load(tmp_path / "parts" / "checkpoint.pt", weights_only=True)["step"] == step
    with pytest.raises(ZeroDivisionError):
        train(tmp_path / "parts", progress=at(5, divmod, 1, 0), optimiser=optimiser)
    parts = train(tmp_path / "parts", optimiser=optimiser)
    for name, values in load_file(whole.weights).items():
        assert torch.equal(values, load_file(parts.weights)[name]), name
    reference, lines = ([json.loads(line) for line in run.log.read_text().splitlines()] for run in (whole, parts))
    assert [line["step"] for line in lines] == [0, 3, 6] and lines[0]["loss"] is None
    assert lines[-1]["mean_psnr"] == pytest.approx(whole.psnr, abs=1e-3)
    assert [line["loss"] for line in lines[1:]] == pytest.approx([line["loss"] for line in reference[1:]], rel=1e-5)


@pytest.mark.parametrize(
    ("size", "wide", "problem"),
    [
        (48, 0.0, r"optimiser\.crop = 64 is outside \[32, 48\]"),
        (80, 0.5, r"optimiser\.crop = 64 with optimiser\.wide = 0\.5 is outside \[32, 40\]"),
        (31, 0.0, r"data: scenes of 31 x 31 pixels; at least 32 x 32 are needed"),
        (48, 0.5, r"data: scenes of 48 x 48 pixels with optimiser\.wide = 0\.5; at least 64 x 64 are needed"),
    ],
)
def test_crops_that_no_scene_holds_are_refused(tmp_path, size, wide, problem):
    with pytest.raises(ConfigError, match=problem):
        train(tmp_path, scenes(size=size), optimiser={**OPTIMISER, "crop": 64, "wide": wide})


@pytest.mark.slow
def test_a_training_starts_from_the_weights_of_the_package(tmp_path):
    noise = {"counting": 1.0, "scattered": 0.5, "events": [1.0, 10.0]}
    once = {**OPTIMISER, "steps": 2, "report_every": 2}
    done = train(
        tmp_path, scenes(count=1, size=32), model="histograms", start="histograms", noise=noise, optimiser=once
    )
    learnt = load_file(done.weights)
    for name, values in networks.load_network("histograms").state_dict().items():
        assert torch.allclose(learnt[name].float(), values, atol=0.01), name  # two steps
    validation = network_files.weights_metadata("histograms", done.weights)["validation_psnr"]
    assert set(validation) == {"1.000", "3.000", "10.000", "30.000", "100.000"}


def test_training_without_a_dataset_draws_scenes_and_says_how_long_it_takes(tmp_path):
    said, optimiser = [], {**OPTIMISER, "scenes": 4, "redraw": 1}
    recipe = TrainingRecipe.from_dict({"model": "usdn", "seed": 4, "optimiser": optimiser})
    assert fit(recipe, None, None, tmp_path, device="cpu", notify=said.append).weights.is_file()
    assert said[0] == "1 step to go, about 1.0 s"  # no advice for so short a time


def test_a_folder_holds_one_recipe(tmp_path):
    train(tmp_path)
    for change, problem in (
        ({"seed": 5}, r"another recipe \(seed = 4, here 5\); choose another folder"),
        ({"optimiser": {**OPTIMISER, "steps": 3}}, r"steps = 6, here 3; its learning rate decreases over all steps\)"),
        ({"noise": {"hot": 0.02}}, r"\(noise.hot = 0.01, here 0.02\)"),
    ):
        with pytest.raises(ConfigError, match=problem):
            train(tmp_path, **change)
    (tmp_path / "checkpoint.pt").write_bytes(b"no")
    with pytest.raises(FileError, match="damaged"):
        train(tmp_path)
    with pytest.raises(FileError, match="cannot be read"):
        load_training_recipe(tmp_path / "none.toml")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"noise": {"backscatter": [0.5, 0.2]}}, r"noise.backscatter = \[0.5, 0.2\] is not \(lowest"),
        ({"optimiser": {"crops": 3}}, r"optimiser.crops"),
        ({"model": "histograms"}, r"noise.counting"),
        ({"start": "pyramid"}, r"start"),
        ({"mixture": [{"share": 1.0}]}, r"mixture with model = 'usdn'"),
        ({**COUNTS, "mixture": [{"share": 0.4}, {"share": 0.5}]}, r"shares add up to 0.9, not to 1"),
        ({**COUNTS, "mixture": [{"share": 1.0, "photons": [0.0, 2.0]}]}, r"mixture.*photons"),
        ({**COUNTS, "mixture": [{"share": 1.0, "counting": 0.5}]}, r"noise.counting = 0.5"),
    ],
)
def test_errors_in_a_recipe_name_the_field(change, message):
    with pytest.raises(ConfigError, match=message):
        TrainingRecipe.from_dict({**RECIPE, **change})
