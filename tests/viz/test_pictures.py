"""Every kind of picture at the widths of a page and of a column."""

import contextlib
import importlib.util
import itertools
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
    path = tmp_path_factory.mktemp("recording") / "frames.h5"
    return record_frames(result, path, pulses=2_000_000, frames=1, seed=4, methods=("peak", "matched"), device="cpu")


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return datasets.make(datasets.recipe(), tmp_path_factory.mktemp("data") / "set").folder


@pytest.fixture(scope="module")
def mesh(tmp_path_factory):
    import trimesh

    path = tmp_path_factory.mktemp("mesh") / "a_mesh_with_a_rather_long_name.stl"
    trimesh.creation.torus(1.0, 0.3).export(path)
    return describe_mesh(path)


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
    evaluation.draw_reliability(tables, path, note="scenes that no training saw")


def draw_photon_sweep(path, **_):
    photons = np.geomspace(1.0, 1000.0, 7)
    error = 0.1 / np.sqrt(photons) * np.ones((3, 1))
    rmse = {name: (2 + k) * error for k, name in enumerate(("input", "median", "pooled", "histograms"))}
    ratios = (0.1, 1.0, 10.0)
    evaluation.draw_photon_sweep(rmse, error, path, photons=photons, sbr=ratios, note="a wall")


def draw_curves(path, width, **_):
    psnr = {level: 20.0 for level in LEVELS}
    log = [{"step": 5000 * k, "loss": 1.0 / (k + 1), "psnr": psnr} for k in range(1, 9)]
    curves.draw_learning_curves(log, path, title="pyramid, seed 0", width=width)


def draw_before_and_after(path, width, truth=True, **_):
    clean, gate, images, _ = samples()[0]
    noisy, found = clean + np.float32(0.2), images["pyramid"]
    options = {"truth": clean} if truth else {}
    draw_denoised(noisy, found, path, gate=gate, title="frames.h5: histograms", width=width, **options)


def draw_budget(path, width, **_):
    found = spadwarp.budget(SCENE, ranges=np.linspace(1, 40, 14), media=["uwoc-clear", "jerlov-1C-williamson"])
    spadwarp.viz.draw_budget(found, path, width=width)


def draw_sweep(path, width, of="budget", vary="medium.extinction=0.1:0.4:4", **_):
    spadwarp.viz.draw_sweep(spadwarp.sweep(SCENE, vary=vary, of=of, device="cpu"), path, width=width)


def draw_video(path, width, result, **_):
    scale = LogNorm(1e-6, 1e-2)
    images = [("", scale, style.colour_map(style.LIGHT_MAP), "detections per pulse, pixel and bin")]
    viewer._screen(result.detections.shape, images, width)[0].savefig(path)


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


PICTURES = {
    "depth": lambda path, width, result, **_: result.plot("depth", width=width).savefig(path),
    "intensity": lambda path, width, result, **_: result.plot("intensity", width=width).savefig(path),
    "truth": lambda path, width, result, **_: result.plot("truth", width=width).savefig(path),
    "histogram": lambda path, width, result, **_: result.plot("histogram", width=width).savefig(path),
    "narrow": draw_narrow,
    "frames": lambda path, width, frames, **_: frames.plot(width=width).savefig(path),
    "stored_frames": lambda path, width, recording, **_: recording.file.plot(width=width).savefig(path),
    "scene": lambda path, width, **_: SCENE.plot(width=width).savefig(path),
    "analytic": draw_analytic,
    "depth_alone": lambda path, width, result, **_: draw_depth(
        result.truth.depth, result.intensity, path, label="depth z [m]", title="Depth (peak)", width=width
    ),
    "denoised": draw_before_and_after,
    "denoised_alone": lambda path, width, **_: draw_before_and_after(path, width, truth=False),
    "budget": draw_budget,
    "sweep": draw_sweep,
    "sweep_error": lambda path, width, **_: draw_sweep(path, width, of="depth-error"),
    "sweep_flat": lambda path, width, **_: draw_sweep(path, width, vary="laser.wavelength_nm=530:534:3"),
    "sweep_names": lambda path, width, **_: draw_sweep(
        path, width, vary="medium.preset=uwoc-clear,uwoc-coastal,jerlov-1C-williamson,uwoc-harbour"
    ),
    "dataset": lambda path, width, data, **_: spadwarp.viz.draw_dataset(data, path, frames=6, width=width),
    "targets": draw_targets,
    "mesh": lambda path, width, mesh, **_: spadwarp.viz.draw_mesh(mesh, path, width=width, device="cpu"),
    "learning_curves": draw_curves,
    "validation": draw_case,
    "scores": draw_scores,
    "samples": draw_samples,
    "ranking": draw_ranking,
    "reliability": draw_reliability,
    "photon_sweep": draw_photon_sweep,
    "video": draw_video,
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


PICTURES_OF_THE_DOCS = {
    "limits": draw_limits,
    "measured": draw_measured,
    "phase_functions": lambda path, width: docs_figure("phase_functions").draw(path),
    "water": lambda path, width: docs_figure("water").draw(path),
}


AS_WIDE_AS_A_PAGE = ("scores", "samples", "ranking", "reliability", "photon_sweep")


@pytest.mark.parametrize(
    ("kind", "width"),
    [(kind, width) for kind in PICTURES for width in (style.PAGE, style.COLUMN)[: 1 + (kind not in AS_WIDE_AS_A_PAGE)]],
)
def test_every_picture_is_drawn_at_both_widths(kind, width, tmp_path, monkeypatch, request):
    draw = PICTURES[kind]
    wanted = set(draw.__code__.co_varnames[: draw.__code__.co_argcount])
    fixtures = wanted & {"result", "frames", "recording", "data", "mesh"}
    given = {name: request.getfixturevalue(name) for name in fixtures}
    figure = drawn(monkeypatch, lambda: draw(path=tmp_path / "picture.png", width=width, **given), f"{kind}_{width:g}")
    assert figure.axes and figure.get_figwidth() >= min(width, 3.9)  # wider where there are many panels


@pytest.mark.parametrize("kind", PICTURES_OF_THE_DOCS)
def test_figures_of_the_docs_are_drawn(kind, tmp_path, monkeypatch):
    assert drawn(monkeypatch, lambda: PICTURES_OF_THE_DOCS[kind](tmp_path / "picture.png", style.PAGE), kind).axes


def test_images_of_samples_fill_their_rows(tmp_path, monkeypatch):
    truth = np.full((24, 32), 15.0, np.float32)
    whole = [(truth, (13.5, 16.0), {"median": truth}, "staircase, backscatter fraction 0.183")] * 3
    for images in (samples(), whole):
        for enlarged in (False, True):
            named = {"methods": METHODS, "note": "split test", "enlarged": enlarged}
            figure = drawn(monkeypatch, lambda of=images, named=named: evaluation.draw_samples(of, tmp_path, **named))
            boxes = [axis.get_position() for axis in figure.axes if axis.images]
            height = figure.get_figheight()
            lines = sorted({(round(box.y0 * height, 3), round(box.y1 * height, 3)) for box in boxes})[: len(images)]
            assert all(upper[0] - lower[1] < 0.3 for lower, upper in itertools.pairwise(lines))


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


def test_the_style_is_for_figures_of_ones_own_too():
    import matplotlib

    before = dict(matplotlib.rcParams.copy())
    with matplotlib.style.context(style.STYLE):
        assert matplotlib.rcParams["font.size"] == 8.0
    with style.paper():
        pass
    assert all(matplotlib.rcParams[name] == value for name, value in before.items() if name != "backend")


def test_colours_of_a_depth_frame_are_those_of_the_pixels_with_counts():
    # One count in each pixel beside the target, anywhere in the gate; 200 in each pixel of the target.
    depth = np.linspace(1.0, 9.0, 400).reshape(20, 20)
    counts = np.ones_like(depth)
    depth[5:15, 5:15], counts[5:15, 5:15] = np.linspace(4.0, 4.1, 100).reshape(10, 10), 200.0
    low, high = shown_limits(depth, beyond=1.0, weights=counts)
    assert 3.9 < low < 4.02 and 4.08 < high < 4.2
    assert shown_limits(depth, beyond=1.0, weights=0 * counts) == shown_limits(depth, beyond=1.0)


def test_colours_of_depth_end_where_truth_and_measurement_do():
    """The measured depth is up to 2 m too small, nowhere too large."""
    truth = np.tile(np.linspace(5.0, 6.0, 50), (40, 1))
    low, high = target_limits(truth, truth - np.linspace(0.0, 2.0, 40)[:, None])
    assert 2.8 < low < 4.0 and high == pytest.approx(6.0, abs=0.2)
