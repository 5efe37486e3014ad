"""Backgrounds estimated from counts, against those that the counts were drawn with."""

import warnings

import numpy as np
import pytest
from scipy.stats import norm

from spadwarp import ArgumentError, arrival_time
from spadwarp.denoise import denoise_file, estimate, read_depth
from spadwarp.evaluation.drawn_scenes import evaluation_scene
from spadwarp.frames import InstrumentResponse, depth_of, estimate_background
from spadwarp.frames.backgrounds import bins_of_target
from spadwarp.frames.depth import Histograms

BINS, SIGMA, SIZE = 128, 1.5, (48, 64)
TAPS = norm.pdf(np.arange(-6, 7), scale=SIGMA)
TAPS /= TAPS.sum()
PLACE = (np.arange(BINS) + 0.5) / BINS
BACKSCATTER = np.exp(-3.0 * PLACE) / (0.4 + PLACE) ** 2  # of water from behind the start of the gate


def counts_of(clean, background, photons, *, gate=(13.5, 16.0), scale=1.0, seed=1):
    """Counts of targets at depth `clean` [m], NaN for water, before a background per bin."""
    seen = np.isfinite(clean)
    place = (np.where(seen, clean, gate[0]) - gate[0]) / (gate[1] - gate[0]) * BINS
    signal = np.diff(norm.cdf(np.arange(BINS + 1) - place[..., None], scale=SIGMA), axis=-1)
    rate = photons * seen[..., None] * signal + background * np.broadcast_to(scale, clean.shape)[..., None]
    return np.random.default_rng(seed).poisson(rate).astype(np.int32)


def backscatter(counts):
    return counts * (0.8 * BACKSCATTER / BACKSCATTER.sum() + 0.2 / BINS)


@pytest.mark.parametrize("setting", ["wall", "floor", "open water"])
def test_a_decaying_background_is_found_between_the_returns(setting):
    """Mean deviation over the gate, weighted with the background, of a few per cent."""
    clean = evaluation_scene("stairs", setting, size=SIZE).clean
    level = backscatter(30.0)
    found = estimate_background(counts_of(clean, level, 20.0), TAPS)
    assert found.decays and np.abs(found.per_bin - level).sum() < 0.04 * level.sum()
    assert "decays and a constant" in found.summary


def test_a_return_that_all_pixels_share_is_no_background():
    clean = np.full(SIZE, 14.6)
    level = backscatter(30.0)
    found = estimate_background(counts_of(clean, level, 20.0), TAPS)
    assert np.abs(found.per_bin - level).sum() < 0.05 * level.sum() and 0.05 < found.interpolated < 0.3


def test_a_wall_ends_the_water_before_it():
    """A slanted wall over half of the gate: decays alone miss a third of such a background."""
    clean = 14.5 + 0.9 * np.linspace(0.0, 1.0, SIZE[1]) + np.zeros(SIZE)
    wall = (clean[..., None] - 13.5) / 2.5 > PLACE
    level = 80.0 * np.exp(-PLACE) / BINS * wall + 0.01
    found = estimate_background(counts_of(clean, 0.0, 15.0) + np.random.default_rng(4).poisson(level), TAPS)
    mean = level.mean(axis=(0, 1))
    assert found.falls and "a falling course" in found.summary
    assert np.abs(found.per_bin - mean).sum() < 0.15 * mean.sum()


def test_dim_returns_are_no_gate_that_opens():
    """Half a photon a pixel, from a surface that bends away: the counts before it are the background's."""
    clean = 13.8 + 0.8 * np.linspace(0.0, 1.0, SIZE[1]) ** 2 + np.zeros(SIZE)
    level = backscatter(0.8)
    for seed in range(2, 8):
        found = estimate_background(counts_of(clean, level, 0.5, seed=seed), TAPS)
        assert np.abs(found.per_bin - level)[:20].sum() < 0.5 * level[:20].sum()


def test_ambient_light_may_follow_the_reflectance():
    """Neighbours on both sides of an edge have a background that differs four times; the mean is that of all pixels."""
    scale = np.where(np.arange(SIZE[1]) < 32, 0.4, 1.6)
    level = np.full(BINS, 60.0 / BINS)
    counts = counts_of(np.where(np.arange(SIZE[1]) % 20 < 10, 14.5, 15.0) + np.zeros(SIZE), level, 3.0, scale=scale)
    found = estimate_background(counts, TAPS)
    assert not found.decays and found.per_bin.sum() == pytest.approx(60.0, rel=0.03)
    assert np.abs(found.scale - scale).mean() < 0.06
    assert np.allclose(found.counts, found.scale[..., None] * found.per_bin)


def test_the_standard_error_is_that_of_many_frames():
    level, clean = np.full(BINS, 0.05), np.full((24, 24), np.nan)
    found = [estimate_background(counts_of(clean, level, 0.0, seed=seed), TAPS) for seed in range(40)]
    z = [(one.per_bin.sum() / level.sum() - 1.0) / one.relative_error for one in found]
    assert 0.6 < np.std(z) < 1.4 and abs(np.mean(z)) < 0.6
    assert sum(one.decays for one in found) <= 2


def test_laws():
    level = backscatter(30.0)
    counts = counts_of(np.full((24, 24), np.nan), level, 0.0)
    flat = estimate_background(counts, TAPS, law="flat")
    assert np.ptp(flat.per_bin) == 0 and not flat.decays and flat.scale is None
    assert not estimate_background(counts, TAPS, law="none").per_bin.any()
    assert np.isfinite(estimate_background(0 * counts, TAPS).per_bin).all()
    two = estimate_background(np.stack([counts, counts]), TAPS).per_bin
    assert np.allclose(two, estimate_background(counts, TAPS).per_bin, rtol=0.02)
    with pytest.raises(ArgumentError, match="background = 'linear' is not one of"):
        estimate_background(counts, TAPS, law="linear")
    with pytest.raises(ArgumentError, match="counts have shape"):
        estimate_background(counts[0], TAPS)


def test_depth_is_as_good_as_with_the_true_background(tmp_path):
    """From Python and from a file."""
    clean, gate = evaluation_scene("vase", "open water", size=SIZE).clean, (13.5, 16.0)
    common = {"gate": gate, "response": TAPS, "device": "cpu", "min_significance": 0}
    level, seen = backscatter(50.0), np.isfinite(clean)
    counts = counts_of(clean, level, 15.0)
    depth = gate[0] + (gate[1] - gate[0]) * (counts.argmax(axis=-1) + 0.5) / BINS
    rmse, invented = {}, {}
    for name, given in {"true": level, "estimated": "decay"}.items():
        found = estimate(depth, counts=counts, background=given, **common)
        rmse[name] = np.sqrt(np.mean((found.depth - clean)[seen] ** 2))
        invented[name] = np.mean(found.target_probability[~seen] > 0.5)
    assert rmse["estimated"] < 1.3 * rmse["true"] < 0.02
    assert invented["estimated"] < 0.02
    np.save(tmp_path / "counts.npy", counts)
    time = {"bin_width": 2.0 * (gate[1] - gate[0]) / 299792458.0 / BINS, "gate_start": 2.0 * gate[0] / 299792458.0}
    options = time | {"irf": InstrumentResponse(sigma=SIGMA * time["bin_width"]), "group_index": 1.0, "axes": "yxt"}
    done = denoise_file(tmp_path / "counts.npy", tmp_path / "out", device="cpu", **options)
    assert any(note.count("background estimated from the frame: decays") for note in done.notes)
    assert np.sqrt(np.mean((done.depth[0] - clean)[seen] ** 2)) < 1.5 * rmse["true"]


def test_a_file_may_have_its_background_given(tmp_path):
    counts = counts_of(np.full((16, 16), 14.6), np.full(BINS, 0.05), 5.0)
    np.save(tmp_path / "counts.npy", counts)
    facts = {"bin_width": 130e-12, "gate_start": 0.0, "group_index": 1.0}
    options = facts | {"irf": InstrumentResponse(sigma=170e-12)}
    read = read_depth(tmp_path / "counts.npy", background=np.full(BINS, 0.05), **options)
    assert read.histograms.level_known and np.allclose(read.histograms.background, 0.05)
    assert not read_depth(tmp_path / "counts.npy", background="none", **options).histograms.background.any()
    with pytest.raises(ArgumentError, match=r"background has shape \(5,\)"):
        read_depth(tmp_path / "counts.npy", background=np.ones(5), **options)
    with pytest.raises(ArgumentError, match=r"counts.npy: bin width is missing \(bin_width\)"):
        read_depth(tmp_path / "counts.npy", gate_start=0.0, irf=options["irf"])
    with pytest.raises(ArgumentError, match="background is of counts"), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        read_depth(tmp_path / "counts.npy", background="flat", **facts)
    np.save(tmp_path / "depth.npy", np.full((16, 16), 14.6))
    with pytest.raises(ArgumentError, match="holds depth: background are of histograms"):
        read_depth(tmp_path / "depth.npy", background="flat")


def test_no_surface_is_left_out_that_can_be_told_from_the_background():
    """A wall; a plate of a fortieth of its light, that all pixels together hardly show; one pixel with a return."""
    rate = np.full((64, 64, 512), 0.1)
    rate[..., 200:205] += 0.6
    rate[20:30, 20:30, 200:205] -= 0.6
    rate[20:30, 20:30, 330:335] += 0.6
    counts, level = np.random.default_rng(1).poisson(rate), np.full(512, 0.1, np.float32)
    first, stop = bins_of_target(counts, level, np.ones(5))
    assert 130 < first < 200 and 335 <= stop < 400
    counts[5, 5, 440] += 30
    assert bins_of_target(counts, level, np.ones(5))[1] > 441


def test_depth_of_measured_counts_by_the_same_estimate():
    """A flat background makes depths of backscatter of a quarter of the target."""
    clean = evaluation_scene("stairs", "open water", size=SIZE).clean
    width, seen = 2.0 * 2.5 / 299792458.0 / BINS, np.isfinite(clean)
    irf = InstrumentResponse(sigma=SIGMA * width)
    facts = {"bin_width": width, "gate_start": 27.0 / 299792458.0, "irf": irf, "response": irf}
    counts = Histograms(values=counts_of(clean, backscatter(50.0), 15.0), **facts)
    wrong = {}
    for law in (None, "flat"):
        options = {"method": "likelihood", "group_index": 1.0, "background": law, "device": "cpu"}
        every = depth_of(counts, **options, min_significance=0)
        wrong[law] = np.mean(np.abs(every.range[0] - clean)[seen] > 0.05)
    assert wrong[None] < 0.002 and wrong["flat"] > 0.2 and "a constant" in every.notes[0]
    reported = np.isfinite(depth_of(counts, method="likelihood", group_index=1.0, device="cpu").first)
    assert reported[seen].mean() > 0.9 and reported[~seen].mean() < 0.003


@pytest.mark.parametrize("photons", [0.0, 5.0, 50.0, 500.0])
def test_false_alarms_in_front_of_nothing_are_as_asked(photons):
    """Empty water behind a gate that opens, and dark counts: of 6144 pixels at most 1 % beyond 3.5 deviations."""
    opening = backscatter(photons) * np.clip((PLACE - 0.05) / 0.05, 0.0, 1.0)
    for level in (backscatter(photons), opening, np.full(BINS, photons / BINS)):
        counts, found = counts_of(np.full((64, 96), np.nan), level, 0.0), np.empty((64, 96), np.float32)
        arrival_time(counts, gate_start=0.0, bin_width=1e-10, significance=found, device="cpu")
        assert (found >= 2.0).sum() <= 61.4 + 3.5 * np.sqrt(61.4)


def test_a_background_that_rises_while_the_gate_opens_is_found():
    clean = evaluation_scene("stairs", "open water", size=SIZE).clean
    level = backscatter(30.0) * norm.cdf((PLACE - 0.15) / 0.05)
    found = estimate_background(counts_of(clean, level, 20.0), TAPS)
    assert np.abs(found.per_bin - level).sum() < 0.06 * level.sum()
    assert np.abs(found.per_bin - level)[: BINS // 5].sum() < 0.1 * level[: BINS // 5].sum()


def test_in_a_bin_wider_than_the_response_the_light_of_a_pixel_says_where():
    """A wall at a tenth of a bin, by methods that know bins alone."""
    counts = np.random.default_rng(3).poisson(0.2, (16, 16, 12))
    counts[..., 6] += 40
    common = {"counts": counts, "response": [0.0, 1.0, 0.0], "background": "flat", "device": "cpu", "gate": (1.0, 7.0)}
    for model in ("likelihood", "histograms"):
        found = estimate(np.full((16, 16), 4.05, np.float32), model=model, **common)
        assert np.median(found.depth) == pytest.approx(4.05, abs=1e-4)


@pytest.mark.parametrize(("pitch", "unsure"), [(40.0, False), (5.0, True)])
def test_depths_of_which_the_network_is_unsure_are_named(tmp_path, pitch, unsure):
    """A folded sheet, seen aslant: 2 cm, or 20 cm, from pixel to pixel."""
    y, x = np.mgrid[:64, :64]
    sheet = 13.7 + np.abs((0.6 * x + 0.8 * y) / pitch % 2 - 1)
    np.save(tmp_path / "sheet.npy", sheet + np.random.default_rng(1).normal(0.0, 0.004, sheet.shape))
    found = denoise_file(tmp_path / "sheet.npy", tmp_path / "out", gate=(13.5, 16.0), device="cpu")
    notes = [note for note in found.notes if note.startswith("unsure: half of the targets' depths")]
    assert bool(notes) == unsure and all("sheet_confidence.npy" in note for note in notes)


def test_frames_that_denoising_makes_worse_are_named(tmp_path):
    """Noise of 1 mm before a wall: USDN moves pixels by centimetres. In open water with backscatter none is worse."""
    generator = np.random.default_rng(1)
    clean = evaluation_scene("stairs", "wall", size=SIZE).clean
    np.save(tmp_path / "wall.npy", clean + generator.normal(0.0, 1e-3, SIZE))
    clean = evaluation_scene("vase", "open water", size=SIZE).clean
    seen, backscatter = np.isfinite(clean), 13.5 + generator.exponential(0.4, SIZE)
    noisy = np.where(generator.random(SIZE) < np.where(seen, 0.75, 0.0), clean, backscatter)
    np.save(tmp_path / "water.npy", np.where(seen | (generator.random(SIZE) < 0.4), noisy, np.nan))

    def denoised(name, model):
        found = denoise_file(tmp_path / name, tmp_path / model, model=model, gate=(13.5, 16.0), device="cpu")
        return found.depth[0], [note for note in found.notes if note.startswith("worse")]

    assert not denoised("wall.npy", "pyramid")[1]
    assert denoised("wall.npy", "usdn")[1][0].startswith("worse: the input's noise is 1")
    for model in ("pyramid", "dncnn"):
        depth, worse = denoised("water.npy", model)
        assert np.std((depth - clean)[seen]) < 0.5 * np.std((noisy - clean)[seen]) and not worse
