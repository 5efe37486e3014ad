"""The validation: its statistics, its reference numbers, and a short run of every kind of case."""

import json
import math

import numpy as np
import pytest

from reference import fournier_forand
from reference.adding_doubling import cumulative_reflectance, exit_cosine_fractions, reflected_by_order, slab, stack
from reference.moments import after_collisions, after_path, isotropic_radial_cdf, snapped_mean_cosines
from reference.single_scatter import Lidar, lambertian_plane, single_scatter, single_scatter_total
from reference.slab_derivatives import slab_derivatives
from spadwarp.io import json_text
from spadwarp.validate import CASES, draw_results, references, report, run
from spadwarp.validate.cases import Estimate, Quantity, batch_means, block_means, holm, two_sided_p
from spadwarp.values import ArgumentError

# The statistics


def test_holm_raises_each_p_by_the_hypotheses_left():
    assert holm([0.01, 0.04, 0.03]) == pytest.approx([0.03, 0.06, 0.06])
    assert holm([0.5, 0.9]) == [1.0, 1.0]
    assert holm([]) == []


def test_z_allows_for_the_error_of_few_batches_and_for_a_rounded_reference():
    """Student's t of 3 with 7 degrees of freedom is as likely as a normal deviate of 2.327."""
    assert Quantity("", Estimate(3.0, 1.0, 7.0), 0.0).z == pytest.approx(2.327, abs=0.01)
    assert Quantity("", Estimate(3.0, 1.0), 0.0).z == 3.0
    assert Quantity("", Estimate(4.0, 3.0), -1.0, 4.0).z == 1.0  # both errors count
    assert two_sided_p(1.959964) == pytest.approx(0.05, abs=1e-7)
    # Without an error: equality.
    assert Quantity("", Estimate(0.0, 0.0), 0.0).z == 0.0
    assert Quantity("", Estimate(1e-12, 0.0), 0.0).z == math.inf
    near, far = (Quantity("", Estimate(value, 0.1), 1.0, rounding=0.05) for value in (1.04, 0.75))
    assert near.z == 0.0 and far.z == pytest.approx(-2.0)


def test_means_in_blocks_are_those_of_the_whole():
    scores = np.random.default_rng(0).random((1000, 2))
    means = block_means(np.split(scores, [300, 700]))
    for i, estimate in enumerate(means):
        assert estimate.value == pytest.approx(scores[:, i].mean(), rel=1e-12)
        assert estimate.standard_error == pytest.approx(scores[:, i].std(ddof=1) / math.sqrt(1000), rel=1e-9)
    assert batch_means(scores)[1].standard_error == pytest.approx(means[1].standard_error, rel=1e-9)


# The numbers that the cases are held to

pytestmark = pytest.mark.physics


def case_of(row):
    return {"anisotropy": row.anisotropy, "albedo": row.albedo, "optical_depth": row.optical_depth}


@pytest.mark.parametrize("row", references.SLABS, ids=lambda row: row.text)
def test_slab_references(row):
    solved = slab(**case_of(row))
    assert (row.reflected, row.transmitted) == pytest.approx((solved.reflected, solved.transmitted), abs=6e-9)


@pytest.mark.slow
@pytest.mark.parametrize("row", references.SLAB_DERIVATIVES[1::3], ids=lambda row: row.text)
def test_slab_derivative_references(row):
    np.testing.assert_allclose([row.reflected, row.transmitted], slab_derivatives(**case_of(row)), atol=6e-9)


@pytest.mark.slow
@pytest.mark.parametrize("row", references.STACKS, ids=lambda row: row.text)
def test_stack_references(row):
    solved = stack([(g, albedo, extinction * thickness) for g, albedo, extinction, thickness in row.layers])
    assert (row.reflected, row.transmitted) == pytest.approx(solved, abs=6e-9)


@pytest.mark.slow
def test_exit_cosine_and_time_resolved_references():
    for row, face, fractions in references.EXIT_COSINES:
        both = exit_cosine_fractions(**case_of(row), edges=references.EXIT_COSINE_EDGES)
        np.testing.assert_allclose(fractions, both[face == "exit_z_high"], atol=6e-9)
    medium, edges = references.TIME_RESOLVED_MEDIUM, references.TIME_RESOLVED_EDGES
    until = [0.0, *(cumulative_reflectance(path, **medium, nodes=24) for path in edges[1:])]
    np.testing.assert_allclose(references.TIME_RESOLVED, np.diff(until), atol=2e-8)


def test_moment_and_fluence_references():
    fixed = after_path(5.0, scattering=1.0, anisotropy=0.0)
    collided = after_collisions(5, extinction=1.0, anisotropy=0.924)
    assert pytest.approx((fixed.z, fixed.r2), abs=6e-7) == references.AFTER_PATH
    assert pytest.approx((collided.z, collided.r2, collided.cos_theta), abs=6e-7) == references.AFTER_COLLISIONS
    path = references.FLUENCE_PATH
    inside = isotropic_radial_cdf(references.FLUENCE_EDGES[1:-1], path=path, scattering=1.0)
    fractions = np.diff([0.0, *inside, 1.0]) * math.exp(-references.FLUENCE_ABSORPTION * path)
    np.testing.assert_allclose(references.FLUENCE, fractions, atol=2e-7)


@pytest.mark.slow
def test_references_of_the_rules_that_bias():
    for threshold, cosine in references.NEAR_AXIS.items():
        expected = snapped_mean_cosines(5, anisotropy=0.924, axis_threshold=threshold)[5]
        assert cosine == pytest.approx(expected, abs=6e-9)
    orders = reflected_by_order(50, anisotropy=0.0, albedo=0.8, nodes=24)
    everything = slab(anisotropy=0.0, albedo=0.8, optical_depth=math.inf).reflected
    for cutoff, reflected in references.CUTOFF.items():
        lost = orders[0.8 ** np.arange(50) < cutoff].sum()
        assert everything - lost == pytest.approx(reflected, abs=2e-7)


def test_single_scatter_and_lambertian_references():
    for name, (rows, columns, fractions) in references.SINGLE_SCATTER.items():
        if name == "whole field":
            expected = single_scatter_total(Lidar())
        else:
            expected = single_scatter(Lidar(), rows=np.r_[rows], columns=np.r_[columns], order=32).sum(axis=(0, 1))
        np.testing.assert_allclose(fractions, expected, rtol=5e-5, atol=1e-20)
    lidar = Lidar(laser_position=(0.1, -0.05, 0.0), half_angle=math.radians(10.0))
    image = lambertian_plane(lidar, depth=5.0, reflectance=0.5)
    for rows, columns, fraction in references.LAMBERTIAN.values():
        assert fraction == pytest.approx(image[rows, columns].sum(), rel=1e-7)


@pytest.mark.slow
def test_fournier_forand_references():
    """The mean of 1 − cosθ is the integral of what lies above it."""
    law = {"particle_index": 1.10, "junge_slope": 3.5835}
    edges = np.concatenate([[1e-15], np.geomspace(1e-9, 2.0, 400)])
    node, weight = np.polynomial.legendre.leggauss(8)
    t = 0.5 * (edges[1:] + edges[:-1])[:, None] + 0.5 * np.diff(edges)[:, None] * node
    mean_cosine = 1 - 0.5 * (np.diff(edges) * ((1 - fournier_forand.cumulative(t, **law)) @ weight)).sum()
    narrow = 2 * math.sin(math.radians(references.FOURNIER_FORAND_ANGLE) / 2) ** 2
    fractions = [1 - fournier_forand.cumulative(1.0, **law), fournier_forand.cumulative(narrow, **law)]
    after = after_collisions(5, extinction=1.0, anisotropy=mean_cosine)
    expected = [*fractions, mean_cosine, after.cos_theta, after.z, after.r2]
    np.testing.assert_allclose(references.FOURNIER_FORAND, expected, atol=6e-9)
    lidar = Lidar(phase_function=lambda cosine: fournier_forand.density(1 - cosine, **law))
    np.testing.assert_allclose(references.FOURNIER_FORAND_SINGLE_SCATTER, single_scatter_total(lidar), rtol=5e-5)


# The cases


LONG = {"ledger", "mean-path", "white-vessel"}  # trace most; the command's tests run the first


@pytest.fixture(scope="module")
def results():
    """A short run of all other cases."""
    return run([name for name in CASES if name not in LONG], photons=10_000, seed=3, device="cpu")


@pytest.mark.slow
def test_engine_agrees_with_every_reference(results):
    failed = [f"{r.quantity}: {r.value} against {r.reference}, z {r.z:.1f}" for r in results if not r.passed]
    assert not failed
    assert {r.name for r in results} == set(CASES) - LONG


@pytest.mark.slow
def test_deviations_are_standard_normal(results):
    """Too small an error would make them wide, too large a one narrow."""
    z = np.array([r.z for r in results if r.standard_error > 0])
    assert 0.75 < np.sqrt(np.mean(z**2)) < 1.25


@pytest.mark.slow
def test_a_table_of_henyey_greenstein_and_the_mean_path_pass_as_well():
    found = run(["near-axis", "single-scatter"], photons=10_000, seed=8, device="cpu", tabulated=True)
    assert all(r.passed for r in [*found, *run(["mean-path"], photons=1000, seed=4, device="cpu")])


def test_wrong_physics_fails(monkeypatch):
    """One reference off by five per cent among right ones."""
    row = references.SLABS[0]
    wrong = (row._replace(transmitted=row.transmitted * 1.05), *references.SLABS[1:3])
    monkeypatch.setattr(references, "SLABS", wrong)
    verdicts = {r.quantity: r.passed for r in run(["slab"], photons=20_000, seed=5, device="cpu")}
    assert [name for name, passed in verdicts.items() if not passed] == [f"T, {row.text}"]


def test_one_seed_gives_one_result():
    first, again, other = (run(["moments"], photons=1000, seed=seed, device="cpu") for seed in (6, 6, 7))
    assert first == again
    assert all(a.value != b.value for a, b in zip(first, other, strict=True))


def test_reports(tmp_path):
    results = run(["slab", "moments"], photons=10_000, seed=3, device="cpu")
    plain = json.loads(json_text(report(results, photons=10_000, seed=3)))
    assert plain["passed"] is True and len(plain["results"]) == len(results)
    for path in draw_results(results[:20], tmp_path / "plots"):
        assert path.read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ({"cases": ["slabs"]}, "'slabs' is not one of 'slab', "),
        ({"photons": 10}, "photons = 10 is outside"),
        ({"seed": -1}, "seed = -1 is outside"),
    ],
)
def test_errors_name_the_argument(arguments, text):
    with pytest.raises(ArgumentError, match=text.replace("[", r"\[")):
        run(**arguments)
