"""Irradiance in a sea without a bottom below a flat surface, by discrete ordinates in float64, without noise.

Radiance averaged over azimuth obeys μ dL/dτ = −L + ω/2 ∫h(μ, μ′)L(μ′)dμ′ + source, at Gauss nodes of both hemispheres
a sum of exponentials (Stamnes et al. 1988, Applied Optics 27, 2502). Nodes lie on either side of the critical angle,
where the surface's reflectance has a kink. The peak of a phase function within `peak_deg` is cut to its value there;
the rest counts as not scattered, which changes the mean square angle of scattering by less than 1e-4.
"""

import math

import numpy as np

from reference.refraction import reflectance


def rayleigh(theta):
    """Phase function by angle, of any scale."""
    return 1.0 + np.cos(theta) ** 2


def tabulated(angles_deg, values):
    """The phase function of a table, log-log between its angles and below them."""
    known, logs = np.log(np.radians(angles_deg)), np.log(values)
    slope = (logs[1] - logs[0]) / (known[1] - known[0])
    known, logs = np.append(math.log(1e-9), known), np.append(logs[0] + slope * (math.log(1e-9) - known[0]), logs)
    return lambda theta: np.exp(np.interp(np.log(np.maximum(theta, 1e-9)), known, logs))


def irradiance(absorption, scattering, phase, depths, *, zenith_deg=60.0, index=1.34, peak_deg=2.0, nodes=20):
    """Downward, upward, scalar downward and scalar upward irradiance over that on the surface, `[depth, 4]`."""
    peak = math.radians(peak_deg)
    theta = np.geomspace(1e-9, math.pi, 200_001)
    whole = np.trapezoid(phase(theta) * np.sin(theta) * theta, np.log(theta)) * 2.0 * math.pi
    kept = np.trapezoid(phase(np.maximum(theta, peak)) * np.sin(theta) * theta, np.log(theta)) * 2.0 * math.pi
    cut, extinction = 1.0 - kept / whole, absorption + scattering * kept / whole
    albedo = scattering * (1.0 - cut) / extinction

    air, critical = math.cos(math.radians(zenith_deg)), math.sqrt(1.0 - 1.0 / index**2)
    sun = math.sqrt(1.0 - (1.0 - air**2) / index**2)
    x, gauss = np.polynomial.legendre.leggauss(nodes)
    edges = np.array([0.0, critical, sun, 1.0])
    half = 0.5 * np.diff(edges)[:, None]
    mu, weight = (edges[:-1, None] + half * (1.0 + x)).ravel(), (half * gauss).ravel()

    # Azimuths lie close together near 0, where light that goes on straight is.
    turn, share = 0.5 * (1.0 + x), 0.5 * gauss
    azimuth, share = math.pi * turn**4, 4.0 * turn**3 * share

    def redistribution(into, side):
        """4 pi times the mean of the phase function over azimuth, `[mu, into]`."""
        across = np.sqrt(np.outer(1.0 - mu**2, 1.0 - into**2))
        total = np.zeros(across.shape)
        for angle, part in zip(azimuth, share, strict=True):
            cosine = side * np.outer(mu, into) + across * math.cos(angle)
            total += part * phase(np.maximum(np.arccos(np.clip(cosine, -1.0, 1.0)), peak))
        return total * 4.0 * math.pi / kept

    same, opposite = redistribution(mu, 1.0), redistribution(mu, -1.0)
    # What the nodes miss of the light of one of them goes on as it came.
    same[np.diag_indices_from(same)] += (2.0 - weight @ (same + opposite)) / weight
    beam = (1.0 - reflectance(sun, 1.0 / index)) / sun  # irradiance across it
    first = [redistribution(np.array([sun]), side)[:, 0] for side in (1.0, -1.0)]
    found = 2.0 / (weight @ sum(first))
    down, up = (albedo * beam / (4.0 * math.pi) * found * part / mu for part in first)

    forward = (np.eye(mu.size) - 0.5 * albedo * same * weight) / mu[:, None]
    back = 0.5 * albedo * opposite * weight / mu[:, None]
    plus, minus, decay = forward + back, forward - back, 1.0 / sun
    squares, sums = np.linalg.eig(plus @ minus)
    rates, sums = np.sqrt(squares.real), sums.real
    differences = minus @ sums / rates
    own = np.linalg.solve(plus @ minus - decay**2 * np.eye(mu.size), plus @ (down + up) + decay * (down - up))
    own_difference = (minus @ own - (down + up)) / decay
    reflected = reflectance(mu, 1.0 / index)[:, None]
    modes = (sums + differences) - reflected * (sums - differences)
    source = (own + own_difference) - reflected[:, 0] * (own - own_difference)
    amplitudes = np.linalg.solve(modes, -source)

    result = np.zeros((len(depths), 4))
    for row, depth in zip(result, depths, strict=True):
        fade, direct = amplitudes * np.exp(-rates * extinction * depth), math.exp(-extinction * depth * decay)
        total, net = sums @ fade + own * direct, differences @ fade + own_difference * direct
        for side, light in enumerate((0.5 * (total + net), 0.5 * (total - net))):
            row[side], row[2 + side] = (2.0 * math.pi * (weight * factor) @ light for factor in (mu, 1.0))
        row[[0, 2]] += beam * direct * np.array([sun, 1.0])
    return result
