"""The tally of flux: what legs add to voxels, gates and planes, against float64, closed forms and the ledger."""

import functools
import math

import numpy as np
import pytest
import warp as wp

import spadwarp_kernels as sk
from helpers.launch import launched
from spadwarp_kernels.tally.tally import fold_accumulators

SCALE = 2.0**20
WATER = sk.make_medium(0.01, 0.99)  # g 0, albedo .99
PHOTONS = 20_000
DRAWS = wp.constant(512)
NO_HALVES = wp.zeros(0, dtype=wp.uint32, device="cpu")


@wp.kernel
def _tracks(
    volume: sk.FluxVolume,
    x: wp.array[wp.vec3],
    u: wp.array[wp.vec3],
    tally: wp.array[wp.int64],
    halves: wp.array[wp.uint32],
):
    i = wp.tid()
    # Any point within a step alike.
    for k in range(DRAWS):
        sample = 0.5 + (float(k) + 0.5) / (4096.0 * float(DRAWS))
        sk.add_flux_track(volume, tally, halves, sk.Leg(x[i], u[i], 3.0, 1.0, 0.5, sample))


@wp.kernel
def _planes(
    planes: sk.FluxPlanes,
    x: wp.array[wp.vec3],
    u: wp.array[wp.vec3],
    positions: wp.array[float],
    tally: wp.array[wp.int64],
    halves: wp.array[wp.uint32],
):
    i = wp.tid()
    sk.add_flux_crossings(planes, positions, tally, halves, sk.Leg(x[i], u[i], 3.0, 1.0, 0.5, 0.5))


def directions(rng, count):
    u = rng.normal(size=(count, 3))
    return u / np.linalg.norm(u, axis=1, keepdims=True)


def test_lengths_in_voxels_and_gates_are_those_of_dense_points():
    """By an array of one's own, of a turned box whose gates hold a part of each leg."""
    rng = np.random.default_rng(1)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    origin, lower, edge = np.array([0.1, 0.2, -0.3]), np.array([-1.0, -0.7, -1.1]), np.array([0.5, 0.3, 0.4])
    x, u = rng.uniform(-1.5, 1.5, (60, 3)), directions(rng, 60)
    gates = {"gates": 3, "gate_start": 1.5, "gate_path": 0.6}
    volume = sk.make_flux_volume((4, 5, 6), lower=lower, edge=edge, rotation=turn, origin=origin, scale=SCALE, **gates)
    sk.make_flux([volume], device="cpu")
    tally = wp.zeros(3 * 4 * 5 * 6, dtype=wp.int64, device="cpu")
    launched(_tracks, [volume, x, u, tally, NO_HALVES], out=())
    steps = (np.arange(4_000) + 0.5) * 3.0 / 4_000
    expected = np.zeros((3, 4, 5, 6))
    for start, along in zip(x, u, strict=True):
        cell = np.floor(((start + steps[:, None] * along) @ turn.T + origin - lower) / edge).astype(int)
        gate = np.floor((1.0 + steps - 1.5) / 0.6).astype(int)
        inside = ((cell >= 0) & (cell < (4, 5, 6))).all(axis=1) & (gate >= 0) & (gate < 3)
        np.add.at(expected, (gate[inside], *cell[inside].T), 0.5 * 3.0 / 4_000)
    # A point more or less at each end of a way in a voxel.
    found = tally.numpy().reshape(expected.shape) / (SCALE * 512)
    assert np.abs(found - expected).max() < 60 * 2 * 0.5 * 3.0 / 4_000 / 8


@wp.kernel
def _collisions(volume: sk.FluxVolume, x: wp.array[wp.vec3], tally: wp.array[wp.int64], halves: wp.array[wp.uint32]):
    for k in range(64):
        leg = sk.Leg(x[wp.tid()], wp.vec3(0.0, 0.0, 1.0), 0.0, 0.0, float(k + 1) / 64.0, 0.5)
        sk.add_flux_collision(volume, tally, halves, leg, 1.0)


@pytest.mark.parametrize("scale", [2.0**13, 2.0**18])
def test_halves_apart_keep_the_sums(device, scale):
    """Carries into the neighbour's half, out of the word, and values of more than 16 bits; an odd number of voxels."""
    if not wp.get_device(device).is_cuda:
        pytest.skip("CUDA alone keeps them apart")
    volume = sk.make_flux_volume((3, 3, 3), lower=(0, 0, 0), edge=(1, 1, 1), estimator="collision", scale=scale)
    sk.make_flux([volume], device=device)
    x = wp.array(np.random.default_rng(3).uniform(0.0, 3.0, (20_000, 3)), dtype=wp.vec3, device=device)
    tally, other = (wp.zeros(27, dtype=wp.int64, device=device) for _ in range(2))
    halves, none = (wp.zeros(size, dtype=wp.uint32, device=device) for size in (14, 0))
    wp.launch(_collisions, dim=x.size, inputs=[volume, x, tally, none], device=device)
    wp.launch(_collisions, dim=x.size, inputs=[volume, x, other, halves], device=device)
    fold_accumulators(halves, other)
    assert np.array_equal(tally.numpy(), other.numpy()) and tally.numpy().min() > 0 and not halves.numpy()[:13].any()


def test_light_through_planes_of_even_radiance():
    """Crossings of even radiance: mean cosine 1/2 either way, scalar irradiance twice the plane's, even radiance."""
    rng, count = np.random.default_rng(2), 400_000
    u = directions(rng, count)
    x = rng.uniform(-1.0, 1.0, (count, 3)) * (5.0, 3.0, 5.0)
    planes = sk.make_flux_planes(2, axis=(0, 1, 0), right=(0, 0, 1), radius=2.0, polar=6, azimuth=3, scale=SCALE)
    sk.make_flux([planes], [-0.1, 0.0], device="cpu")
    tally = wp.zeros(2 * (4 + 18), dtype=wp.int64, device="cpu")
    positions = wp.array([-0.1, 0.0], dtype=float, device="cpu")
    launched(_planes, [planes, x, u, positions, tally, NO_HALVES], out=())
    down, up, scalar_down, scalar_up, *radiance = (tally.numpy().reshape(2, 22)[1] / SCALE).tolist()
    # Photons of density n per volume with legs of 3 m make the fluence n·3 m·.5; a disc of radius 2 m has 4 pi m^2.
    scalar = 0.5 * 3.0 * count / (10.0 * 6.0 * 10.0) * 4.0 * math.pi
    assert [down, up] == pytest.approx([scalar / 4] * 2, rel=0.02)
    assert [scalar_down, scalar_up] == pytest.approx([scalar / 2] * 2, rel=0.03)
    edges = np.cos(np.linspace(0.0, math.pi, 7))
    solid = np.repeat(-np.diff(edges) * 2 * math.pi / 3, 3)
    even = (np.array(radiance) / solid / (scalar / (4 * math.pi))).reshape(6, 3)
    assert even[[0, 1, 4, 5]] == pytest.approx(np.ones((4, 3)), rel=0.14)
    assert even[2:4] == pytest.approx(np.ones((2, 3)), rel=0.2)  # of rays along the plane, which few have
    assert sum(radiance) == pytest.approx(scalar_down + scalar_up)


def box(estimator, edge=1.0, size=40):
    where = {"lower": [-0.5 * size * edge] * 3, "edge": [edge] * 3}
    return sk.make_flux_volume((size,) * 3, **where, estimator=estimator, scale=SCALE)


@functools.cache
def traced(parts=(PHOTONS,)):
    """An isotropic source in water without end: voxels by either estimator, and all the water."""
    limits = sk.Limits()
    limits.lower, limits.upper, limits.lateral = wp.vec3(-1e30), wp.vec3(1e30), 1e30
    limits.max_path, limits.weight_cutoff, limits.max_collisions = 1e30, 0.1, 1 << 30
    whole = sk.make_flux_volume((1, 1, 1), lower=(0, 0, 0), edge=[math.inf] * 3, estimator="collision", scale=SCALE)
    sections = [box("track"), box("collision"), whole]
    model = sk.Model(
        device="cpu",
        medium=WATER,
        laser=sk.make_laser("uniform_cone", half_angle=math.pi),
        camera=sk.Camera(),
        gate=sk.Gate(),
        limits=limits,
        guiding=sk.Guiding(),
        mesh=None,
        surfaces=sk.make_surfaces(None, device="cpu"),
        scale=1.0,
        flux=sk.make_flux(sections, device="cpu"),
    )
    spec = sk.TransportSpec("none", mesh=False, roulette=True, flux=("track", "collision"))
    data, first = sk.make_data(model, histogram=False), 0
    for photons in parts:
        sk.launch_transport(spec, model, data, seed=3, first_id=first, photon_count=photons)
        first += photons
    return data.flux.numpy(), sk.read_ledger(data)[0]


@pytest.mark.slow
def test_fluence_and_balance_of_a_source_in_water_without_end():
    """Far away 4 pi r phi = 2.9520 c exp(-.172511 c r), from c r = 10 on, by tracks and by collisions; absorption times
    fluence of all water is what the ledger has, but for the rounding of weights to single precision."""
    tally, ledger = traced()
    centre = np.arange(40) - 19.5
    r = np.sqrt(sum(part**2 for part in np.meshgrid(centre, centre, centre)))
    shell = (r >= 10.0) & (r < 16.0)
    expected = (2.9520 * np.exp(-0.172511 * r) / (4.0 * math.pi * r))[shell].sum()
    for cube in tally[: 2 * 40**3].reshape(2, 40, 40, 40) / (SCALE * PHOTONS):
        assert cube[shell].sum() == pytest.approx(expected, rel=0.015)
    absorbed = float(WATER.extinction) * (1.0 - float(np.float32(WATER.albedo))) * tally[-1] / SCALE
    assert ledger["absorbed_water"] + ledger["roulette"] == sum(ledger.values()) == PHOTONS / sk.LEDGER_UNIT
    assert absorbed == pytest.approx(ledger["absorbed_water"] * sk.LEDGER_UNIT, rel=1e-6)


def test_launches_do_not_change_the_bits():
    whole, _ = traced((2_000,))
    parts, _ = traced((700, 1_300))
    assert np.array_equal(whole, parts) and whole.any()


def test_what_cannot_be_combined_is_refused():
    with pytest.raises(sk.ArgumentError, match="flux cannot be combined with"):
        sk.load_transport_kernel(sk.TransportSpec("guided", flux=("track",)), "cpu")
    with pytest.raises(sk.ArgumentError, match="sun needs"):
        sk.load_transport_kernel(sk.TransportSpec("none", sun=True), "cpu")
    with pytest.raises(sk.ArgumentError, match="positions: 1 of 2 planes"):
        sk.make_flux([sk.make_flux_planes(2, axis=(0, 0, 1), right=(1, 0, 0))], [0.0], device="cpu")
    with pytest.raises(sk.ArgumentError, match="shape"):
        sk.make_flux_volume((2, 1, 1), lower=(0, 0, 0), edge=[math.inf] * 3)
