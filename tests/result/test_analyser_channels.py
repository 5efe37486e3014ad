"""Channels of polarised light on their way to counts, depth, plans and pages."""

import dataclasses
import tarfile

import numpy as np
import pytest

import spadwarp
from helpers.cli import DEVICE, run, tables
from helpers.datasets import make, recipe
from helpers.minimal_scene import CAMERA, scene
from spadwarp.dataset import export_dataset, iterate_dataset
from spadwarp.result import COMPONENTS, analyser_channel, degree_of_polarisation
from spadwarp.values import ArgumentError, ConfigError

pytestmark = pytest.mark.filterwarnings("ignore:Monte Carlo noise")  # few photons

PLANE = {"builtin": "plane", "size": [4.0, 4.0], "translation": [0.0, 0.0, 2.0], "reflectance": 0.5}


def polarised(camera="analyser", **fields):
    """A wall in ocean water before a laser at 30° and an analyser that leaks a hundredth."""
    return scene(
        camera=CAMERA | {"polarisation": camera, "analyser_angle_deg": 30.0, "analyser_extinction_ratio": 100.0},
        laser={"position": [-0.1, 0.0, 0.0], "polarisation": "linear", "polarisation_angle_deg": 30.0, **fields},
        medium={"extinction": 0.6, "albedo": 0.8, "scattering_matrix": "voss_fry"},
        gate={"start_ns": 2.0, "bin_width_ps": 500.0, "bins": 50},
        detector={"ambient_rate": 1e5},
        targets=[PLANE],
        transport={"axis_threshold": 1.0, "photons": 20_000},
    )


@pytest.fixture(scope="module")
def analysed():
    return spadwarp.simulate(polarised(), seed=5, device="cpu", uncertainty=True)


def test_a_channel_is_a_result_of_its_own(analysed):
    for name in ("co", "cross"):
        seen = analyser_channel(analysed, name)
        assert np.array_equal([seen.component(part) for part in COMPONENTS], analysed.channels[name])
        assert np.array_equal(seen.standard_error, analysed.channel_errors[name])
        assert seen.provenance["channel"] == name and not seen.channels
        # ambient light is unpolarised: (1 + 1/E)/2 of it passes
        assert seen.scene.detector.ambient_rate == pytest.approx(0.505e5)
    assert analyser_channel(analysed, "I") is analysed
    both = analyser_channel(analysed, "co").histogram + analyser_channel(analysed, "cross").histogram
    np.testing.assert_allclose(both, 1.01 * analysed.histogram, rtol=1e-4, atol=1e-6 * analysed.histogram.max())


def test_the_wall_is_depolarised_and_the_water_is_not(analysed):
    co, cross = (analyser_channel(analysed, name) for name in ("co", "cross"))
    for part in ("ballistic", "forward_scattered"):
        assert cross.component(part).sum() == pytest.approx(co.component(part).sum(), rel=0.01)
    # Voss & Fry's 0.117 of light scattered once straight back, the analyser's leak and a little multiple scattering.
    assert 0.12 < cross.component("backscatter").sum() / co.component("backscatter").sum() < 0.16
    part = degree_of_polarisation(analysed)
    assert np.nanmin(part) >= -1.0 and np.nanmax(part) <= 1.0 and part.shape == analysed.histogram.shape
    near = degree_of_polarisation(analysed)[..., :20]
    assert np.nanmedian(near) == pytest.approx((1.0 - 0.117) / (1.0 + 0.117), abs=0.03)
    assert degree_of_polarisation(analysed, gated=True).shape == (6, 8)


def test_stokes_cubes_hold_what_an_analyser_passes(analysed, tmp_path):
    stokes = spadwarp.simulate(polarised("stokes"), photons=analysed.photons, seed=5, device="cpu")
    assert np.array_equal(stokes.tallies, analysed.tallies)
    for name in ("co", "cross"):
        seen, expected = analyser_channel(stokes, name).histogram, analyser_channel(analysed, name).histogram
        np.testing.assert_allclose(seen, expected, atol=1e-6 * expected.max())
    turned = spadwarp.load_result(stokes.save(tmp_path / "result.h5"))
    across = turned.scene.with_overrides({"camera.analyser_angle_deg": -60.0})
    turned = analyser_channel(dataclasses.replace(turned, scene=across), "co")
    np.testing.assert_allclose(
        turned.histogram, analyser_channel(stokes, "cross").histogram, atol=1e-6 * stokes.histogram.max()
    )
    again = spadwarp.load_result(turned.save(tmp_path / "co.h5"))
    assert np.array_equal(again.tallies, turned.tallies) and again.provenance["channel"] == "co"
    linear = degree_of_polarisation(stokes)
    assert np.nanmax(linear) <= 1.0 and np.nanmin(linear) >= 0.0


def test_counts_depth_and_bounds_of_a_channel(analysed):
    counts = {
        name: spadwarp.detect(analyser_channel(analysed, name), pulses=1000, frames=2, seed=3, device="cpu")
        for name in ("I", "co", "cross")
    }
    expected = {name: frames.expected.sum() for name, frames in counts.items()}
    assert expected["co"] > expected["cross"]
    assert expected["co"] + expected["cross"] == pytest.approx(1.01 * expected["I"], rel=1e-3)
    signal = {name: (frames.expected - frames.background).sum() for name, frames in counts.items()}
    assert signal["cross"] / signal["I"] == pytest.approx(0.505, rel=0.01)
    background = {name: frames.background.sum() for name, frames in counts.items()}
    assert background["cross"] / background["I"] < 0.3
    assert np.isfinite(spadwarp.crlb(analyser_channel(analysed, "cross"), pulses=1000, device="cpu")).any()


@pytest.mark.slow
def test_channels_on_the_command_line(analysed, tmp_path):
    place = analysed.save(tmp_path / "result.h5")
    outcome = run("info", place)
    assert "degree of polarisation" in outcome.stdout and "cross" in outcome.stdout
    chosen = ("--channel", "cross", *DEVICE)
    run("detect", place, "--pulses", 500, "--out", tmp_path / "frames", *chosen)
    frames = spadwarp.load(tmp_path / "frames" / "frames.h5")
    assert frames.channel == "cross" and "cross" in run("info", frames.path).stdout
    run("depth", place, "--out", tmp_path / "depth", *chosen)
    found = np.load(tmp_path / "depth" / "depth.npy")
    np.testing.assert_allclose(found, analyser_channel(analysed, "cross").depth(), atol=1e-3)
    run("export", place, "--format", "npy", "--out", tmp_path / "npy", *chosen[:2])
    assert np.array_equal(np.load(tmp_path / "npy" / "result.npy"), analyser_channel(analysed, "cross").histogram)
    assert "channel" in run("depth", frames.path, "--out", tmp_path / "no", *chosen, code=2).stderr
    spadwarp.viz.draw_result(analysed, tmp_path / "pictures")


def test_a_page_of_a_channel_names_it(analysed, tmp_path):
    pytest.importorskip("plotly")
    page = spadwarp.viz.view(analysed, tmp_path / "page.html", channel="cross", device="cpu")
    assert "cross-polarised light" in page.read_text()


@pytest.mark.slow
def test_plan_compares_the_channels(tmp_path):
    file = tmp_path / "scene.toml"
    file.write_text(polarised().to_toml())
    summary = tmp_path / "plan.json"
    options = ("--photons", 20_000, "--no-range", "--json", summary, *DEVICE)
    printed = run("plan", file, *options).stdout
    assert "Cross-polarised reception keeps 50" in printed and "times the pulses" in printed
    channels, limit = tables(summary)["channels"], tables(summary)["pile_up_energy"]
    assert channels["cross"]["target"] / channels["I"]["target"] == pytest.approx(0.505, rel=0.02)
    assert channels["cross"]["backscatter"] < 0.2 * channels["I"]["backscatter"]
    assert channels["cross"]["noise"] == pytest.approx(0.505 * channels["I"]["noise"], rel=0.01)
    assert tables(summary)["pilot"]["target"] == channels["I"]["target"]
    run("plan", file, "--channel", "cross", "--overwrite", *options)
    # the pile-up limit leaves more energy to half of the light
    chosen = tables(summary)
    assert chosen["pilot"]["target"] == pytest.approx(chosen["channels"]["cross"]["target"])
    assert chosen["pile_up_energy"] > 1.5 * limit


def test_channels_that_are_not_there_are_refused(analysed):
    with pytest.raises(ArgumentError, match=r"'crossed'.*did you mean 'cross'"):
        analyser_channel(analysed, "crossed")
    plain = spadwarp.simulate(scene(targets=[PLANE]), photons=100, seed=1, device="cpu")
    with pytest.raises(ConfigError, match=r"channel = 'co': .*camera\.polarisation = 'analyser'"):
        analyser_channel(plain, "co")
    with pytest.raises(ConfigError, match="degree of polarisation"):
        degree_of_polarisation(plain)
    with pytest.raises(ConfigError, match=r"needs camera\.polarisation"):
        spadwarp.plan(scene(targets=[PLANE]), channel="co", device="cpu")


def test_a_channel_is_not_added_to_other_light(analysed):
    cross = analyser_channel(analysed, "cross")
    with pytest.raises(ConfigError, match="resume: the result holds cross-polarised light alone"):
        spadwarp.simulate(cross.scene, photons=2 * cross.photons, device="cpu", run=spadwarp.RunOptions(resume=cross))
    with pytest.raises(ConfigError, match="merge: the channel of the results differs"):
        spadwarp.merge([cross, analyser_channel(analysed, "co")])


def test_recipes_take_a_channel_of_traced_scenes_only():
    recipe = spadwarp.dataset.load_recipe("small")
    with pytest.raises(ConfigError, match=r"channel = 'cross' needs share = 1"):
        recipe.with_overrides({"monte_carlo.channel": "cross"})
    traced = {"monte_carlo.share": 1.0, "monte_carlo.channel": "cross"}
    with pytest.raises(ConfigError, match=r"channel = 'cross' needs scene\.camera\.polarisation"):
        recipe.with_overrides(traced)
    polarised = {"scene.camera.polarisation": "stokes", "scene.medium.scattering_matrix": "voss_fry"}
    assert recipe.with_overrides({**traced, **polarised, "scene.transport.axis_threshold": 1.0})


def test_data_sets_and_denoisers_take_a_channel(analysed, tmp_path):
    place = analysed.save(tmp_path / "result.h5")
    seen = {name: spadwarp.denoise.read_depth(place, channel=name, device="cpu") for name in (None, "I", "cross")}
    np.testing.assert_array_equal(seen[None].depth, seen["I"].depth)
    assert not np.array_equal(seen["cross"].depth, seen["I"].depth)
    np.testing.assert_allclose(seen["cross"].depth[0], analyser_channel(analysed, "cross").depth(), atol=0.05)
    changes = {
        "targets.builtin": ["staircase"],
        "targets.validation": [],
        "frames.per_scene": 2,
        "gate.bins": 64,
        "scenes_per_target": 1,
        "scene.camera.width": 8,
        "scene.camera.height": 6,
        "scene.camera.polarisation": "analyser",
        "scene.laser.polarisation": "linear",
        "scene.medium.scattering_matrix": "voss_fry",
        "scene.transport.axis_threshold": 1.0,
        "monte_carlo.share": 1.0,
        "monte_carlo.photons": 20_000,
        "monte_carlo.counts": "dense",
    }
    light = {}
    for name in ("I", "cross"):
        make(recipe(**changes, **{"monte_carlo.channel": name, "exposure.signal_photons": None}), tmp_path / name)
        items = list(iterate_dataset(tmp_path / name, "test", fields=("expected", "polarisation")))
        light[name] = np.array([item["expected"] for item in items], np.float64)
        part = np.array([item["polarisation"] for item in items])  # [frames, T, H, W]
    assert 0.3 < light["cross"].sum() / light["I"].sum() < 0.51
    assert part.shape == light["I"].shape and np.nanmin(part) >= -1.0 and 0.5 < np.nanmedian(part) <= 1.0
    across = np.where(np.isnan(part), 0.5, 0.5 * (1.0 - part)) * light["I"]
    assert across.sum() == pytest.approx(light["cross"].sum(), rel=0.05)
    out = export_dataset(tmp_path / "cross", tmp_path / "tar", "webdataset", fields=("noisy", "polarisation"))
    with tarfile.open(next(out.glob("test-*.tar"))) as file:
        assert any(name.endswith(".polarisation.npy") for name in file.getnames())
