"""Every kind of picture at the widths of a page and of a column."""

import contextlib
import importlib.util
import json
import os
import sys
from pathlib import Path

import numpy as np
import pytest
from matplotlib.colors import LogNorm, to_rgb

import spadwarp
from helpers import datasets
from helpers.synthetic_result import make_result, make_scene
from spadwarp.frames import record_frames
from spadwarp.mesh import describe_mesh
from spadwarp.viz import curves, evaluation, style, viewer
from spadwarp.viz.result import draw_denoised, draw_depth
from spadwarp.viz.style import shown_limits, target_limits

FOLDER = os.environ.get("SPADWARP_TEST_PICTURES")  # where the pictures stay, to be looked at
METHODS = ("input", "median", "gating", "bm3d", "usdn", "dncnn", "pyramid")
LEVELS = ("0.042", "0.183", "0.264", "0.337", "0.394", "0.480")


@pytest.fixture(scope="module")
def result():
    laser = {"position": [0.1, 0.0, 0.0], "repetition_rate": 5e6, "pulse_fwhm_ps": 100.0}
    return make_result(make_scene(width=32, height=24, bins=96, laser=laser))


@pytest.fixture(scope="module")
def frames(result):
    return spadwarp.detect(result, pulses=2_000_000, frames=2, seed=4, device="cpu")


@pytest.fixture(scope="module")
def recording(result, tmp_path_factory):
    options = {"pulses": 2_000_000, "frames": 1, "seed": 4, "methods": ("peak", "matched"), "device": "cpu"}
    return record_frames(result, tmp_path_factory.mktemp("recording") / "frames.h5", **options).file


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return datasets.make(datasets.recipe(), tmp_path_factory.mktemp("data") / "set").folder


SCENE = make_scene(width=12, height=8)


def scores():
    random = np.random.default_rng(1)
    fields = {"psnr": 20.0, "ssim": 0.5, "entropy": 3.0, "rmse_mm": 50.0, "edge_mm": 9.0}
    keys = [(m, t, level) for m in METHODS for t in ("staircase", "diver_helmet") for level in LEVELS]
    return {key: {name: top * random.uniform(0.5, 1.0) for name, top in fields.items()} for key in keys}


def samples():
    truth = np.full((24, 32), np.nan, np.float32)
    truth[5:20, 8:25] = np.linspace(14.0, 15.0, 17)
    found = np.where(np.random.default_rng(1).random((24, 32)) < 0.1, np.nan, np.nan_to_num(truth, nan=15.5))
    caption = "diver_helmet, backscatter fraction 0.183; 34.1 signal photons, 1.3 attenuation lengths one way, sample 3"
    return [(truth, (13.5, 16.0), dict.fromkeys(METHODS, found), caption)] * 2


def rows():
    row = {"value": 1.01, "reference": 1.0, "standard_error": 0.02, "z": 0.5}
    names = {"mean free path [m]": True, "second moment of the distance across the beam [m²]": False}
    return [{"quantity": name, "passed": passed, **row} for name, passed in names.items()]


def draw_scores(path, **_):
    names = {"methods": METHODS, "targets": ("staircase", "diver_helmet"), "levels": LEVELS}
    evaluation.draw_scores(scores(), path, note="64 frames of 256 x 192 pixels; split test", **names)


def draw_samples(path, **_):
    evaluation.draw_samples(samples(), path, methods=METHODS, note="split test", rescaled=True)


def draw_ranking(path, **_):
    better = {"psnr": True, "ssim": True, "rmse_mm": False, "edge_mm": False}
    means = {name: scores()[name, "staircase", "0.042"] for name in METHODS}
    evaluation.draw_ranking(means, path, larger_is_better=better, note="split test")


def draw_reliability(path, **_):
    table = np.stack([np.full(10, 500), np.linspace(20, 480, 10)], axis=1).astype(np.int64)
    tables = {(name, of): table for name in ("pyramid", "histograms") for of in ("target", "confidence")}
    evaluation.draw_reliability(tables, path)


def draw_photon_sweep(path, **_):
    photons = np.geomspace(1.0, 1000.0, 7)
    error = 0.1 / np.sqrt(photons) * np.ones((3, 1))
    rmse = {name: (2 + k) * error for k, name in enumerate(("input", "median", "pooled", "histograms"))}
    ratios = (0.1, 1.0, 10.0)
    evaluation.draw_photon_sweep(rmse, error, path, photons=photons, sbr=ratios, note="a wall")


def draw_curves(path, width, **_):
    psnr = {level: 20.0 for level in LEVELS}
    log = [{"step": 5000 * k, "loss": 1.0 / (k + 1), "psnr": psnr, "input_psnr": 12.0} for k in range(1, 9)]
    curves.draw_learning_curves(log, path, title="pyramid, seed 0", width=width)


def draw_before_and_after(path, width, truth=True, **_):
    clean, gate, images, _ = samples()[0]
    noisy, found = clean + np.float32(0.2), images["pyramid"]
    clean = clean if truth else None
    draw_denoised(noisy, found, path, truth=clean, gate=gate, title="frames.h5: histograms", width=width)


def draw_budget(path, width, **_):
    found = spadwarp.budget(SCENE, ranges=np.linspace(1, 40, 6), media=["uwoc-clear", "jerlov-1C-williamson"])
    spadwarp.viz.draw_budget(found, path, width=width)


def draw_sweep(path, width, vary="medium.extinction=0.1:0.4:4", **options):
    options = {name: value for name, value in options.items() if name in ("of", "photons", "largest_range")}
    spadwarp.viz.draw_sweep(spadwarp.sweep(SCENE, vary=vary, device="cpu", **options), path, width=width)


def draw_video(path, width, request):
    result, scale = request.getfixturevalue("result"), LogNorm(1e-6, 1e-2)
    images = [("", scale, style.colour_map(style.LIGHT_MAP), "detections per pulse, pixel and bin")]
    viewer._screen(result.detections.shape, images, width)[0].savefig(path)


def draw_scene(path, width, **_):
    SCENE.plot(width=width).savefig(path)


def draw_depth_alone(path, width, request):
    result = request.getfixturevalue("result")
    labels = {"quantity": "depth", "title": "Depth (peak)"}
    draw_depth(result.truth.depth, result.intensity, path, width=width, **labels)


def draw_data(path, width, request):
    spadwarp.viz.draw_dataset(request.getfixturevalue("data"), path, frames=6, width=width)


def draw_mesh(path, width, request):
    import trimesh

    mesh = request.getfixturevalue("tmp_path") / "a_mesh_with_a_rather_long_name.stl"
    trimesh.creation.torus(1.0, 0.3).export(mesh)
    spadwarp.viz.draw_mesh(describe_mesh(mesh), path, width=width, device="cpu")


def draw_analytic(path, width, **_):
    maps = spadwarp.simulate_analytic(SCENE, frames=1, seed=1, device="cpu")
    spadwarp.viz.draw(maps, path, width=width)


def draw_narrow(path, width, **_):
    empty = make_result(make_scene(width=30, height=3, bins=8, targets=[]), empty=True)
    empty.plot("depth", method="peak", width=width).savefig(path)


def draw_case(path, width, **_):
    curves.draw_validation(rows(), path, title="moments: where photons are after n collisions", width=width)


def draw_targets(path, width, **_):
    with pytest.MonkeyPatch.context() as some:
        some.setattr("spadwarp.viz.scenes.builtin_names", lambda: ["staircase", "naval_mine", "plane", "diver_helmet"])
        spadwarp.viz.draw_targets(path, width=width, device="cpu")


def plot_of(name, *kind, **options):
    """Draws with the method `plot` of a fixture."""
    return lambda path, width, request: request.getfixturevalue(name).plot(*kind, width=width, **options).savefig(path)


def changed(draw, **options):
    return lambda path, width, request: draw(path, width=width, request=request, **options)


CHOICES = ["laser.pulse_energy=1 nJ,4 nJ", "detector.dark_count_rate=0,1e6"]
WATERS = "medium.preset=uwoc-clear,uwoc-coastal,jerlov-1C-williamson,uwoc-harbour"
OF_SCENES = (draw_narrow, draw_scene, draw_analytic, draw_budget, draw_sweep, draw_data, draw_targets, draw_mesh)
OF_NUMBERS = (draw_depth_alone, draw_before_and_after, draw_curves, draw_case, draw_video)
AS_WIDE_AS_A_PAGE = (draw_scores, draw_samples, draw_ranking, draw_reliability, draw_photon_sweep)
PICTURES = {
    **{kind: plot_of("result", kind) for kind in ("depth", "intensity", "truth", "histogram")},
    "frames": plot_of("frames"),
    "stored_frames": plot_of("recording"),
    "denoised_alone": changed(draw_before_and_after, truth=False),
    "sweep_plan": changed(draw_sweep, of="plan", vary=CHOICES, photons=4000, largest_range=False),
    "sweep_flat": changed(draw_sweep, vary="laser.wavelength_nm=530:534:3"),
    "sweep_names": changed(draw_sweep, vary=WATERS),
    **{draw.__name__.removeprefix("draw_"): draw for draw in (*AS_WIDE_AS_A_PAGE, *OF_SCENES, *OF_NUMBERS)},
}


def docs_figure(name):
    path = Path(__file__).parents[2] / "docs" / "figures" / f"{name}.py"
    spec = importlib.util.spec_from_file_location(f"figure_{name}", path)
    module = sys.modules[spec.name] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def draw_limits(path, width):
    module = docs_figure("analytic_limits")
    numbers = json.loads(Path(module.__file__).with_suffix(".json").read_text())
    module.draw(np.array(numbers["mean"]), np.array(numbers["error"])).savefig(path)


def draw_measured(path, width):
    module, random = docs_figure("measured"), np.random.default_rng(1)
    delays = np.linspace(-2e-9, 6e-9, 160)
    often = 1e-4 + np.exp(-0.5 * (delays / 2e-10) ** 2)
    one = module.Analysis(delays, often, 1e-10 * random.normal(size=500), random.poisson(60, 500).astype(float))
    module.draw(one, one, path)


# Of each module of pictures some; those of results, frames and scenes are drawn in notebooks and commands, too.
QUICK = {"histogram", "frames", "denoised_alone", "sweep", "budget", "scores", "reliability"}
QUICK |= {"curves", "case", "video"}

PICTURES_OF_THE_DOCS = {
    "limits": draw_limits,
    "measured": draw_measured,
    "phase_functions": lambda path, width: docs_figure("phase_functions").draw(path),
    "water": lambda path, width: docs_figure("water").draw(path),
}


@pytest.mark.parametrize(
    ("kind", "width"),
    [
        pytest.param(
            kind,
            width,
            marks=[pytest.mark.slow] * (kind not in QUICK or (width == style.PAGE and draw not in AS_WIDE_AS_A_PAGE)),
        )
        for kind, draw in PICTURES.items()
        for width in (style.PAGE, style.COLUMN)[: 1 + (draw not in AS_WIDE_AS_A_PAGE)]
    ],
)
def test_every_picture_is_drawn_at_both_widths(kind, width, tmp_path, monkeypatch, request):
    options = {"path": tmp_path / "picture.png", "width": width, "request": request}
    figure = drawn(monkeypatch, lambda: PICTURES[kind](**options), f"{kind}_{width:g}")
    assert figure.axes and figure.get_figwidth() >= min(width, 3.9)  # wider where there are many panels


@pytest.mark.slow
@pytest.mark.parametrize("kind", PICTURES_OF_THE_DOCS)
def test_figures_of_the_docs_are_drawn(kind, tmp_path, monkeypatch):
    assert drawn(monkeypatch, lambda: PICTURES_OF_THE_DOCS[kind](tmp_path / "picture.png", style.PAGE), kind).axes


def drawn(monkeypatch, draw, name="picture"):
    """The figure that a function saves, laid out: a layout that does not fit warns."""
    figures, savefig = [], style.PaperFigure.savefig

    def keep(figure, *_, **__):
        figures.append(figure)
        if FOLDER:
            Path(FOLDER).mkdir(exist_ok=True)
            savefig(figure, Path(FOLDER) / f"{name}.png")

    with monkeypatch.context() as changed:
        changed.setattr(style.PaperFigure, "savefig", keep)
        changed.setattr(style, "atomic_path", contextlib.nullcontext)
        draw()
    (figure,) = figures
    figure.draw_without_rendering()
    return figure


def test_methods_differ_in_colour_and_marker():
    colours = [to_rgb(colour) for _, colour, *_ in evaluation.METHODS.values()]
    distance = [np.abs(np.subtract(a, b)).max() for k, a in enumerate(colours) for b in colours[:k]]
    assert min(distance) > 0.14
    assert len({marker for _, _, marker, _ in evaluation.METHODS.values()}) == len(evaluation.METHODS)


def test_colours_of_a_depth_frame_are_those_of_the_pixels_with_counts():
    # One count in each pixel beside the target, anywhere in the gate; 1000 in each pixel of the target.
    depth = np.linspace(1.0, 9.0, 1600).reshape(40, 40)
    counts = np.ones_like(depth)
    depth[10:30, 10:30], counts[10:30, 10:30] = np.linspace(4.0, 4.1, 400).reshape(20, 20), 1000.0
    depth[20, 20], counts[20, 20] = 8.0, 1e5  # a hot pixel
    low, high = shown_limits(depth, beyond=1.0, weights=counts)
    assert 3.9 < low < 4.02 and 4.08 < high < 4.2
    assert shown_limits(depth, beyond=1.0, weights=0 * counts) == shown_limits(depth, beyond=1.0)


def test_colours_of_depth_end_where_truth_and_measurement_do():
    """The measured depth is up to 2 m too small, nowhere too large."""
    truth = np.tile(np.linspace(5.0, 6.0, 50), (40, 1))
    low, high = target_limits(truth, truth - np.linspace(0.0, 2.0, 40)[:, None])
    assert 2.8 < low < 4.0 and high == pytest.approx(6.0, abs=0.2)


def test_colours_of_light_are_those_of_the_cie():
    """Light of equal energy at all wavelengths is the illuminant E, whose sRGB is known; a line has a hue."""
    nm = np.arange(380.0, 781.0)
    linear = np.array([1.2048, 0.9483, 0.9089]) / 1.2048
    expected = 1.055 * linear ** (1 / 2.4) - 0.055
    np.testing.assert_allclose(style.srgb(np.ones((1, nm.size)), nm)[0], expected, atol=0.01)
    assert [style.srgb(np.eye(1), [one])[0].argmax() for one in (650.0, 532.0, 450.0)] == [0, 1, 2]
    assert not style.srgb(np.eye(1), [1500.0]).any()
