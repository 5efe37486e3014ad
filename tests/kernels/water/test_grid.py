"""Flights through a grid of cells against the crossings of all its planes in float64."""

import numpy as np
import pytest
import warp as wp

import spadwarp_kernels as sk
from helpers.launch import each, on_device, unit
from spadwarp_kernels.water.grid import grid_cell
from spadwarp_kernels.water.medium import ProfileSample

OUTSIDE = 0.3
SIZE, CENTRE = np.array([2.0, 1.5, 3.0]), np.array([0.2, -0.1, 1.0])
AXES = np.array([[0.36, 0.48, -0.8], [-0.8, 0.6, 0.0], [0.48, 0.64, 0.6]]).T
REGULAR, DELTA = sk.REGULAR_TRACKING, sk.DELTA_TRACKING


def water(device, block_edge=3, cells=(5, 9, 13)):
    """Cells of 0 ... 2 1/m, some of them empty, in a box with axes of its own."""
    extinction = 2.0 * np.random.default_rng(7).random(cells) ** 2
    extinction[extinction < 0.2] = 0.0
    layers = sk.Layers()
    place = {"size": SIZE, "centre": CENTRE, "rotation": AXES}
    layers.grid = sk.make_grid(extinction, np.full(cells, 0.5), **place, block_edge=block_edge, device=device)
    medium = sk.Medium()
    medium.extinction = OUTSIDE
    return medium, layers, extinction


def rays(count=4_000):
    rng = np.random.default_rng(4)
    x = (CENTRE + rng.uniform(-2.0, 2.0, (count, 3))).astype(np.float32)
    u = rng.normal(size=(count, 3))
    u[:100] = AXES[:, 0]  # along the cells
    u[100:200] = -AXES[:, 2]
    length = rng.uniform(0.0, 5.0, count).astype(np.float32)
    return x, unit(u).astype(np.float32), 1 - rng.random(count, dtype=np.float32), length


def optical_depth(extinction, x, u, length):
    """Between the planes that a line crosses, sorted; the cell of each stretch is that of its middle."""
    shape = np.array(extinction.shape)
    p = (x.astype(float) - CENTRE) @ AXES / SIZE * shape + 0.5 * shape
    d = u.astype(float) @ AXES / SIZE * shape
    with np.errstate(divide="ignore", invalid="ignore"):
        planes = [((k - p[i]) / d[i]) for i in range(3) for k in range(shape[i] + 1)]
    cuts = np.nan_to_num(planes, nan=0.0, posinf=0.0, neginf=0.0)
    t = np.sort(np.clip([0.0, *cuts, length], 0.0, length))
    middle = np.floor(p + 0.5 * (t[1:] + t[:-1])[:, None] * d).astype(int)
    inside = ((middle >= 0) & (middle < shape)).all(axis=1)
    c = np.full(len(middle), OUTSIDE)
    c[inside] = extinction[tuple(middle[inside].T)]
    return float((c * np.diff(t)).sum())


def one_line(count):
    """Many times the same flight of 3 m."""
    u = np.float32(unit([0.2, -0.1, 1.0]))
    return np.tile(np.float32(CENTRE + np.array([-0.2, 0.4, -1.9])), (count, 1)), np.tile(u, (count, 1))


def seeds(count, device):
    return on_device(np.random.default_rng(1).integers(0, 2**64, count, np.uint64), device, wp.uint64)


def test_regular_tracking_is_the_sum_over_the_cells(device):
    x, u, xi, length = rays()
    medium, layers, extinction = water(device)
    mean = each(REGULAR.extinction, [medium, layers, x, u, length, 0], device=device)
    distance = each(REGULAR.free_path, [medium, layers, x, u, xi, 0], device=device)
    wanted = np.array([optical_depth(extinction, *ray) for ray in zip(x, u, length, strict=True)])
    np.testing.assert_allclose(mean * length, wanted, rtol=2e-5, atol=1e-5)
    reached = np.array([optical_depth(extinction, *ray) for ray in zip(x, u, distance, strict=True)])
    np.testing.assert_allclose(reached, -np.log(xi.astype(float)), rtol=1e-4, atol=1e-4)
    place = np.floor(((x - CENTRE) @ AXES / SIZE + 0.5) * extinction.shape).astype(int)
    inside = ((place >= 0) & (place < extinction.shape)).all(axis=1)
    assert inside.mean() > 0.1
    index = np.ravel_multi_index(tuple(np.where(inside[:, None], place, 0).T), extinction.shape)
    cell = each(grid_cell, [layers.grid, x], [int], device)
    np.testing.assert_array_equal(cell, np.where(inside, index, -1))


def test_points_of_a_flight_have_the_density_that_is_said(device):
    """Along one line: frequencies against the integral of the density (chi square), which is 1."""
    count, bins = 40_000, 32
    medium, layers, extinction = water(device)
    x, u = one_line(count)
    xi = np.minimum(np.random.default_rng(9).random(count), 1 - 2.0**-24).astype(np.float32)

    def draw(given):
        return each(REGULAR.profile.draw, [medium, layers, x, u, 3.0, given, xi], [ProfileSample], device)

    drawn = draw(-1.0)
    s, density = drawn["s"], drawn["density"]
    assert (s >= 0.0).all() and (s <= 3.0).all()
    # A point that rounding puts beside a face has the density behind it.
    assert (np.abs(draw(s)["density"] / density - 1.0) > 1e-3).mean() < 1e-3
    at_given = draw(((np.arange(count) + 0.5) * (3.0 / count)).astype(np.float32))["density"].astype(float)
    expected = at_given.reshape(bins, -1).sum(axis=1) * 3.0
    assert expected.sum() == pytest.approx(count, rel=1e-3)
    counted = np.histogram(s, np.linspace(0.0, 3.0, bins + 1))[0]
    assert counted[expected < 1e-9].sum() == 0
    chi2 = ((counted - expected) ** 2 / np.maximum(expected, 1.0))[expected > 20].sum()
    assert chi2 < bins + 4.0 * (2.0 * bins) ** 0.5
    # With delta tracking guided takes a guess from blocks, the same for the same line.
    about = each(DELTA.profile.depth, [medium, layers, x, u, 3.0], device=device)
    assert np.ptp(about) == 0.0 and about[0] == pytest.approx(optical_depth(extinction, x[0], u[0], 3.0), rel=0.5)


@pytest.mark.parametrize("block_edge", [2, 4, 13])
def test_delta_and_ratio_tracking_have_the_expectation_of_the_cells(device, block_edge):
    """Along one line 40 000 times: what passes, and the flights by distance (chi square)."""
    count = 40_000
    (x, u), xi = one_line(count), 1 - np.random.default_rng(9).random(count, dtype=np.float32)
    medium, layers, extinction = water(device, block_edge=block_edge)
    mean = each(REGULAR.extinction, [medium, layers, x[:1], u[:1], 3.0, 0], device=device)
    ratio = each(DELTA.extinction, [medium, layers, x, u, 3.0, seeds(count, device)], device=device)
    delta = each(DELTA.free_path, [medium, layers, x, u, xi, seeds(count, device)], device=device)
    exact, passed = np.exp(-mean[0] * 3.0), np.exp(-ratio * 3.0)
    assert abs(passed.mean() - exact) < 4.0 * passed.std() / count**0.5
    assert 0.0 < passed.std() < exact
    edges = np.linspace(0.0, 4.0, 41)
    survived = np.exp([-optical_depth(extinction, x[0], u[0], edge) for edge in edges])
    expected = count * -np.diff([*survived, 0.0])
    counted = np.histogram(np.minimum(delta, 9.0), [*edges, 10.0])[0]
    chi2 = ((counted - expected) ** 2 / np.maximum(expected, 1e-9))[expected > 5].sum()
    assert counted[expected < 1e-6].sum() == 0
    assert chi2 < (expected > 5).sum() + 4.0 * (2.0 * (expected > 5).sum()) ** 0.5


@pytest.mark.slow
@pytest.mark.parametrize("tracking", [REGULAR, DELTA], ids=["regular", "delta"])
def test_flights_in_vacuum_and_beside_the_box_know_no_end(tracking, device):
    medium, layers, _ = water(device)
    medium.extinction = 0.0
    x, u = np.float32([[50.0, 0.0, 0.0], CENTRE - np.array([0.0, 0.0, 50.0])]), np.float32([[0, 1, 0], [0, 0, 1]])
    assert not each(tracking.extinction, [medium, layers, x, u, 1.0, 7], device=device).any()
    assert (each(tracking.free_path, [medium, layers, x, u, np.float32([0.5, 1e-12]), 7], device=device) >= 1e30).all()


def test_blocks_divide_the_cells():
    """Place of a block: that of its cells."""
    turn = ((0.0, -1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0))
    place = {"size": (2.0, 3.0, 1.0), "centre": (0.5, 0.2, 1.0), "rotation": turn}
    grid = sk.make_grid(np.ones((4, 6, 2)), np.ones((4, 6, 2)), **place, device="cpu")
    blocks = sk.make_blocks(grid, (2, 3, 1), [1.0])
    x = np.array([0.3, -0.4, 1.1])
    cells, found = (np.array(g.turn).reshape(3, 3) @ x + np.array(g.shift) for g in (grid, blocks.grid))
    np.testing.assert_allclose(found, cells / [2.0, 2.0, 2.0], rtol=1e-5)
    assert (blocks.count, tuple(blocks.grid.size)) == (6, (2, 3, 1))
