"""How often the 95 % intervals of fits hold the truth: one simulation, many draws of counts, a fit of each.

python bench/fit_coverage.py staircase_5m --exposures 100 --device cuda:0

64 x 64 pixels, as many pulses as make the Cramér–Rao bounds of absorption and scattering 1 %, g known; absorption,
scattering, reflectance and depth unknown. harbour_5m has a target calibrated to 1 % (a prior whose mean is drawn anew
for each exposure): there, its reflectance and the absorption are nearly the same unknown. The first fit starts from
water that is wrong by a factor of 3, the others from its estimates; all take fresh photons.
"""

import argparse
import time
import warnings

import numpy as np
from scipy.stats import binom

import spadwarp
from spadwarp.inverse import Fitter, bounds, read_exposure

SIZE = {"camera.width": 64, "camera.height": 64, "transport.estimator": "guided", "transport.axis_threshold": 1.0}
CHANGES = {
    "harbour_5m": {**SIZE, "transport.weight_cutoff": 1e-6},
    "staircase_5m": {**SIZE, "transport.weight_cutoff": 1e-5},
}
TANK = {
    "medium": {
        "absorption": 0.25,
        "scattering": 0.75,
        "anisotropy": 0.9,
        "group_index": "fresh",
        "phase_index": "fresh",
    },
    "laser": {
        "preset": "picoquant-visuv-532",
        "half_angle_deg": 12.0,
        "position": [-0.06, 0.0, 0.0],
        "pulse_energy": 1e-10,
    },
    "camera": {"width": 64, "height": 64, "horizontal_fov_deg": 20.0, "aperture_diameter": 0.01},
    "detector": {"preset": "photon-force-pf32-microlens"},
    "gate": {"start_ns": 4.0, "bin_width_ps": 55.0, "bins": 512},
    "domain": {
        "shape": "box",
        "lower": [-0.6, -0.25, -0.3],
        "upper": [0.6, 0.5, 3.2],
        "outside_index": {"y_low": 1.0},  # the surface
    },
    "targets": [{"builtin": "plane", "size": [1.2, 0.75], "translation": [0.0, 0.125, 3.0], "reflectance": 0.3}],
    "transport": {"estimator": "guided", "max_collisions": 128, "weight_cutoff": 1e-5, "axis_threshold": 1.0},
}
WATER = "absorption,scattering,reflectance"
CALIBRATED = 0.003  # standard deviation of the reflectance in harbour_5m


def load(name):
    return spadwarp.Scene.from_dict(TANK) if name == "tank" else spadwarp.load_scene(name, CHANGES[name])


def pulses_for_one_percent(scene, calibrated, photons, device):
    """Fewest pulses at which the bounds of absorption and scattering are 1 %."""
    found = bounds(scene, unknown=WATER, pulses=1000, photons=photons, seed=11, device=device)
    information = np.linalg.inv(found.covariance) / found.pulses
    known = np.diag([0.0, 0.0, (scene.targets[0].reflectance / CALIBRATED) ** 2 if calibrated else 0.0])
    for pulses in np.geomspace(1e2, 1e9, 281):
        variance = np.diag(np.linalg.inv(pulses * information + known))
        if variance[:2].max() <= 0.01**2:
            return int(pulses)
    return int(1e9)


def main(name, exposures, device, photons, truth_photons, seconds):
    warnings.simplefilter("ignore", spadwarp.errors.SpadwarpWarning)
    began, scene = time.perf_counter(), load(name)
    calibrated = name == "harbour_5m"
    reflectance = scene.targets[0].reflectance
    pulses = pulses_for_one_percent(scene, calibrated, photons // 4, device)
    truth = spadwarp.simulate(scene, photons=truth_photons, seed=1234, device=device)
    known = {
        "medium.absorption": scene.medium.absorption,
        "medium.scattering": scene.medium.scattering,
        "targets[0].reflectance": reflectance,
    }
    start, rows, times, shares = None, [], [], []
    for number in range(exposures):
        if time.perf_counter() - began > seconds:
            break
        frames = spadwarp.detect(truth, pulses=pulses, seed=1000 + number, device=device)
        measured = float(np.random.default_rng(number).normal(reflectance, CALIBRATED))
        prior = {"targets[0].reflectance": (measured, CALIBRATED)} if calibrated else None
        choices = {"prior": prior, "photons": photons, "seed": 5000 + number, "device": device}
        fitter = Fitter(scene, f"{WATER},depth", read_exposure(frames, scene), **choices)
        if start is None:
            wrong = {"medium.absorption": 3 * scene.medium.absorption, "medium.scattering": scene.medium.scattering / 3}
            fit = fitter.fit(start=wrong)
            start = {one: fit.estimates[one].value for one in known}
            start["depth"] = float(np.nanmean(fit.depth - truth.truth.depth))
            print(
                f"{name}: {pulses} pulses, {fit.counts.sum()} counts; from a wrong start {fit.seconds:.2f} s",
                flush=True,
            )
        else:
            fit = fitter.fit(start=start, near=True)
        depth = fit.estimates["depth"].value - float(np.nanmean(fit.depth - truth.truth.depth))
        rows.append(
            [
                (one.value, true, one.standard_error, one.interval[0] <= true <= one.interval[1])
                for one, true in ((fit.estimates[one], true) for one, true in {**known, "depth": depth}.items())
            ]
        )
        times.append(fit.seconds)
        shares.append(max(one.simulation for one in fit.estimates.values()))
    values = np.array(rows, float)
    print(
        f"{name}: {len(rows)} fits; median {np.median(times):.2f} s, simulation {100 * np.median(shares):.2g} % of "
        "the largest variance"
    )
    for column, one in enumerate([*known, "depth"]):
        value, true, error, inside = values[:, column].T
        hits, total = int(inside.sum()), len(rows)
        p = min(1.0, 2 * min(binom.cdf(hits, total, 0.95), binom.sf(hits - 1, total, 0.95)))
        scale, unit = (1e3, "mm") if one == "depth" else (100 / true, "%")
        off, stated = scale * (value - true), scale * error
        beyond = np.abs(off) > np.maximum(2.0 if unit == "%" else 1.0, 2 * stated)
        print(
            f"  {one:24s} {hits}/{total} covered (p {p:.2g}); error {off.mean():+.3f} ± "
            f"{off.std(ddof=1) / total**0.5 if total > 1 else 0:.3f} {unit}; scatter "
            f"{off.std(ddof=1) if total > 1 else 0:.3f}, stated {stated.mean():.3f}; largest {np.abs(off).max():.2f}; "
            f"{beyond.sum()} beyond 2 bounds and {'1 mm' if unit == 'mm' else '2 %'}"
        )
    centroid = spadwarp.frames.depth_frame(truth) - truth.truth.depth
    print(f"  bias of the centroid {1e3 * np.nanmedian(centroid):.2f} mm; {time.perf_counter() - began:.0f} s in all")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", choices=("harbour_5m", "staircase_5m", "tank"))
    parser.add_argument("--exposures", type=int, default=100)
    parser.add_argument("--device", default="cuda:0")
    parser.add_argument("--photons", type=float, default=4e8, help="of an iteration at most")
    parser.add_argument("--truth-photons", type=float, default=3e9)
    parser.add_argument("--seconds", type=float, default=1e9, help="no further exposure begins after so long")
    asked = parser.parse_args()
    main(asked.scene, asked.exposures, asked.device, int(asked.photons), int(asked.truth_photons), asked.seconds)
