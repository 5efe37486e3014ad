"""Irradiance in a sea without a bottom below a flat surface, by a plain random walk in float64 NumPy.

Independent of the Warp kernels in everything but the physics: zenith and azimuth in place of a basis, other numbers,
all photons side by side, crossings of planes from depths alone.
"""

import math

import numpy as np


def rayleigh(rng, count):
    """Cosines of scattering angles, density 3/8 (1 + mu^2): Cardano's root of mu^3 + 3 mu = 8 xi - 4."""
    half = 4.0 * rng.random(count) - 2.0
    root = np.cbrt(half + np.sqrt(half**2 + 1.0))
    return root - 1.0 / root


def tabulated(angles_deg, values):
    """A sampler of the cosines of a table, log-log between its angles and below them, by a fine distribution."""
    known, logs = np.log(np.radians(angles_deg)), np.log(values)
    slope = (logs[1] - logs[0]) / (known[1] - known[0])
    known, logs = np.append(math.log(1e-6), known), np.append(logs[0] + slope * (math.log(1e-6) - known[0]), logs)
    theta = np.geomspace(1e-6, math.pi, 400_000)
    p = np.exp(np.interp(np.log(theta), known, logs))
    steps = np.diff(theta) * 0.5 * (p[1:] * np.sin(theta[1:]) + p[:-1] * np.sin(theta[:-1]))
    share = np.concatenate([[0.0], np.cumsum(steps)]) / steps.sum()
    return lambda rng, count: np.cos(np.interp(rng.random(count), share, theta))


def fresnel(cosine, index):
    """Reflectance of unpolarised light in water of an index below air."""
    sine2 = index**2 * (1.0 - cosine**2)
    behind = np.sqrt(np.maximum(1.0 - sine2, 0.0))
    s = (index * cosine - behind) / (index * cosine + behind)
    p = (cosine - index * behind) / (cosine + index * behind)
    return np.where(sine2 >= 1.0, 1.0, 0.5 * (s**2 + p**2))


def irradiance(absorption, scattering, scatter, depths, photons, rng, *, zenith_deg=60.0, index=1.34):
    """Downward, upward, scalar downward and scalar upward irradiance over that on the surface, `[depth, 4]`."""
    extinction = absorption + scattering
    air = math.cos(math.radians(zenith_deg))
    mu = np.full(photons, math.sqrt(1.0 - (1.0 - air**2) / index**2))
    weight = np.full(photons, 1.0 - fresnel(mu[:1], index)[0])  # the same both ways
    z, found = np.zeros(photons), np.zeros((len(depths), 4))
    while len(z):
        end = z - np.log(1.0 - rng.random(len(z))) / extinction * mu
        above = end < 0.0
        for k, depth in enumerate(depths):
            crosses = (np.minimum(z, end) < depth) & (np.maximum(z, end) >= depth)
            down = crosses & (mu > 0.0)
            for side, chosen in enumerate((down, crosses & ~down)):
                cosine = np.abs(mu[chosen])
                found[k, side] += weight[chosen].sum()
                found[k, 2 + side] += (weight[chosen] / np.where(cosine < 0.01, 0.005, cosine)).sum()
        # At the surface the rest of the way is flown anew: exponential ways remember nothing.
        weight = np.where(above, weight * fresnel(np.abs(mu), index), weight * scattering / extinction)
        cosine, azimuth = scatter(rng, len(z)), 2.0 * math.pi * rng.random(len(z))
        sines = np.sqrt(np.maximum(1.0 - mu**2, 0.0)) * np.sqrt(np.maximum(1.0 - cosine**2, 0.0))
        mu = np.where(above, -mu, np.clip(mu * cosine + sines * np.cos(azimuth), -1.0, 1.0))
        z = np.where(above, 0.0, end)
        light = weight < 0.02
        weight = np.where(light, 0.02, weight) * (~light | (rng.random(len(z)) * 0.02 < weight))
        z, mu, weight = (part[weight > 0.0] for part in (z, mu, weight))
    return found / photons
