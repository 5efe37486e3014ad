"""A seed gives the same weights each time, on a CPU and on a GPU: derivatives, and whole trainings."""

from functools import partial

import pytest
import torch
import torch.nn.functional as F
from safetensors.torch import load_file

from spadwarp.denoise import training
from spadwarp.denoise.network_files import MODELS
from spadwarp.denoise.networks import edge_padded, enlarged, permuted
from spadwarp.denoise.recipe import TrainingRecipe
from spadwarp.denoise.synthetic_noise import procedural_scenes

DEVICES = ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]


def same_derivatives(one, other, image):
    """Of sums with random weights, to rounding; the values are equal."""
    image = image.clone().requires_grad_()
    values = [function(image) for function in (one, other)]
    assert torch.equal(*values)
    weights = torch.randn_like(values[0])
    torch.testing.assert_close(*(torch.autograd.grad((value * weights).sum(), image)[0] for value in values))


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("shape", [(1, 1), (1, 5), (6, 3)])
def test_derivatives_of_interpolation_and_padding(shape, device):
    image = torch.randn(2, 3, *shape, dtype=torch.float64, device=device)
    for factor in (2, 4):
        options = {"scale_factor": float(factor), "mode": "bilinear", "align_corners": False}
        same_derivatives(partial(enlarged, factor=factor), partial(F.interpolate, **options), image)
    for reach in (1, 6):
        replicated = partial(F.pad, pad=(reach,) * 4, mode="replicate")
        same_derivatives(partial(edge_padded, reach=reach), replicated, image)


@pytest.mark.parametrize("device", DEVICES)
def test_derivatives_of_permutations(device):
    rows = torch.stack([torch.randperm(9) for _ in range(8)]).to(device)
    image = torch.randn(2, 9, dtype=torch.float64, device=device)
    same_derivatives(partial(permuted, places=rows), lambda x: x[:, rows], image)


def test_settings_of_the_caller_come_back():
    before = torch.backends.cudnn.benchmark, torch.backends.cudnn.deterministic
    with pytest.raises(KeyError), training.fixed_order():
        assert torch.backends.cudnn.deterministic and not torch.backends.cudnn.benchmark
        raise KeyError
    assert (torch.backends.cudnn.benchmark, torch.backends.cudnn.deterministic) == before


@pytest.mark.slow
@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("model", MODELS)
def test_a_seed_gives_the_same_weights(model, device, tmp_path, monkeypatch):
    """Bit by bit; on a GPU also of the steps that are replayed as a CUDA graph."""
    monkeypatch.setattr(training, "PHOTONS", (3.0,))  # of a validation, each of which takes seconds
    gpu, counting = device == "cuda", model == "histograms"
    steps, batch = (40, 4) if gpu else (2, 2)
    optimiser = {"steps": steps, "batch": batch, "crop": 32, "wide": 0.5, "scenes": 4, "redraw": 10, "warm_up": 1}
    optimiser |= {"report_every": steps}
    tables = {"model": model, "seed": 3, "optimiser": optimiser, "noise": {"counting": 1.0} if counting else {}}
    recipe, few = TrainingRecipe.from_dict(tables), procedural_scenes(1, 32, seed=1, device="cpu")
    runs = (training.fit(recipe, None, few, tmp_path / name, device=device) for name in "ab")
    first, second = (load_file(run.weights) for run in runs)
    assert all(torch.equal(values, second[name]) for name, values in first.items())
