"""The samples of a training: the mixture of its noises, its scenes, and areas that pixels see."""

import numpy as np
import pytest
import torch

from spadwarp.denoise import synthetic_noise, training
from spadwarp.denoise.recipe import Noise, Optimiser, Part, TrainingRecipe
from spadwarp.denoise.synthetic_noise import SUBPIXELS, Batch, CleanScenes, draw_batch, procedural_scenes
from spadwarp.denoise.training import Samples, crowded, in_open_water

SHARES = (0.5, 0.3, 0.2)
OPTIMISER = {"batch": 4, "crop": 32, "scenes": 16, "redraw": 10**6}
MIXTURE = [{"share": share, "photons": [10.0**part, 10.0**part]} for part, share in enumerate(SHARES)]
MIXTURE[0]["crowded"] = 1.0
MIXTURE[1]["open_water"] = 1.0


def recipe(**changes):
    tables = {"model": "histograms", "seed": 4, "noise": {"counting": 1.0, "ambient": 0.4}, "mixture": MIXTURE}
    return TrainingRecipe.from_dict({**tables, "optimiser": {**OPTIMISER, **changes}})


@pytest.mark.parametrize("noise", [{"counting": 1.0, "ambient": 0.4}, Noise(counting=1.0, ambient=0.4)])
def test_parts_have_the_noise_of_the_recipe_from_python_too(noise):
    """As tables, as objects, and as a recipe again; what a part gives itself stays."""
    objects = [Part(**{name: tuple(x) if isinstance(x, list) else x for name, x in one.items()}) for one in MIXTURE]
    for mixture in (MIXTURE, tuple(objects)):
        found = TrainingRecipe(model="histograms", noise=noise, mixture=mixture, optimiser=Optimiser(**OPTIMISER))
        assert found.mixture == recipe().mixture
        assert found == TrainingRecipe.model_validate(found) == TrainingRecipe.from_dict(found.model_dump())


@pytest.fixture
def drawn(monkeypatch):
    """Replaces the drawing of noise, which takes long: what it was asked for."""
    asked = []

    def draw(scenes, noise, *, size, crop, generator, histograms, bins, finer):
        asked.append((scenes, noise, size, crop, bins))
        return Batch((torch.rand(size, 1, generator=generator),), *torch.zeros(2, size))

    monkeypatch.setattr(training, "draw_batch", draw)
    return asked


def batches(steps, **changes):
    ours = Samples(recipe(**changes), torch.Generator().manual_seed(1), None)
    for step in range(steps):
        ours.prepare(step)
        ours.batch()


def test_a_part_of_the_steps_learns_from_fewer_crops_of_twice_the_side(drawn):
    batches(400, batch=16, wide=0.25)
    crops = np.array([request[2:4] for request in drawn])
    assert {tuple(one) for one in crops} == {(16, 32), (4, 64)}
    assert abs(np.mean(crops[:, 1] == 64) - 0.25) < 4 * np.sqrt(0.25 * 0.75 / 400)


def test_parts_have_their_shares_and_their_noise(drawn):
    batches(400)
    photons = np.array([noise.photons[0] for _, noise, *_ in drawn])
    for part, share in enumerate(SHARES):
        assert abs(np.mean(photons == 10.0**part) - share) < 4 * np.sqrt(share * (1 - share) / 400)
    assert {noise.ambient for _, noise, *_ in drawn} == {0.4}  # of [noise]
    assert len({bins for *_, bins in drawn}) > 3
    for scenes, noise, *_ in drawn:
        share = scenes.depth.isfinite().flatten(1).float().mean(1)
        assert noise.open_water == 0.0 or ((share > 0.03) & (share < 0.85)).all()


def test_a_pixel_sees_the_area_of_its_subpixels():
    """Halves of the scene 1 m apart, by an edge within the pixels of one column: two thirds of their light is nearer.

    The middle of these pixels, which is their true depth, is nearer, too. Half of the samples see points alone.
    """
    side, width = 16, 16 * SUBPIXELS
    depth = torch.where(torch.arange(width) < 8 * SUBPIXELS + 2, 1.0, 2.0).expand(1, width, width).contiguous()
    scenes = CleanScenes(depth, torch.ones_like(depth), torch.tensor([[0.5, 2.5]]), torch.ones(1, 64))
    plain = dict.fromkeys(("scattered", "two_returns", "resampled", "wrong"), 0.0)
    noise = Noise(counting=1.0, photons=(1e4, 1e4), sbr=(1e3, 1e3), own_gate=1.0, **plain)
    batch = draw_batch(
        scenes, noise, size=64, crop=side, generator=torch.Generator().manual_seed(2), histograms=True, bins=64,
        finer=SUBPIXELS,
    )  # fmt: skip
    (counts, _, _), near = batch.inputs, batch.clean < 0.5
    column = near.float().mean(dim=(2, 3)) * side
    assert batch.clean.unique().numel() == 2 and ((column == 9) | (column == 7)).all()
    share = counts[..., :32].sum(dim=-1) / counts.sum(dim=-1)
    mixed = ((share > 0.1) & (share < 0.9)).flatten(1).sum(dim=1)
    assert ((mixed == 0) | (mixed > side - 4)).all() and 16 < (mixed > 0).sum() < 48
    seen = share[(share > 0.1) & (share < 0.9)]
    assert abs(float(seen.median()) - 2 / 3) < 0.03

    # A gate from 0.5 m that ends between 1.5 and 2 m: the farther half has no depth and sends no light.
    given = {"size": 16, "crop": side, "generator": torch.Generator().manual_seed(2), "histograms": True, "bins": 64}
    batch = draw_batch(scenes, noise.model_copy(update={"cut": 1.0}), finer=SUBPIXELS, **given)
    assert ((batch.clean < 0.5) == (batch.hit > 0)).all() and (batch.clean > 1 / 3).all()
    assert batch.inputs[0].sum(dim=-1)[batch.hit[:, 0] == 0].median() < 100


def test_of_two_scenes_a_pixel_sees_the_nearer():
    scenes = procedural_scenes(12, 48, seed=3, device="cpu")
    both = crowded(scenes)
    pair = torch.stack([scenes.depth, scenes.depth.roll(1, 0)]).nan_to_num(torch.inf)
    assert torch.equal(both.depth.nan_to_num(torch.inf), pair.amin(dim=0))
    sigma = torch.stack([scenes.sigma, scenes.sigma.roll(1, 0)]).gather(0, pair.argmin(dim=0)[None])[0]
    seen = both.depth.isfinite()
    assert torch.equal(both.sigma[seen], sigma[seen])
    low, high = both.gate[:, 0, None, None], both.gate[:, 1, None, None]
    assert (((both.depth > low) & (both.depth < high)) | ~seen).all()
    wall = CleanScenes(torch.ones(3, 8, 8), torch.ones(3, 8, 8), torch.ones(3, 2), torch.ones(3, 64))
    assert in_open_water(wall) is wall  # which has no open water


def test_a_response_that_is_not_known_fits_best_where_the_return_is():
    """Counts of the true response, matched with the one that is given at half bins; tails do not move it."""
    random = synthetic_noise.Random(200, torch.Generator().manual_seed(2))
    response = synthetic_noise._draw_response(random)
    true = response.per_bin()
    assert (true >= 0).all() and ((response.tail > 0).float().mean() - 0.4).abs() < 0.15
    given, at = synthetic_noise._wrong_response(true, random)
    shifts = torch.arange(-8, 9.0) * 0.5
    counts = response.per_bin(-at)
    fit = torch.stack([(counts * (given.per_bin(shift) + 0.01).log()).sum(dim=1) for shift in shifts])
    assert (shifts[fit.argmax(dim=0)] == 0).float().mean() > 0.95  # less where only fractions of a bin differ
    deviation = [(one * torch.arange(-32, 33.0).square()).sum(dim=1).sqrt() for one in (true, given.per_bin())]
    assert 0.3 < (deviation[1] / deviation[0]).min() < 0.7 and 1.5 < (deviation[1] / deviation[0]).max() < 2.2
