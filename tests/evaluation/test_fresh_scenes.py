"""Fresh scenes: a seed repeats them, and truth, background and response are those of the counts."""

import numpy as np
import pytest

from spadwarp.denoise.classical import classical_depth
from spadwarp.denoise.histograms import count_frames
from spadwarp.evaluation import evaluate_fresh
from spadwarp.evaluation.fresh_scenes import BACKGROUNDS, RESPONSES, SHAPES, TEXTURES, fresh_scene

PIXELS = np.mgrid[:40, :48].astype(float)


@pytest.mark.slow
@pytest.mark.parametrize("number", [0, 1], ids=["drawn", "rendered"])
def test_counts_are_those_of_the_truth(number):
    scene = fresh_scene(11, number, device="cpu")
    again = fresh_scene(11, number, device="cpu")
    assert (scene.counts == again.counts).all() and scene.text == again.text
    seen, bins = np.isfinite(scene.clean), scene.counts.shape[-1]
    # The mean over the pixels of the target of what exceeds the background lies where the truth says.
    start, stop = scene.gate
    place = ((scene.clean - start) / (stop - start) * bins)[seen]
    excess = (scene.counts - scene.background)[seen]
    offset = np.arange(bins) + 0.5 - place[:, None]
    near = np.abs(offset) < max(8.0, 0.03 * bins)
    assert excess[near].sum() > 0.5 * excess.sum()  # the rest is late: a tail, or light scattered forward
    assert scene.response.sum() == pytest.approx(1.0)


def test_every_family_gives_numbers():
    random = np.random.default_rng(0)
    y, x = PIXELS
    for shape in SHAPES.values():
        assert np.isfinite(shape(y, x, random)).mean() > 0.02
    for texture in TEXTURES.values():
        assert (texture(y, x, random) > 0).all()
    for response in RESPONSES.values():
        taps = response(random)
        place = np.arange(taps.size) - taps.size // 2
        assert (taps >= 0).all() and abs((taps * place).sum() / taps.sum()) < 0.6
    for background in BACKGROUNDS.values():
        assert (background((np.arange(64) + 0.5) / 64, random) > 0).all()


@pytest.mark.slow
def test_scores_are_those_of_the_estimates():
    found = evaluate_fresh(scenes=1, seed=11, device="cpu")
    scene, score = fresh_scene(11, 0, device="cpu"), found.scenes[0]
    frames = count_frames(scene.counts, scene.background, scene.response)
    part = classical_depth(frames, method="pooled", tuning=5)
    depth = scene.gate[0] + (scene.gate[1] - scene.gate[0]) * part[0]
    error = (depth - scene.clean)[np.isfinite(scene.clean)]
    assert score.rmse["pooled 5"] == pytest.approx(np.sqrt(np.mean(error**2)), rel=1e-4)
    assert score.ratio == pytest.approx(score.rmse["histograms"] / min(score.classical.values()))
    assert len(score.classical) == 23 and found.seed == 11
    assert score.ratio < 1.5
