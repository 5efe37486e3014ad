"""How often the 95 % intervals of fits hold the truth: one simulation, many draws of counts, a fit of each.

python bench/fit_coverage.py staircase_5m --exposures 100 --device cuda:0 --rows staircase.jsonl
python bench/fit_coverage.py summary --rows staircase.jsonl harbour.jsonl tank.jsonl

64 x 64 pixels, as many pulses as make the Cramér–Rao bounds of absorption and scattering 1 %, g known; absorption,
scattering, reflectance and depth unknown. harbour_5m has a target calibrated to 1 % (a prior whose mean is drawn anew
for each exposure): there, its reflectance and the absorption are nearly the same unknown. Every fit starts from water
that is wrong by a factor of 3, absorption and scattering in turn too large, and takes photons of its own. Several
processes share the exposures (`--first 0 --every 2`, `--first 1 --every 2`) and the simulation (`--light FILE`).
"""

import argparse
import json
import time
import warnings
from pathlib import Path

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


def wrong_start(scene, number):
    factor = 3.0 if number % 2 else 1 / 3
    return {
        "medium.absorption": factor * scene.medium.absorption,
        "medium.scattering": scene.medium.scattering / factor,
        "depth": 0.01 if number % 4 < 2 else -0.01,
    }


def light_of(scene, path, photons, device):
    """The expectation that counts are drawn from, of a file if there is one."""
    if path is not None and path.is_file():
        return spadwarp.load(path)
    light = spadwarp.simulate(scene, photons=photons, seed=1234, device=device)
    if path is not None:
        light.save(path)
    return light


def main(asked):
    warnings.simplefilter("ignore", spadwarp.SpadwarpWarning)
    began, name, device, scene = time.perf_counter(), asked.scene, asked.device, load(asked.scene)
    calibrated = name == "harbour_5m"
    reflectance = scene.targets[0].reflectance
    pulses = pulses_for_one_percent(scene, calibrated, int(asked.photons) // 4, device)
    many = (6e9 if calibrated else 3e9) if asked.truth_photons is None else asked.truth_photons
    light = light_of(scene, asked.light, int(many), device)
    centroid = float(np.nanmedian(spadwarp.frames.depth_frame(light) - light.truth.depth))
    print(
        f"{name}: {pulses} pulses; centroid {1e3 * centroid:+.2f} mm; ready after {time.perf_counter() - began:.1f} s"
    )
    for number in range(asked.first, asked.exposures, asked.every):
        if time.perf_counter() - began > asked.seconds:
            break
        frames = spadwarp.detect(light, pulses=pulses, seed=1000 + number, device=device)
        measured = float(np.random.default_rng(number).normal(reflectance, CALIBRATED))
        prior = {"targets[0].reflectance": (measured, CALIBRATED)} if calibrated else None
        choices = {"prior": prior, "photons": int(asked.photons), "seed": 5000 + number, "device": device}
        fit = Fitter(scene, f"{WATER},depth", read_exposure(frames, scene), **choices).fit(
            initial_guess=wrong_start(scene, number)
        )
        true = {
            "medium.absorption": scene.medium.absorption,
            "medium.scattering": scene.medium.scattering,
            "targets[0].reflectance": reflectance,
            "depth": fit.estimates["depth"].value - float(np.nanmean(fit.depth - light.truth.depth)),
        }
        row = {
            "scene": name,
            "number": number,
            "seconds": fit.seconds,
            "photons": fit.photons,
            "iterations": [(int(one.coarse), one.photons, round(one.gain, 3)) for one in fit.iterations],
            "converged": fit.converged,
            "centroid": centroid,
            "counts": int(fit.counts.sum()),
            "estimates": {
                one: (fit.estimates[one].value, value, fit.estimates[one].standard_error, *fit.estimates[one].interval)
                for one, value in true.items()
            },
            "simulation": {one: fit.estimates[one].simulation for one in true},
        }
        with open(asked.rows[0], "a") as file:
            file.write(json.dumps(row, default=float) + "\n")


def summary(paths):
    """A table of all rows, with the p-value of each coverage and the smallest one corrected for their number."""
    rows = [json.loads(line) for path in paths for line in path.read_text().splitlines()]
    values = []
    for scene in dict.fromkeys(row["scene"] for row in rows):
        own = list({row["number"]: row for row in rows if row["scene"] == scene}.values())
        seconds = np.median([row["seconds"] for row in own])
        share = np.median([max(row["simulation"].values()) for row in own])
        print(
            f"{scene}: {len(own)} fits, {sum(row['converged'] for row in own)} converged; median {seconds:.2f} s, "
            f"{np.median([row['photons'] for row in own]):.2e} photons, {np.median([row['counts'] for row in own]):.0f}"
            f" counts; simulation {100 * share:.2g} % of the largest variance; centroid {1e3 * own[0]['centroid']:+.2f}"
            " mm"
        )
        for name in own[0]["estimates"]:
            value, true, error, low, high = np.array([row["estimates"][name] for row in own]).T
            hits, total = int(((low <= true) & (true <= high)).sum()), len(own)
            p = min(1.0, 2 * min(binom.cdf(hits, total, 0.95), binom.sf(hits - 1, total, 0.95)))
            values.append(p)
            scale, unit = (1e3, "mm") if name == "depth" else (100 / true[0], "%")
            off, stated, z = scale * (value - true), scale * error, (value - true) / error
            beyond = np.abs(off) > np.maximum(2.0 if unit == "%" else 1.0, 2 * stated)
            root = max(total - 1, 1) ** 0.5
            print(
                f"  {name:24s} {hits}/{total} covered, p {p:.3f}; bias {z.mean():+.2f} ± {z.std() / root:.2f} bounds, "
                f"{off.mean():+.4f} ± {off.std() / root:.4f} {unit}; scatter {off.std():.4f}, stated "
                f"{stated.mean():.4f}; largest {np.abs(off).max():.3f}; {beyond.sum()} beyond 2 bounds and "
                f"{'1 mm' if unit == 'mm' else '2 %'}"
            )
    print(f"smallest p of {len(values)}, corrected for their number: {min(1.0, len(values) * min(values)):.3g}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", choices=("harbour_5m", "staircase_5m", "tank", "summary"))
    parser.add_argument("--rows", type=Path, nargs="+", required=True, help="files of one JSON line a fit")
    parser.add_argument("--exposures", type=int, default=100)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--every", type=int, default=1)
    parser.add_argument("--light", type=Path, help="file of the simulation; written if it does not exist")
    parser.add_argument("--device", default="cuda:0")
    parser.add_argument("--photons", type=float, default=4e8, help="of an iteration at most")
    parser.add_argument("--truth-photons", type=float, help="by default 3e9, harbour_5m 6e9")
    parser.add_argument("--seconds", type=float, default=1e9, help="no further exposure begins after so long")
    asked = parser.parse_args()
    summary(asked.rows) if asked.scene == "summary" else main(asked)
