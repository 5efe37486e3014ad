"""A phase function of your own in the transport kernel: two Warp functions and a name.

Pure sea water scatters as 1 + 0.835 cos²θ (Morel 1974), forward and backward alike. A `PhaseFunction` is a density per
steradian and its sampler; both take t = 1 − cos θ, in which the forward peak of other waters keeps its precision. The
transport kernel is compiled with them, so that they cost what their arithmetic costs.

    python kernels/examples/own_phase_function.py --photons 1e7
"""

import argparse
import math

import numpy as np
import warp as wp

import spadwarp_kernels as sk

ANISOTROPY_OF_DENSITY = wp.constant(0.835)
NORM = wp.constant(1.0 / (4.0 * math.pi * (1.0 + 0.835 / 3.0)))


@wp.func
def pure_water_pdf(t: float, medium: sk.Medium) -> float:
    """Density [1/sr]; its integral over the sphere is 1."""
    mu = 1.0 - t
    return NORM * (1.0 + ANISOTROPY_OF_DENSITY * mu * mu)


@wp.func
def pure_water_sample(xi: float, medium: sk.Medium) -> float:
    """t = 1 − cos θ for uniform xi in [0, 1): the root of μ + f μ³/3 = (1 − 2 xi)(1 + f/3), by Cardano's formula."""
    f = ANISOTROPY_OF_DENSITY
    k = (1.0 - 2.0 * xi) * (1.0 + f / 3.0)
    q = 1.5 * wp.abs(k) / f
    u = wp.pow(q + wp.sqrt(q * q + 1.0 / (f * f * f)), 1.0 / 3.0)
    return wp.clamp(1.0 - wp.sign(k) * (u - 1.0 / (f * u)), 0.0, 2.0)


PURE_WATER = sk.PhaseFunction("pure_water", pure_water_pdf, pure_water_sample)


def slab(phase, photons, *, anisotropy=0.0, optical_thickness=1.0, albedo=0.9, seed=1, device=None):
    """Fractions of a pencil beam's light that a slab of water reflects and lets through."""
    medium, laser, limits = sk.Medium(), sk.Laser(), sk.Limits()
    medium.extinction, medium.albedo, medium.anisotropy, medium.axis_threshold = 1.0, albedo, anisotropy, 1.0
    laser.position, laser.axis, laser.profile = wp.vec3(0.0), wp.vec3(0.0, 0.0, 1.0), 2
    limits.lower, limits.upper = wp.vec3(-1e30, -1e30, 0.0), wp.vec3(1e30, 1e30, optical_thickness)
    limits.lateral, limits.max_path, limits.max_collisions, limits.weight_cutoff = 1e30, 1e30, 1000, 1e-4
    spec = sk.TransportSpec("none", phase=phase, mesh=False, bounded=True, roulette=True)
    device = wp.get_device(device)
    model = sk.Model(
        device,
        medium,
        laser,
        sk.Camera(),
        sk.Gate(),
        limits,
        sk.Guiding(),
        None,
        sk.make_surfaces(None, device=device),
        1.0,
    )
    data = sk.make_data(model, histogram=False)
    for first in range(0, photons, 1 << 20):
        count = min(1 << 20, photons - first)
        sk.launch_transport(spec, model, data, seed=seed, first_id=first, photon_count=count)
    ledger, _ = sk.read_ledger(data)
    return tuple(ledger[name] * sk.LEDGER_UNIT / photons for name in ("exit_z_low", "exit_z_high"))


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--photons", type=float, default=1e6)
    parser.add_argument("--device", help='"cpu" or "cuda:0"; by default the GPU, if there is one')
    options = parser.parse_args()
    for name, phase in {"pure water": PURE_WATER, "isotropic": sk.HENYEY_GREENSTEIN}.items():
        reflected, transmitted = slab(phase, int(options.photons), device=options.device)
        print(f"{name:>12}: {reflected:.4f} reflected, {transmitted:.4f} let through")
    print(f"     density: {NORM:.5f} (1 + 0.835 cos²θ) / sr; {np.pi * 4 * NORM * (1 + 0.835 / 3):.3f} over the sphere")


if __name__ == "__main__":
    main()
