"""Polarised light: the intensity's bits, single scatter by quadrature, Rayleigh atmospheres, surfaces, estimators."""

import math

import numpy as np
import pytest
from scipy import stats

import spadwarp
from helpers.estimators import SEEDS, clear_at_the_lens
from helpers.runs import of_seeds
from helpers.scenes import ELSEWHERE, PLATE, TREE, scene, single_scatter_case
from helpers.statistics_of_samples import equal_means_p
from reference.polarised_lidar import linear, stokes_factor
from reference.rayleigh_tables import TABLES, UPPER
from reference.refraction import amplitudes
from reference.single_scatter import single_scatter
from reference.stokes import block_matrix
from spadwarp import simulate
from spadwarp.values import ConfigError

pytestmark = pytest.mark.physics

POLARISED = {
    "medium": {"scattering_matrix": "voss_fry"},
    "laser": {"polarisation": "linear", "polarisation_angle_deg": 30.0},
    "camera": {"polarisation": "stokes"},
}


def polarised(**sections):
    return scene(**sections | {name: fields | sections.get(name, {}) for name, fields in POLARISED.items()})


def totals(result):
    """Each channel's light in all pixels, by component and bin: [channels, components, bins]."""
    return np.array([values.sum(axis=(1, 2)) for values in result.channels.values()])


@pytest.mark.slow
@pytest.mark.parametrize("targets", [[PLATE], [TREE]], ids=["plate", "tree"])
@pytest.mark.parametrize("estimator", ["analog", "guided"])
def test_the_intensity_keeps_its_bits_where_nothing_polarises(estimator, targets, device):
    """With m12 = 0 and no Fresnel element, I is the unpolarised run's, photon by photon; on CUDA, where the compiler
    joins products and sums of the two kernels in its own way, to the last bits."""
    sections = {"transport": {"estimator": estimator}, "targets": targets}
    plain = simulate(scene(medium={"layers": ELSEWHERE}, **sections), photons=20_000, device=device)
    medium = {"scattering_matrix": "scaled_rayleigh", "largest_polarisation": 0.0, "layers": ELSEWHERE}
    result = simulate(polarised(medium=medium, **sections), photons=20_000, device=device)
    if device != "cpu":
        np.testing.assert_allclose(result.tallies, plain.tallies, rtol=1e-5, atol=1e-6 * plain.tallies.max())
    else:
        np.testing.assert_array_equal(result.tallies, plain.tallies)
        assert result.energy_balance == plain.energy_balance and result.counters == plain.counters
    assert not plain.channels and list(result.channels) == ["I", "Q", "U", "V"]
    np.testing.assert_allclose(result.channels["I"].sum(axis=0), result.histogram, rtol=1e-14)
    # Light that one Lambertian plate has sent here is not polarised.
    q = result.channels["Q"]
    assert not q[0].any() and np.abs(q).sum() > 0.0


LIDAR, ONCE = single_scatter_case(30.0, 12.0)


def spread_matrix(cosine):
    """A matrix with m34, `[n, 5]`: circular light becomes linear."""
    c = np.asarray(cosine, np.float64)
    s2, whole = 1.0 - c**2, 1.0 + c**2
    return np.stack([-0.6 * s2 / whole, 1.0 + 0.0 * c, 2.0 * c / whole, 0.5 * s2 / whole, 2.0 * c / whole], -1)


def in_blocks(elements):
    def matrices(c):
        flat = elements(np.ravel(c))
        return block_matrix(*np.moveaxis(flat, -1, 0)).reshape(*np.shape(c), 4, 4)

    return matrices


@pytest.mark.slow
@pytest.mark.parametrize("laser", ["linear", "right_circular"])
def test_single_scatter_is_the_quadrature(laser, device, tmp_path):
    """Every channel of every pixel within 0.3 % of its intensity, and of all pixels with their signs too."""
    angles = np.linspace(0.0, 180.0, 721)
    table = tmp_path / "matrix.csv"
    np.savetxt(table, np.column_stack([angles, spread_matrix(np.cos(np.radians(angles)))]), delimiter=",")
    matrix = {"scattering_matrix": "tabulated", "matrix_table": str(table)}
    beam, stokes = {"polarisation": laser}, (1.0, 0.0, 0.0, 1.0)
    if laser == "linear":
        beam["polarisation_angle_deg"] = 30.0
        stokes = linear(math.radians(30.0))
    changes = {"medium": {**matrix, "layers": ELSEWHERE}, "laser": beam, "camera": {"polarisation": "stokes"}}
    one = scene(**ONCE | {name: {**ONCE[name], **fields} for name, fields in changes.items()})
    result = simulate(one, photons=2_000_000, device=device)
    found = np.stack([values.sum(axis=0) for values in result.channels.values()], -1)
    expected = single_scatter(LIDAR, order=40, factor=stokes_factor(LIDAR, in_blocks(spread_matrix), stokes))
    for kept in ((0, 1), (0, 1, 2)):  # the whole field by bin, and all of it
        intensity = expected[..., 0].sum(axis=kept)
        off = (found - expected).sum(axis=kept) / intensity[..., None]
        assert np.abs(off).max() < 0.003, off
    assert np.abs(expected.sum(axis=(0, 1, 2))[1:] / expected[..., 0].sum()).max() > 0.3


FAR = 2.0**14  # the camera's distance from the slab, which is 1 m thick [m]
APERTURE = 100.0


def atmosphere(table, mu, phi_deg):
    """A slab of molecules between empty layers, seen by a camera that is far off and whose axis is the slab's normal.

    A pencil beam and a camera that collects the light of the whole slab stand for a wide beam and a point of it. All
    light leaves for the camera at one zenith angle; its azimuth is that of −x, and the image's y is the φ̂ of the
    tables, so that their Q and U are −Q and −U of the image.
    """
    across, beam = math.radians(phi_deg) - math.pi, math.sqrt(1.0 - table.mu0**2)
    direction = np.array([beam * math.cos(across), beam * math.sin(across), table.mu0])
    entry = np.array([FAR * math.sqrt(1.0 - mu * mu), 0.0, FAR * mu])
    # Of albedo 1 too: so far off, float32 has points every 2 mm, and an event in the slab's last one counts as below.
    empty = {"absorption": 0.0, "scattering": 1e-12}
    layers = [{**empty, "start": FAR * mu, "scattering": table.optical_depth}, {**empty, "start": FAR * mu + 1.0}]
    # Below the slab, since light that bounces off a face is kept away from it by a part of the coordinates.
    low = [entry[0], 0.0, FAR * mu + 1.1]
    ground = {**PLATE, "size": [1e4, 1e4], "translation": low, "reflectance": table.ground}
    water = {"phase_function": "rayleigh", "scattering_matrix": "rayleigh", "depolarisation_ratio": 0.0}
    start = (entry - 0.5 * direction).tolist()
    return spadwarp.Scene.from_dict(
        {
            "medium": {**empty, **water, "group_index": 1.0, "layers": layers},
            "laser": {"profile": "collimated", "position": start, "direction": direction.tolist()},
            "camera": {
                "width": 1,
                "height": 1,
                "horizontal_fov_deg": 179.0,
                "aperture_diameter": APERTURE,
                "pinhole": True,
                "polarisation": "stokes",
            },
            "gate": {"start_ns": (FAR - 2e3) / 0.299792458, "bin_width_ps": 4e6 / 0.299792458, "bins": 1},
            "targets": [ground],
            "transport": {
                "estimator": "next_event",
                "axis_threshold": 1.0,
                "max_collisions": 200,
                "weight_cutoff": 0.0,
                "max_path": 2.0 * FAR,
            },
        }
    )


CASES = [(table, row) for table in TABLES for row in table.rows if row[0] == UPPER]
ON_A_CPU = (2, 10, 14, 19)  # of each table one, two of them near the horizon


def off_the_tables(table, row, photons, device):
    """I, Q and U of a row less those of the table, and their standard errors, both over the table's I."""
    _face, mu, phi, *expected = row
    result = simulate(atmosphere(table, mu, phi), photons=photons, device=device)
    # The lens has the part A µ/R² sr of the radiant intensity µ L/(π µ0) of the slab, for a flux of π.
    per_radiance = math.pi * (APERTURE / 2.0) ** 2 * (mu / FAR) ** 2 / (math.pi * table.mu0)
    rows = [[float(one[name].sum()) for name in "IQU"] for one in (result.channels, result.channel_errors)]
    found, error = np.array(rows) / per_radiance
    off = found * [1.0, -1.0, -1.0] - expected
    return np.array([np.sign(off) * np.maximum(np.abs(off) - table.digits, 0.0), error]) / expected[0]


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:ballistic")  # hardly any light passes a slab twice without scattering
def test_rayleigh_atmospheres_are_those_of_the_tables(device):
    """Every row within 4 standard errors: on a GPU all rows, to a thousandth. On a CPU four, to 0.4 %, but together
    too: in the mean of I, which is known to 0.1 %, and in the sum of squares."""
    cpu = device == "cpu"
    cases = [CASES[case] for case in ON_A_CPU] if cpu else CASES
    counts = [((1_300_000, 500_000) if cpu else (60_000_000, 10_000_000))[row[1] > 0.02] for _, row in cases]
    found = [off_the_tables(*case, count, device) for case, count in zip(cases, counts, strict=True)]
    off, error = np.array(found).swapaxes(0, 1)
    assert error.max() <= (4e-3 if cpu else 1e-3)
    z = off / error
    assert np.abs(z).max() < 4.0, z
    if cpu:
        weight = error[:, 0] ** -2.0
        mean, mean_error = (weight @ off[:, 0]) / weight.sum(), weight.sum() ** -0.5
        assert mean_error < 1e-3
        assert abs(mean) < 4.0 * mean_error
        assert stats.chi2.sf((z**2).sum(), z.size) > 1e-4


def agree(one, device):
    """Whether analog and guided have the same channels of each component and bin, in water clear at the lens."""
    found = []
    for name, photons in (("analog", 20_000), ("guided", 10_000)):
        run = clear_at_the_lens(one).with_overrides({"transport.estimator": name})
        rows = [found.signed.sum(axis=(2, 3)).ravel() for found in of_seeds(run, device, photons, range(SEEDS))]
        found.append(np.array(rows))
    assert np.abs(found[1]).reshape(SEEDS, 4, -1)[:, 0].sum() > 0.0
    assert equal_means_p(*found, 0.2) > 1e-3


SHINY = {**PLATE, "reflectance": 0.2, "specular": 0.6, "roughness": 0.3, "specular_index": 1.6}
DOME = {"shape": "dome", "radius": 0.3, "offset": [0.0, 0.0, 0.05]}
FACES = {"x_low": 1.6, "x_high": 1.0, "y_low": 1.0, "z_high": 2.0}
BOX = {"shape": "box", "lower": [-0.9, -0.7, -0.3], "upper": [0.8, 0.9, 3.0], "outside_index": FACES}


@pytest.mark.slow
def test_estimators_agree_in_every_channel(device):
    agree(polarised(), device)


@pytest.mark.slow
def test_estimators_agree_on_facets_between_walls_that_reflect_behind_a_dome(device):
    """Fresnel's matrix in the walk of the photon and in the images of connections, total reflection among them."""
    domain, target = {**BOX, "max_reflections": 2}, {**SHINY, "size": [1.0, 0.8], "rotation_deg": [0.0, 35.0, 0.0]}
    one = polarised(targets=[target], domain=domain, camera={"port": DOME}, laser={"port": "camera"})
    agree(one, device)


CLEAR = {"extinction": 1e-6, "albedo": 0.0, "phase_index": 1.34}
CLEAR["layers"] = [{"start": 50.0, "extinction": 1e-6, "albedo": 0.0}]
# Ports that change nothing, and a target that is out of view: one kernel for facets and for ports.
NO_PORT = {"distance": 1e-5, "thickness": 1e-5, "index": 1.34, "inside_index": 1.34}
HIDDEN = {**SHINY, "translation": [0.0, 0.0, -40.0]}


@pytest.mark.parametrize("laser", ["none", "right_circular"])
def test_facets_polarise_as_fresnel_says(laser, device):
    """A beam from the side, off the facets of a plate: Q and V of their angle of incidence."""
    index, source, spot = 1.6, np.array([-2.5, 0.0, 0.0]), np.array([0.0, 0.0, 2.2])
    one = scene(
        medium=CLEAR,
        laser={"profile": "collimated", "position": source.tolist(), "direction": (spot - source).tolist(),
               "polarisation": laser, "port": NO_PORT},
        camera={"aperture_diameter": 0.01, "polarisation": "stokes", "port": NO_PORT},
        targets=[{**SHINY, "reflectance": 0.0, "roughness": 0.5, "specular_index": index}],
        transport={"estimator": "next_event"},
    )  # fmt: skip
    result = simulate(one, photons=20_000, device=device)
    i, q, u, v = totals(result).sum(axis=(1, 2))
    before, after = (w / np.linalg.norm(w) for w in (spot - source, -spot))
    s, p = amplitudes(math.sqrt(0.5 * (1.0 - before @ after)), index / 1.34)
    assert q / i == pytest.approx((p**2 - s**2) / (p**2 + s**2), rel=1e-3)
    assert v / i == pytest.approx(0.0 if laser == "none" else 2.0 * s * p / (s**2 + p**2), abs=1e-3)
    assert abs(u / i) < 1e-3 and i > 0.0


def test_a_port_polarises_what_it_lets_through(device):
    """Light of a Lambertian plate through a plane surface: more of it polarised along the field than across."""
    one = scene(
        medium=CLEAR,
        laser={"half_angle_deg": 60.0, "position": [0.0, 0.0, 0.6], "port": NO_PORT},
        camera={"width": 9, "height": 1, "horizontal_fov_deg": 100.0, "aperture_diameter": 0.01,
                "port": {"shape": "flat", "distance": 0.1, "thickness": 0.0}, "polarisation": "stokes"},
        targets=[{**PLATE, "size": [20.0, 20.0]}, HIDDEN],
        transport={"estimator": "next_event"},
    )  # fmt: skip
    result = simulate(one, photons=400_000, device=device)
    i, q, u, v = (values.sum(axis=(0, 1, 3)) for values in result.channels.values())
    tangent = np.arange(-4.0, 5.0) * 2.0 * math.tan(math.radians(50.0)) / 9.0
    cosine = 1.0 / np.sqrt(1.0 + tangent**2)
    across, along = (1.0 - part**2 for part in amplitudes(cosine, 1.34))
    np.testing.assert_allclose(q / i, (along - across) / (along + across), atol=0.004)
    assert q[0] / i[0] > 0.02 and np.abs(u / i).max() < 0.01 and not v.any()


@pytest.mark.slow
def test_an_analyser_splits_the_stokes_vector(device):
    """co and cross from I, Q and U of the same photons, and their errors."""
    analyser = {"polarisation": "analyser", "analyser_angle_deg": 30.0, "analyser_extinction_ratio": 50.0}
    split = polarised(camera=analyser)
    one = polarised(medium={"layers": ELSEWHERE})
    whole = simulate(split, photons=8192, device=device)
    stokes = simulate(one, photons=8192, device=device)
    leak, (i, q, u, _v) = 1.0 / 50.0, stokes.channels.values()
    along = q * math.cos(math.radians(60.0)) + u * math.sin(math.radians(60.0))
    for name, sign in (("co", 1.0), ("cross", -1.0)):
        expected = 0.5 * ((1.0 + leak) * i + sign * (1.0 - leak) * along)
        np.testing.assert_allclose(whole.channels[name], expected, rtol=1e-4, atol=1e-6 * i.max())
    # Backscatter keeps much of the laser's polarisation, a Lambertian plate nothing.
    ratio = totals(whole)[1].sum(axis=1) / totals(whole)[0].sum(axis=1)
    assert ratio[0] == pytest.approx(1.0, rel=1e-5) and ratio[2] < 0.5
    assert (whole.channel_errors["cross"] <= whole.standard_error * 1.2).all()
    assert list(whole.summary()["channels"]) == ["co", "cross"]
    with pytest.raises(ConfigError, match=r"medium\.scattering = .* light is polarised"):
        simulate(split, photons=100, device=device, derivatives=["scattering"])


@pytest.mark.parametrize(
    ("sections", "message"),
    [
        ({"transport": {"axis_threshold": 0.999}}, "axis_threshold = 0.999 does not go with polarised light"),
        ({"medium": {"scattering_matrix": "tabulated"}}, "needs matrix_table"),
        ({"medium": {"matrix_table": "a.csv"}}, "goes with scattering_matrix = 'tabulated' only"),
        ({"targets": [{**SHINY, "specular_index": 1.3415}]}, "specular_index = 1.3415 is that of the water"),
        ({"camera": {"analyser_extinction_ratio": 0.5}}, r"analyser_extinction_ratio = 0\.5 .* is outside \[1, inf\]"),
    ],
)
def test_what_does_not_go_with_polarised_light_is_refused_by_name(sections, message):
    with pytest.raises(ConfigError, match=message):
        polarised().with_overrides(sections)


def test_a_polarised_laser_sets_what_its_light_needs():
    plain = spadwarp.load_scene("staircase_5m")
    linear = plain.with_overrides({"laser.polarisation": "linear"})
    assert (linear.medium.scattering_matrix, linear.transport.axis_threshold) == ("voss_fry", 1.0)
    molecules = plain.with_overrides({"medium.phase_function": "rayleigh", "camera.polarisation": "analyser"})
    assert (molecules.medium.scattering_matrix, molecules.transport.axis_threshold) == ("rayleigh", 1.0)
    assert spadwarp.Scene.from_toml(linear.to_toml()) == linear
    assert (plain.medium.scattering_matrix, plain.transport.axis_threshold) == ("none", 0.9998)
