"""Scattering matrices: measured, of particles, and from files."""

import numpy as np
import pytest

import spadwarp
from helpers.cli import run
from reference.stokes import rayleigh_density, rayleigh_matrix
from spadwarp.values import ArgumentError, ConfigError

pytestmark = pytest.mark.physics


def is_physical(matrix):
    """Whether Cloude's coherency matrices of m12, m22, m33, m34, m44 [n, 5] have no negative eigenvalue."""
    m12, m22, m33, m34, m44 = np.moveaxis(matrix, -1, 0)
    result = np.zeros((len(matrix), 4, 4), np.complex128)
    result[:, 0, 0], result[:, 1, 1] = 1.0 + m22 + m33 + m44, 1.0 + m22 - m33 - m44
    result[:, 2, 2], result[:, 3, 3] = 1.0 - m22 + m33 - m44, 1.0 - m22 - m33 + m44
    result[:, 0, 1] = 2.0 * m12 - 2.0j * m34
    result[:, 1, 0] = result[:, 0, 1].conj()
    return np.linalg.eigvalsh(0.25 * result).min() > -1e-12


def test_ocean_water_has_a_physical_matrix_as_it_was_measured():
    cosine = np.cos(np.radians(np.linspace(0.0, 180.0, 361)))
    matrix = spadwarp.water.voss_fry_matrix(cosine)
    assert matrix.shape == (361, 5) and is_physical(matrix)
    m12, m22, m33, m34, m44 = matrix.T
    assert m12.min() == pytest.approx(-0.66) and np.argmin(m12) == 180
    assert not m34.any() and np.array_equal(m33, m44)
    # straight on the plane of polarisation is that of nothing but the light's own
    assert m22[0] == pytest.approx(m33[0], abs=1e-4) and m12[0] == 0.0
    # 21 % of the light scattered straight back has lost its polarisation: a depolarisation ratio of 0.12
    assert (1.0 - m22[-1]) / (1.0 + m22[-1]) == pytest.approx(0.117, abs=0.001)
    assert m22[-1] == pytest.approx(-m33[-1], abs=0.006)


@pytest.mark.parametrize("ratio", [0.0, 0.039, 0.5])
def test_molecules_have_the_matrix_of_the_reference(ratio):
    cosine = np.linspace(-1.0, 1.0, 41)
    matrix = spadwarp.water.rayleigh_matrix(cosine, ratio)
    whole = rayleigh_matrix(cosine, ratio)
    expected = [whole[:, i, j] for i, j in ((0, 1), (1, 1), (2, 2), (2, 3), (3, 3))]
    np.testing.assert_allclose(matrix, np.stack(expected, -1), atol=1e-14)
    assert is_physical(matrix)
    density = spadwarp.water.molecular_density(1.0 - cosine)
    np.testing.assert_allclose(density, rayleigh_density(cosine, 0.039), rtol=1e-12)


@pytest.mark.parametrize("name", ["rayleigh_matrix", "scaled_rayleigh_matrix", "voss_fry_matrix"])
def test_angles_are_no_cosines(name):
    with pytest.raises(ArgumentError, match=r"cosine holds 30.0, which is outside"):
        getattr(spadwarp.water, name)(np.array([0.5, 30.0]))


def test_a_scaled_matrix_reaches_its_largest_polarisation_and_stays_physical():
    cosine = np.linspace(-1.0, 1.0, 41)
    for largest in (0.0, 0.66, 1.0):
        matrix = spadwarp.water.scaled_rayleigh_matrix(cosine, largest)
        assert -matrix[:, 0].min() == pytest.approx(largest) and is_physical(matrix)
    np.testing.assert_allclose(matrix, spadwarp.water.rayleigh_matrix(cosine, 0.0), atol=1e-15)


def test_spheres_have_the_matrix_of_bohren_and_huffman():
    """Appendix A: m = 1.55, x = 5.21282; −m12, m33, m34 at 9°, 18°, 27° and 36°."""
    published = [
        (9.0, -0.00459811, 0.999400, 0.0343261),
        (18.0, -0.0458541, 0.986022, 0.160184),
        (27.0, -0.364744, 0.843603, 0.394076),
        (36.0, -0.534997, 0.686967, -0.491787),
    ]
    diameter = 5.21282 * 532e-9 / spadwarp.water.refractive_index(532.0) / np.pi
    sphere = spadwarp.water.mie_particles(spadwarp.water.single_size(diameter), 532.0, index=1.55, concentration=1.0)
    for angle, *expected in published:
        m12, m22, m33, m34, m44 = sphere.matrix[np.argmin(np.abs(sphere.angles_deg - angle))]
        # rows of the table are 0.5° apart, 9° among them to a hundredth
        tolerance = 0.002 if angle == 9.0 else 2e-6
        assert [-m12, m33, m34] == pytest.approx(expected, abs=tolerance)
        assert m22 == pytest.approx(1.0) and m44 == pytest.approx(m33)
    assert is_physical(sphere.matrix)


def test_particles_in_water_mix_their_matrices_by_the_light_that_they_scatter(tmp_path):
    water = spadwarp.water
    sizes = water.power_law(4.0, smallest=0.1e-6, largest=2e-6, sizes=4)
    parts = [water.mie_particles(sizes, 532.0, index=n, concentration=c) for n, c in ((1.05, 1e-3), (1.15, 2e-3))]
    whole = water.mixture(parts)
    assert is_physical(whole.matrix)
    cosine = np.cos(np.radians(whole.angles_deg))
    own = water.pure_water_scattering(532.0) * water.molecular_density(1.0 - cosine)
    expected = own[:, None] * water.rayleigh_matrix(cosine)
    expected = expected + sum(p.scattering * p.density[:, None] * p.matrix for p in parts)
    np.testing.assert_allclose(whole.scattering * whole.density[:, None] * whole.matrix, expected, rtol=1e-3, atol=1e-9)
    read = water.read_matrix_table(water.save_matrix_table(whole, tmp_path / "matrix.csv"))
    np.testing.assert_allclose(read(cosine), whole.matrix, atol=1e-6)
    np.testing.assert_allclose(read(np.array([1.0, -1.0]))[:, [0, 3]], 0.0, atol=1e-3)
    measured = water.mixture([water.kopelevich_particles(532.0, small=0.1, large=0.1)])
    with pytest.raises(ArgumentError, match="not known"):
        water.save_matrix_table(measured, tmp_path / "other.csv")


@pytest.mark.parametrize(
    "rows, text",
    [
        (["0,0,1,1,0,1"], "has 1 rows"),
        (["0,0,1,1,0,1", "90,nan,1,1,0,1", "180,0,1,1,0,1"], "nan"),
        (["0,0,1,1,0,1", "180,1.1,1,-1,0,-1"], r"line 2: m12 = 1.1 is outside \[-1, 1\]"),
        (["0,0,1,1,0,1", "0,0,1,1,0,1", "180,0,1,-1,0,-1"], "angle_deg = 0 follows 0: not ascending"),
        (["10,0,1,1,0,1", "160,0,1,-1,0,-1"], "goes from 10 to 160, not from 0 to 180"),
        (["0,0,1,1,0,1", "90,-0.8,1,0.7,0,0.7", "180,0,1,-1,0,-1"], r"at angle_deg = 90 .* 1 \+ m22 = 2 is below"),
        (["0,0,1,1,0,1", "180,0,1,-1,0,-0.5"], r"at angle_deg = 180 .* 1 - m22 = 0 is below"),
    ],
)
def test_tables_that_no_matter_has_are_refused(tmp_path, rows, text):
    file = tmp_path / "matrix.csv"
    file.write_text("\n".join(rows) + "\n")
    with pytest.raises(ConfigError, match=text) as caught:
        spadwarp.water.read_matrix_table(file)
    assert str(file) in str(caught.value)


def test_matrix_of_particles_on_the_command_line(tmp_path):
    file = tmp_path / "matrix.csv"
    mie = ["water", "532", "--particles", "index=1.1,concentration=1,diameter=0.5um"]
    assert "matrix_table" in run(*mie, "--matrix", str(file)).stdout
    assert spadwarp.water.read_matrix_table(file)(np.array([0.0])).shape == (1, 5)
    refused = run("water", "532", "--particles", "small=0.1", "--matrix", str(tmp_path / "new.csv"), code=2)
    assert "no matrix" in refused.output
