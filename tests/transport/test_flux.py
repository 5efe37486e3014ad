"""The light inside the water: canonical problems of ocean optics, discrete ordinates, and parts of runs."""

import functools
import math
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import spadwarp
from reference import irradiance as ordinates
from reference.refraction import reflectance
from spadwarp.scene import Scene

FLUX = [
    {"name": "depths", "positions": [0.1, 0.5, 1.0], "polar_bins": 6},
    {"name": "sea", "voxels": [1, 1, 1], "estimator": "collision"},
]
CAMERA = {"width": 1, "height": 1, "horizontal_fov_deg": 10.0, "aperture_diameter": 0.01}
TABLE = {"phase_function": "tabulated", "phase_table": "petzold-average-particle"}
MOVED = {"position": [0.3, -0.2, 0.5], "rotation_deg": [0.0, 90.0, 0.0]}  # of a camera that looks along x


def sea(**sections):
    """Sun at 60° on a flat surface, n 1.34, over water of albedo .9 without a bottom; None leaves a section out."""
    tables = {
        "medium": {"absorption": 1.0, "scattering": 9.0, "phase_index": 1.34, "phase_function": "rayleigh"},
        "camera": CAMERA,
        "gate": {"bin_width_ps": 1e3, "bins": 1},
        "domain": {"shape": "slab", "lower": [-math.inf, -math.inf, -1.0]},
        "surface": {"up": [0.0, 0.0, -1.0], "mean_square_slope": 0.0, "air_index": 1.0},
        "sun": {"zenith_deg": 60.0},
        "flux": FLUX,
        "transport": {
            "estimator": "none",
            "axis_threshold": 1.0,
            "termination": "roulette",
            "weight_cutoff": 0.05,
            "max_collisions": 100_000,
        },
    }
    return Scene.from_dict(
        {name: {**tables.get(name, {}), **fields} for name, fields in sections.items() if fields is not None}
        | {name: table for name, table in tables.items() if name not in sections}
    )


@functools.cache
def result(phase, photons=60_000):
    return spadwarp.simulate(sea(medium={} if phase == "rayleigh" else TABLE), photons=photons, seed=1, device="cpu")


# Means of seven models, E_d and upward scalar irradiance for .5 on the surface: Mobley et al. 1993, problems 1 and 2.
MODELS = {
    "rayleigh": ([0.366, 0.0433, 0.00316], [0.372, 0.0435, 0.0032]),
    "petzold": ([0.413, 0.187, 0.0685], [0.0931, 0.0463, 0.0165]),
}


@pytest.mark.physics
@pytest.mark.parametrize("phase", MODELS)
def test_canonical_problems(phase):
    light = result(phase).flux["depths"]["irradiance"]
    down, scalar_up = MODELS[phase]
    allowed = np.maximum([0.01, 0.01, 0.03] * np.array(down), 4 * 0.5 * light.errors[:, 0])
    assert (np.abs(0.5 * light.values[:, 0] - down) < allowed).all()
    allowed = np.maximum(0.07 * np.array(scalar_up), 4 * 0.5 * light.errors[:, 3])
    assert (np.abs(0.5 * light.values[:, 3] - scalar_up) < allowed).all()


def phase_function(phase):
    if phase == "rayleigh":
        return ordinates.rayleigh
    table = Path(spadwarp.__file__).parent / "water/tables/petzold_average_particle.csv"
    return ordinates.tabulated(*np.loadtxt(table, delimiter=",", skiprows=5, unpack=True))


@pytest.mark.physics
@pytest.mark.parametrize("phase", MODELS)
def test_irradiances_are_those_of_discrete_ordinates(phase):
    light = result(phase).flux["depths"]["irradiance"]
    expected = ordinates.irradiance(1.0, 9.0, phase_function(phase), light.dimensions["position"][0])
    assert (np.abs(light.values - expected) < 4.0 * light.errors).all()


def test_absorption_and_escapes_are_all_that_was_emitted():
    found = result("rayleigh")
    absorbed = 1.0 * found.flux["sea"]["fluence"].values.item()
    report = found.energy_report()
    escaped = sum(part for name, part in report["fractions"].items() if name != "absorbed_water")
    assert report["exact"] and absorbed + escaped == pytest.approx(1.0, abs=1e-6)


def facets(zenith, mean_square_slope, index):
    """Downward irradiance of a parallel beam, and scalar, just below a rough surface in clear water, over that on it:
    by quadrature over the slopes of facets that it sees (Cox and Munk 1954), each of which refracts it."""
    p, q = np.meshgrid(*2 * [np.linspace(-6.0, 6.0, 1_201) * math.sqrt(0.5 * mean_square_slope)])
    m = np.stack([-p, -q, np.ones_like(p)]) / np.sqrt(1.0 + p**2 + q**2)
    cosine = math.sin(zenith) * m[0] + math.cos(zenith) * m[2]
    seen = np.maximum(cosine, 0.0) / m[2] * np.exp(-(p**2 + q**2) / mean_square_slope)
    passed = seen / seen.sum() * (1.0 - reflectance(np.sqrt(1.0 - (1.0 - cosine**2) / index**2), 1.0 / index))
    behind = np.sqrt(1.0 - (1.0 - cosine**2) / index**2)
    below = -math.cos(zenith) / index - (behind - cosine / index) * m[2]
    return passed.sum(), (passed / -below).sum()


@pytest.mark.physics
def test_irradiance_below_a_rough_surface():
    """Sun at 60° and wind of 5 m/s over water that does not scatter: all that gets in is absorbed far below."""
    scene = sea(medium={"absorption": 1e-6, "scattering": 0.0}, surface={"mean_square_slope": None, "wind": 5.0})
    found = spadwarp.simulate(scene, photons=200_000, seed=1, device="cpu")
    light, report = found.flux["depths"]["irradiance"], found.energy_report()
    down, scalar = facets(math.radians(60.0), 0.0286, 1.34)
    assert down == pytest.approx(0.9342, abs=6e-5)  # as of Walter's densities
    assert (np.abs(light.values[:, 0] - down) < 4.0 * light.errors[:, 0]).all()
    assert (np.abs(light.values[:, 2] - scalar) < 4.0 * light.errors[:, 2]).all()
    assert not light.values[:, [1, 3]].any()
    assert report["exact"] and sum(report["fractions"].values()) == pytest.approx(1.0)
    assert report["fractions"]["absorbed_water"] == pytest.approx(light.values[0, 0], abs=1e-5)


def test_apparent_properties():
    found = result("petzold")
    light, radiance = (found.flux["depths"][name] for name in ("irradiance", "radiance"))
    seen = spadwarp.result.apparent(found)
    down, up, scalar_down, scalar_up = light.values.T
    assert seen.reflectance == pytest.approx(up / down)
    assert seen.mean_cosine == pytest.approx((down - up) / (scalar_down + scalar_up))
    assert seen.attenuation == pytest.approx(-np.diff(np.log(down)) / [0.4, 0.5])
    assert all((error > 0).all() for error in seen.errors.values())
    polar = np.cos(np.linspace(0.0, math.pi, 7))
    assert (radiance.values[..., 0] @ -np.diff(polar)) * 2 * math.pi == pytest.approx(scalar_down + scalar_up)


def test_zarr_has_flux_with_its_axes(tmp_path, monkeypatch):
    xarray = pytest.importorskip("xarray")
    pytest.importorskip("zarr")
    found = result("rayleigh")
    light = found.flux["depths"]["irradiance"]
    for _ in range(2):  # a store is replaced
        [path] = spadwarp.export(found, tmp_path / "light.zarr")
    with xarray.open_zarr(path) as data:
        assert np.array_equal(data.depths_irradiance, light.values)
        assert data.group_index == found.scene.medium.group_index
        assert np.array_equal(data.depths_irradiance_error, light.errors)
        assert data.depths_position.values.tolist() == [0.1, 0.5, 1.0] and data.depths_position.units == "m"
    (tmp_path / "mine.zarr").mkdir()
    with pytest.raises(spadwarp.FileError, match="not a Zarr store"):
        spadwarp.export(found, tmp_path / "mine.zarr")
    monkeypatch.setitem(sys.modules, "zarr", None)
    with pytest.raises(spadwarp.FileError, match=r"needs the package zarr: pip install 'spadwarp\[datasets\]'"):
        spadwarp.export(found, tmp_path / "light.zarr")


def test_a_video_follows_the_front_of_the_light(tmp_path):
    """Gate by gate, sunlight comes no deeper than its path, and the picture's light goes down with it."""
    volume = {"name": "column", "voxels": [1, 1, 40], "lower": [-math.inf, -math.inf, 0.0], "estimator": "collision"}
    volume |= {"upper": [math.inf, math.inf, 0.5], "gates": 8, "gate_width_ps": 250.0}
    scene = Scene.from_dict(sea().to_dict() | {"flux": [FLUX[0], volume]})
    found = spadwarp.simulate(scene, photons=8_192, seed=1, device="cpu")
    light = found.flux["column"]["fluence"]
    cube, depth = light.values[:, 0, 0], light.dimensions["z"][0]
    reach = found.pulse_speed * 0.25e-9 * np.arange(1, 9)
    assert cube.any(axis=1).all() and not cube[depth - 0.5 / 80 > reach[:, None]].any()
    middles = []
    with Image.open(spadwarp.viz.video(found, tmp_path / "front.gif", flux="column", scale="linear")) as pictures:
        for k in range(pictures.n_frames):
            pictures.seek(k)
            lit = np.asarray(pictures.convert("L"), float)[60:-120, 60:-60]
            middles.append((lit.sum(axis=0) @ np.arange(lit.shape[1])) / max(lit.sum(), 1.0))
    assert len(middles) == 8 and np.corrcoef(middles, (cube @ depth) / cube.sum(axis=1))[0, 1] > 0.9
    with pytest.raises(spadwarp.ArgumentError, match="flux = 'depths' is no volume with gates; the source has column"):
        spadwarp.viz.video(found, tmp_path / "front.gif", flux="depths")


def test_parts_of_a_run_and_files_keep_the_bits(tmp_path):
    scene = sea()
    whole = spadwarp.simulate(scene, photons=4_096, seed=1, device="cpu")
    parts = [
        spadwarp.simulate(
            scene, photons=2_048, seed=1, device="cpu", run=spadwarp.RunOptions(first_photon=k, threads=1)
        )
        for k in (0, 2_048)
    ]
    joined = spadwarp.merge([parts[0], parts[1].save(tmp_path / "part.h5")])
    run = spadwarp.RunOptions(resume=parts[0], launch_size=300)
    resumed = spadwarp.simulate(scene, photons=4_096, device="cpu", run=run)
    for other in (joined, resumed, spadwarp.load(whole.save(tmp_path / "whole.h5"))):
        assert np.array_equal(whole.flux_tallies.tallies, other.flux_tallies.tallies)
    errors = [one.flux["depths"]["irradiance"].errors[0] for one in (whole, joined, resumed)]
    assert errors[1] == pytest.approx(errors[0], rel=0.5) and errors[2] == pytest.approx(errors[0], rel=0.5)
    data = whole.to_xarray()
    assert data["depths_irradiance"].dims == ("depths_position", "depths_kind")
    assert data["sea_fluence"].item() == whole.flux["sea"]["fluence"].values.item()


@pytest.mark.slow
def test_fluence_of_a_beam_from_a_turned_camera_by_gate():
    """In water that only absorbs; sections are in the world's frame."""
    edges, speed = np.linspace(0.5, 4.5, 9), 0.299792458
    box = {"lower": [0.5, -0.3, 0.4], "upper": [4.5, -0.1, 0.6], "voxels": [8, 1, 1]}
    gates = {"gates": 4, "gate_start_ns": 0.0, "gate_width_ps": 1e3 / speed}  # 1 m each
    scene = Scene.from_dict(
        {
            "medium": {"absorption": 0.5, "scattering": 0.0, "group_index": 1.0},
            "laser": {"profile": "collimated", "beam_radius": 0.05},
            "camera": CAMERA | MOVED,
            "gate": {"bin_width_ps": 1e3, "bins": 1},
            "flux": [{"name": "beam", **box, **gates}, {"name": "all", **box, "estimator": "collision"}],
            "transport": {"estimator": "none", "axis_threshold": 1.0, "termination": "roulette", "weight_cutoff": 0.05},
        }
    )
    found = spadwarp.simulate(scene, photons=40_000, seed=2, device="cpu")
    beam, whole = found.flux["beam"]["fluence"], found.flux["all"]["fluence"]
    near, far = edges[:-1] - 0.3, edges[1:] - 0.3  # from the laser
    first, last = np.arange(4.0)[:, None], np.arange(1.0, 5.0)[:, None]
    near, far = np.clip(near, first, last), np.clip(far, first, last)
    expected = (np.exp(-0.5 * near) - np.exp(-0.5 * far)) / 0.5 / (0.5 * 0.2 * 0.2)
    values, errors = beam.values[..., 0, 0], beam.errors[..., 0, 0]
    assert (np.abs(values - expected) <= 4.5 * errors + 1e-3 * expected).all()
    assert beam.rate() == pytest.approx(beam.values / (1e-9 / speed))
    total = whole.values[0, :, 0, 0]
    error = np.hypot(whole.errors[0, :, 0, 0], errors.sum(axis=0))
    assert (np.abs(total - values.sum(axis=0)) < 4.5 * error)[:7].all()


@pytest.mark.parametrize(
    ("sections", "text"),
    [
        ({"transport": {"estimator": "guided"}}, "take 'next_event', or 'none' for flux alone"),
        ({"transport": {"axis_threshold": 0.99}}, "does not go with flux: set 1"),
        ({"surface": None}, r"sun needs \[surface\]"),
        ({"domain": {"shape": "box", "upper": [1.0, math.inf, math.inf]}}, "bound the water along the surface"),
        (
            {"medium": {"layers": [{"start": 1, "extinction": 1, "albedo": 0.5}], "layer_axis": [1.0, 0.0, 0.0]}},
            "varies",
        ),
    ],
)
def test_what_flux_and_sun_exclude(sections, text):
    with pytest.raises(spadwarp.ConfigError, match=text):
        sea(**sections)


@pytest.mark.parametrize(
    ("flux", "text"),
    [
        ({"voxels": [2, 1, 1]}, r"voxels\[0\] = 2 needs lower and upper in x"),
        ({}, "needs either voxels or positions"),
        ({"positions": [1.0, 1.0]}, "positions do not rise"),
        ({"voxels": [1, 1, 1], "gates": 2}, "gates = 2 needs gate_width_ps"),
        ({"positions": [1.0], "gate_start_ns": 2.0}, "gate_start_ns = 2.0 goes with voxels only"),
    ],
)
def test_sections_that_cannot_be(flux, text):
    with pytest.raises(spadwarp.ConfigError, match=text):
        spadwarp.scene.Flux(name="one", **flux)
