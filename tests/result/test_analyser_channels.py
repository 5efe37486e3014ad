"""Channels of polarised light on their way to counts, depth, plans and pages."""

import dataclasses
import tarfile

import numpy as np
import pytest

import spadwarp
from helpers.cli import DEVICE, run, tables
from helpers.coarse_pictures import coarse_pictures
from helpers.datasets import make, recipe
from helpers.minimal_scene import CAMERA, scene
from spadwarp.dataset import FrameReader, export_dataset
from spadwarp.result import COMPONENTS, analyser_channel, degree_of_polarisation
from spadwarp.values import ArgumentError, ConfigError

pytestmark = pytest.mark.filterwarnings("ignore:not enough photons")  # few photons

# Of as many faces as the targets of data sets, whose kernel it then has.
PLANE = {"builtin": "plane", "size": [4.0, 4.0], "translation": [0.0, 0.0, 2.0], "reflectance": 0.5, "subdivisions": 3}


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
    return spadwarp.simulate(polarised(), seed=5, device="cpu")


@pytest.fixture(scope="module")
def light(analysed):
    """The results of both channels and of all light."""
    return {name: analyser_channel(analysed, name) for name in ("I", "co", "cross")}


def test_a_channel_is_a_result_of_its_own(analysed, light):
    for name in ("co", "cross"):
        seen = light[name]
        assert np.array_equal([seen.component(part) for part in COMPONENTS], analysed.channels[name])
        assert np.array_equal(seen.standard_error, analysed.channel_errors[name])
        assert seen.provenance["channel"] == name and not seen.channels
        # ambient light is unpolarised: (1 + 1/E)/2 of it passes
        assert seen.scene.detector.ambient_rate == pytest.approx(0.505e5)
    assert light["I"] is analysed
    both = light["co"].histogram + light["cross"].histogram
    np.testing.assert_allclose(both, 1.01 * analysed.histogram, rtol=1e-4, atol=1e-6 * analysed.histogram.max())


def test_the_wall_is_depolarised_and_the_water_is_not(analysed, light):
    co, cross = ({part: light[name].component(part).sum() for part in COMPONENTS} for name in ("co", "cross"))
    for part in ("ballistic", "forward_scattered"):
        assert cross[part] == pytest.approx(co[part], rel=0.01)
    # Voss & Fry's 0.117 of light scattered once straight back, the analyser's leak and a little multiple scattering.
    assert 0.12 < cross["backscatter"] / co["backscatter"] < 0.16
    part = degree_of_polarisation(analysed)
    assert np.nanmin(part) >= -1.0 and np.nanmax(part) <= 1.0 and part.shape == analysed.histogram.shape
    assert np.nanmedian(part[..., :20]) == pytest.approx((1.0 - 0.117) / (1.0 + 0.117), abs=0.03)
    assert degree_of_polarisation(analysed, gated=True).shape == (6, 8)


@pytest.mark.slow
def test_stokes_cubes_hold_what_an_analyser_passes(analysed, light, tmp_path):
    stokes = spadwarp.simulate(polarised("stokes"), photons=analysed.photons, seed=5, device="cpu")
    assert np.array_equal(stokes.tallies, analysed.tallies)
    for name in ("co", "cross"):
        expected = light[name].histogram
        np.testing.assert_allclose(analyser_channel(stokes, name).histogram, expected, atol=1e-6 * expected.max())
    across = spadwarp.load(stokes.save(tmp_path / "result.h5"))
    scene = across.scene.with_overrides({"camera.analyser_angle_deg": -60.0})
    turned, cross = analyser_channel(dataclasses.replace(across, scene=scene), "co"), analyser_channel(stokes, "cross")
    np.testing.assert_allclose(turned.histogram, cross.histogram, atol=1e-6 * stokes.histogram.max())
    again = spadwarp.load(turned.save(tmp_path / "co.h5"))
    assert np.array_equal(again.tallies, turned.tallies) and again.provenance["channel"] == "co"
    linear = degree_of_polarisation(stokes)
    assert np.nanmax(linear) <= 1.0 and np.nanmin(linear) >= 0.0


def test_counts_depth_and_bounds_of_a_channel(light):
    def of(values):
        return {name: values(spadwarp.detect(one, pulses=1000, seed=3, device="cpu")) for name, one in light.items()}

    expected = of(lambda frames: frames.expected.sum())
    signal = of(lambda frames: (frames.expected - frames.background).sum())
    background = of(lambda frames: frames.background.sum())
    assert expected["co"] > expected["cross"]
    assert expected["co"] + expected["cross"] == pytest.approx(1.01 * expected["I"], rel=1e-3)
    assert signal["cross"] / signal["I"] == pytest.approx(0.505, rel=0.01)
    assert background["cross"] / background["I"] < 0.3
    assert np.isfinite(spadwarp.crlb(light["cross"], pulses=1000, device="cpu")).any()


@pytest.mark.slow
def test_channels_on_the_command_line(analysed, light, tmp_path, monkeypatch):
    coarse_pictures(monkeypatch.setattr)
    place = analysed.save(tmp_path / "result.h5")
    printed = run("info", place).stdout
    assert "degree of polarisation" in printed and "cross" in printed
    chosen = ("--channel", "cross", *DEVICE)
    run("detect", place, "--pulses", 500, "--out", tmp_path / "frames", *chosen)
    frames = spadwarp.load(tmp_path / "frames" / "frames.h5")
    assert frames.channel == "cross" and "cross" in run("info", frames.path).stdout
    run("depth", place, "--out", tmp_path / "depth", *chosen)
    np.testing.assert_allclose(np.load(tmp_path / "depth" / "depth.npy"), light["cross"].depth(), atol=1e-3)
    run("export", place, "--format", "npy", "--out", tmp_path / "npy", *chosen[:2])
    assert np.array_equal(np.load(tmp_path / "npy" / "result.npy"), light["cross"].histogram)
    assert "channel" in run("depth", frames.path, "--out", tmp_path / "no", *chosen, code=2).stderr
    pytest.importorskip("plotly")
    page = spadwarp.viz.view(analysed, tmp_path / "page.html", channel="cross", device="cpu")
    assert "cross-polarised light" in page.read_text()


@pytest.mark.slow
def test_plan_takes_the_light_of_a_channel(tmp_path):
    file, summary = tmp_path / "scene.toml", tmp_path / "plan.json"
    file.write_text(polarised().to_toml())
    options = ("--photons", 800_000, "--depth-error", "30cm", "--no-range", "--json", summary, *DEVICE)
    run("plan", file, *options)
    whole = tables(summary)
    run("plan", file, "--channel", "cross", "--overwrite", *options)
    cross = tables(summary)
    # the pile-up limit leaves more energy to half of the light
    assert cross["pile_up_energy"] > 1.5 * whole["pile_up_energy"]
    energy = cross["values"]["laser.pulse_energy"] / whole["values"]["laser.pulse_energy"]
    assert cross["pilot"]["target"] / whole["pilot"]["target"] == pytest.approx(0.505 * energy, rel=0.02)
    assert cross["pilot"]["backscatter"] < 0.2 * energy * whole["pilot"]["backscatter"]


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


def test_a_channel_is_not_added_to_other_light(light):
    cross = light["cross"]
    with pytest.raises(ConfigError, match="resume: the result holds light of channel cross alone"):
        spadwarp.simulate(cross.scene, photons=2 * cross.photons, device="cpu", run=spadwarp.RunOptions(resume=cross))
    with pytest.raises(ConfigError, match="merge: the channel of the results differs"):
        spadwarp.merge([cross, light["co"]])


STOKES = {"scene.camera.polarisation": "stokes", "scene.medium.scattering_matrix": "voss_fry"}


def test_recipes_take_a_channel_of_traced_scenes_only():
    recipe, cross = spadwarp.dataset.load_recipe("small"), {"monte_carlo.channel": "cross"}
    with pytest.raises(ConfigError, match=r"channel = 'cross' needs share = 1"):
        recipe.with_overrides(cross)
    cross["monte_carlo.share"] = 1.0
    with pytest.raises(ConfigError, match=r"channel = 'cross' needs scene\.camera\.polarisation"):
        recipe.with_overrides(cross)
    assert recipe.with_overrides({**cross, **STOKES, "scene.transport.axis_threshold": 1.0})


SMALL = {
    **{"targets.builtin": ["staircase"], "targets.validation": [], "frames.per_scene": 2, "scenes_per_target": 1},
    **{"gate.bins": 64, "scene.camera.width": 8, "scene.camera.height": 6, "scene.transport.axis_threshold": 1.0},
    **{**STOKES, "scene.camera.polarisation": "analyser", "scene.laser.polarisation": "linear"},
    **{"monte_carlo.share": 1.0, "monte_carlo.photons": 20_000, "monte_carlo.counts": "dense"},
    "exposure.signal_photons": None,
}


def test_data_sets_and_denoisers_take_a_channel(analysed, light, tmp_path):
    place = analysed.save(tmp_path / "result.h5")
    seen = {name: spadwarp.denoise.read_depth(place, channel=name, device="cpu") for name in (None, "I", "cross")}
    np.testing.assert_array_equal(seen[None].depth, seen["I"].depth)
    assert not np.array_equal(seen["cross"].depth, seen["I"].depth)
    np.testing.assert_allclose(seen["cross"].depth[0], light["cross"].depth(), atol=0.05)
    expected = {}
    for name in ("I", "cross"):
        make(recipe(**SMALL, **{"monte_carlo.channel": name}), tmp_path / name)
        items = list(FrameReader(tmp_path / name, "test", fields=("expected", "polarisation")))
        expected[name] = np.array([item["expected"] for item in items], np.float64)
        part = np.array([item["polarisation"] for item in items])  # [frames, T, H, W]
    assert 0.3 < expected["cross"].sum() / expected["I"].sum() < 0.51
    assert part.shape == expected["I"].shape and np.nanmin(part) >= -1.0 and 0.5 < np.nanmedian(part) <= 1.0
    across = np.where(np.isnan(part), 0.5, 0.5 * (1.0 - part)) * expected["I"]
    assert across.sum() == pytest.approx(expected["cross"].sum(), rel=0.05)
    out = export_dataset(tmp_path / "cross", tmp_path / "tar", "webdataset", fields=("noisy", "polarisation"))
    with tarfile.open(next(out.glob("test-*.tar"))) as file:
        assert any(name.endswith(".polarisation.npy") for name in file.getnames())
