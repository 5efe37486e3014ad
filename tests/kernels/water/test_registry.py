"""Every phase function of the registry: its samples follow its density."""

import numpy as np
import pytest
import warp as wp

import spadwarp_kernels as sk
from helpers.statistics_of_samples import chi2_p, sample_count
from spadwarp_kernels.base.philox import u01_fine
from spadwarp_kernels.water import PhaseFunction
from spadwarp_kernels.water.phase_functions import PHASE_FUNCTIONS

pytestmark = pytest.mark.physics


def two_terms(t):
    return sk.two_term_henyey_greenstein_density(t, 0.9, -0.2, 0.9)


def medium(device):
    water = sk.Medium()
    water.extinction, water.albedo, water.anisotropy, water.axis_threshold = 0.3, 0.8, 0.85, 1.0
    water.phase = sk.make_phase_tables(
        lambda t: sk.two_term_henyey_greenstein_density(t, 0.9, -0.2, 0.9), device=device
    )
    return water


def samples_and_density(sample, pdf, device):
    """Samples of t = 1 - cos(theta), and the distribution function that the density gives them."""

    @wp.kernel(enable_backward=False, module="unique")
    def draw(water: sk.Medium, t: wp.array(dtype=float)):
        i = wp.tid()
        t[i] = sample(u01_fine(sk.random_block(wp.uint64(3), wp.uint64(i), wp.uint32(0), wp.uint32(1))[1]), water)

    @wp.kernel(enable_backward=False, module="unique")
    def evaluate(water: sk.Medium, t: wp.array(dtype=float), p: wp.array(dtype=float)):
        i = wp.tid()
        p[i] = pdf(t[i], water)

    fine = np.concatenate([[0.0], np.geomspace(1e-9, 1.0, 20_001)])
    edges = np.concatenate([fine, 2.0 - fine[-2::-1]])
    t = wp.zeros(sample_count(device), dtype=float, device=device)
    middle = wp.array(0.5 * (edges[1:] + edges[:-1]), dtype=float, device=device)
    p = wp.zeros_like(middle)
    water = medium(device)
    wp.launch(draw, t.size, [water], outputs=[t], device=device)
    wp.launch(evaluate, p.size, [water, middle], outputs=[p], device=device)
    mass = np.concatenate([[0.0], np.cumsum(2.0 * np.pi * p.numpy().astype(np.float64) * np.diff(edges))])
    return t.numpy(), edges, mass


@pytest.mark.parametrize("phase", PHASE_FUNCTIONS.values(), ids=list(PHASE_FUNCTIONS))
def test_samples_follow_the_density(phase: PhaseFunction, device):
    samples, edges, mass = samples_and_density(phase.sample, phase.pdf, device)
    assert mass[-1] == pytest.approx(1.0, abs=1e-4)
    assert chi2_p(samples, lambda t: np.interp(t, edges, mass / mass[-1])) > 1e-4


def test_names_are_those_of_the_phase_functions():
    assert all(name == phase.name for name, phase in PHASE_FUNCTIONS.items())
