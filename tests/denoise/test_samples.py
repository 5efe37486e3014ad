"""The samples of a training: a pool that depends on seed and step alone, the mixture of its noises, its scenes."""

import itertools
import threading
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from spadwarp.denoise import samples, training
from spadwarp.denoise.recipe import Noise, Optimiser, Part, TrainingRecipe
from spadwarp.denoise.samples import PORTIONS, Pool, Scenes, Sizes, crowded, in_open_water
from spadwarp.denoise.synthetic_noise import Batch, CleanScenes, procedural_scenes
from spadwarp.values import DeviceError

CPU = torch.device("cpu")
SHARES = (0.5, 0.3, 0.2)
OPTIMISER = {"batch": 4, "crop": 32, "scenes": 16, "redraw": 5, "pool": 2 * PORTIONS, "uses": 6.0}
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
        found = TrainingRecipe(model="histograms", noise=noise, mixture=mixture, optimiser=Optimiser(pool=PORTIONS))
        assert found.mixture == recipe().mixture
        assert found == TrainingRecipe.model_validate(found) == TrainingRecipe.from_dict(found.model_dump())


@pytest.fixture
def drawn(monkeypatch):
    """Replaces the drawing of noise, which takes long: what it was asked for, and random numbers of its generator."""
    asked = []

    def draw(scenes, noise, *, size, crop, generator, histograms, bins):
        asked.append((scenes, noise, size))
        one = torch.rand(size, 1, 2, 2, generator=generator) + scenes.gate[:1, :1, None, None]
        return Batch(one, one.clone(), one.clone(), torch.ones(size, 1, 1, 1))

    monkeypatch.setattr(samples, "draw_batch", draw)
    return asked


def pool(**changes):
    chosen = recipe(**changes)
    return Pool(chosen, Scenes(chosen, 0, CPU, None), chosen.optimiser.batch, torch.Generator().manual_seed(1))


def sizes(**changes):
    return Sizes(recipe(**changes), 0, 1, torch.Generator().manual_seed(1), None, histograms=True)


def prepare(ours, *steps):
    """What is still to be drawn, all of it drawn; before the last of the steps."""
    for step in steps:
        pieces = list(ours.prepare(step))
    return pieces


def size_of(requests):
    return sum(size for _, _, size in requests)


def test_a_resumed_pool_holds_what_it_would_have_held(drawn):
    for step in (0, 57):
        whole, resumed = pool(), pool()
        prepare(whole, *range(step + 1))
        prepare(resumed, step)
        for mine, theirs in zip(whole.memory, resumed.memory, strict=True):
            filled = int(whole.filled)
            assert filled == int(resumed.filled) > 0
            assert torch.equal(mine[:filled], theirs[:filled])
        assert torch.equal(whole.batch().frame, resumed.batch().frame)


def test_a_sample_is_used_as_often_as_asked(drawn):
    """Once the pool is full: samples taken over samples drawn."""
    ours = pool(redraw=10**6)
    first, steps = 200, 300
    prepare(ours, first)
    before = len(drawn)
    prepare(ours, *range(first + 1, first + steps + 1))
    taken = steps * ours.batch().frame.shape[0]
    assert taken / size_of(drawn[before:]) == pytest.approx(OPTIMISER["uses"], rel=0.02)


def test_a_part_of_the_steps_learns_from_fewer_crops_of_twice_the_side(drawn):
    """As often as asked, with as many pixels a step, and with samples that are used as often as the others; none of
    the steps, or all of them."""
    assert [[kind.scenes.crop for kind in sizes(wide=part).kinds] for part in (0.0, 1.0)] == [[32], [64]]
    ours, steps = sizes(batch=16, wide=0.25, pool=16 * PORTIONS, redraw=10**6), 800
    assert [(kind.size, kind.scenes.crop) for kind in ours.kinds] == [(16, 32), (4, 64)]
    first, taken = 300, {32: 0, 64: 0}
    prepare(ours, first)
    before = len(drawn)
    for step in range(first + 1, first + steps + 1):
        prepare(ours, step)
        taken[ours.of(step).scenes.crop] += ours.of(step).size
    assert abs(taken[64] / 4 / steps - 0.25) < 4 * np.sqrt(0.25 * 0.75 / steps)
    for crop, some in taken.items():
        new = [request for request in drawn[before:] if request[0].depth.shape[-1] == crop + 32]
        assert some / size_of(new) == pytest.approx(OPTIMISER["uses"], rel=0.15)  # portions are of whole samples


def test_how_many_samples_are_due_is_told_of_both_sizes_together(drawn):
    """A crop of twice the side counts as four; 8 portions of each before the first step."""
    ours = sizes(batch=16, wide=0.25, pool=16 * PORTIONS)
    narrow, wide = (kind.portion for kind in ours.kinds)
    numbers, wholes = zip(*prepare(ours, 0), strict=True)
    assert set(wholes) == {8 * (narrow + 4 * wide)} and sorted(numbers) == list(numbers) and numbers[-1] == wholes[0]
    assert prepare(ours, 0) == []


def test_a_pool_takes_only_samples_that_were_drawn(drawn):
    ours = pool()
    prepare(ours, 0)
    seen = {float(value) for value in ours.memory.frame[: int(ours.filled), 0, 0, 0]}
    for _ in range(50):
        assert {float(value) for value in ours.batch().frame[:, 0, 0, 0]} <= seen


def test_parts_have_their_shares_and_their_noise(drawn):
    ours = pool(redraw=10**6)
    prepare(ours, *range(0, 600 * ours.interval, ours.interval))
    photons = np.array([noise.photons[0] for _, noise, _ in drawn])
    for part, share in enumerate(SHARES):
        error = np.sqrt(share * (1 - share) / len(photons))
        assert abs(np.mean(photons == 10.0**part) - share) < 4 * error
    assert {noise.ambient for _, noise, _ in drawn} == {0.4}  # of [noise]


def test_crowded_samples_do_not_judge_the_target(drawn):
    ours = pool()
    prepare(ours, 0)
    for number, (scenes, noise, size) in enumerate(drawn):
        judged = ours.memory.judged[number * size : (number + 1) * size]
        assert bool(judged.any()) == (noise.crowded == 0.0)
        if noise.open_water:
            share = scenes.depth.isfinite().flatten(1).float().mean(1)
            assert ((share > 0.03) & (share < 0.85)).all()


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


def test_drawing_goes_on_in_pieces_and_an_abandoned_one_begins_again(drawn):
    whole, stopped = pool(pool=960), pool(pool=960)  # 24 portions of 40 samples
    pieces = prepare(whole, 0)
    assert pieces == [(done, pieces[-1][1]) for done in range(8, pieces[-1][1] + 1, 8)]
    for number, _ in enumerate(stopped.prepare(0)):
        if number == 7:  # within the second portion
            break
    assert prepare(stopped, 0) == pieces
    assert torch.equal(whole.batch().frame, stopped.batch().frame)
    assert prepare(whole, 0) == []


def test_samples_drawn_on_a_cpu_leave_the_gpu_alone(drawn, monkeypatch):
    def refuse(*_):
        raise AssertionError("a GPU is taken up")

    for name in ("stream", "current_stream", "current_device", "Stream"):
        monkeypatch.setattr(torch.cuda, name, refuse)
    ours = sizes(wide=0.5)
    assert prepare(ours, 0)
    assert all(len(kind.batch().frame) == kind.size for kind in ours.kinds)


def test_a_pool_beyond_the_memory_is_refused():
    problem = r"optimiser\.pool = 9000000 with optimiser\.crop = 64 needs \d+\.\d GiB on cpu"
    with pytest.raises(DeviceError, match=problem):
        sizes(pool=9_000_000, crop=64)


CLOCKS = {
    "late": (itertools.count(0.0, 1.6), 4, [2]),  # more than three seconds after the start, not at the last piece
    "soon": (itertools.count(0.0, 0.8), 4, []),
    # Every half minute; the first piece, which here takes twenty times as long as the others, does not count.
    "long": (itertools.chain([0.0], itertools.count(20.0, 1.0)), 100, [98, 67, 36, 5]),
}


@pytest.mark.parametrize("name", CLOCKS)
def test_how_long_samples_take_is_said(monkeypatch, name):
    """Of a run whose next step needs so many samples."""
    (clock, count, rests), heard = CLOCKS[name], []
    monkeypatch.setattr(training.time, "monotonic", lambda: next(clock))
    pieces = SimpleNamespace(prepare=lambda step: ((drawn, count) for drawn in range(1, count + 1)))
    workers = SimpleNamespace(rank=0, is_cuda=True, any=bool)
    run = SimpleNamespace(step=0, steps_here=0, workers=workers, samples=pieces)
    assert training._prepared(run, threading.Event(), heard.append)
    line = "{} of {} samples are still to be drawn before the next step, about {} s"
    assert heard == [line.format(rest, count, 3 if name == "late" else rest) for rest in rests]
