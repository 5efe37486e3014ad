"""Runs over many seeds, and whether the estimators share one expectation."""

import math

import numpy as np

from helpers.runs import of_seeds
from helpers.statistics_of_samples import equal_means_p
from spadwarp.scene.pose import rotation_matrix

SEEDS = 20  # of each mean, which analog then knows to about 1 % and guided to better than that
PHOTONS = {"analog": 40_000, "next_event": 20_000, "guided": 20_000}


def cells(one, device, photons, seeds=SEEDS, pixels=False):
    """Fractions of emitted photons `[seeds, cells]`: each component's bins over all pixels; with `pixels` also each
    pixel over all bins."""
    rows = []
    for run in of_seeds(one, device, photons, range(seeds)):
        parts = [run.light.sum(axis=(1, 2)), run.light.sum(axis=(0, 3))][: 2 if pixels else 1]
        rows.append(np.concatenate([part.ravel() for part in parts]))
    return np.array(rows)


def means(one, device, photons, seeds):
    """Fractions of emitted photons in all pixels: mean and standard error by bin, then of all bins together."""
    rows = np.array([run.light.sum(axis=(0, 1, 2)) for run in of_seeds(one, device, photons, range(seeds))])
    totals = rows.sum(axis=1)
    error, total_error = (part.std(axis=0, ddof=1) / math.sqrt(seeds) for part in (rows, totals))
    return rows.mean(axis=0), error, totals.mean(), total_error


def clear_at_the_lens(one):
    """The scene with clear water behind the lens and up to 0.3 m before it, as it is where that is so already."""
    medium, camera = one.medium, one.camera
    if medium.extinction < 0.01:
        return one
    axis = rotation_matrix(camera.rotation_deg)[:, 2]
    water = {"start": float(axis @ camera.position) + 0.3, "extinction": medium.extinction, "albedo": medium.albedo}
    if medium.layers:
        assert not camera.is_posed and tuple(medium.layer_axis) == (0.0, 0.0, 1.0)
    layers = [water, *(layer.to_dict() for layer in medium.layers)]
    clear = {"extinction": 1e-4, "albedo": medium.albedo, "layers": layers, "layer_axis": axis.tolist()}
    return one.with_overrides(medium=clear)


def agreeing_cells(one, device, *, photons=PHOTONS, seeds=SEEDS, pixels=False, converged=0.2, clear=False):
    """Cells of each estimator, after two pairs were found to have the same mean wherever both have converged: analog
    and guided, and next_event and guided in water that is clear next to the lens.

    Next events from there have an infinite variance, so that their means over any number of seeds are not normal.
    `clear`: the first pair too is compared in that water, which spares a kernel where another scene has it turbid.
    The comparison has teeth: guided knows its total to 1 %.
    """
    clear_one = clear_at_the_lens(one)
    if clear or "analog" not in photons:
        one = clear_one

    def run(scene, estimator):
        changed = scene.with_overrides({"transport.estimator": estimator})
        return cells(changed, device, photons[estimator], seeds, pixels)

    found = {"guided": run(one, "guided")}
    if "analog" in photons:
        found["analog"] = run(one, "analog")
        assert equal_means_p(found["analog"], found["guided"], converged) > 1e-3, "analog and guided differ"
    others = photons.keys() - {"analog", "guided"}
    reference = found["guided"] if clear_one is one or not others else run(clear_one, "guided")
    for name in others:
        found[name] = run(clear_one, name)
        assert equal_means_p(found[name], reference, converged) > 1e-3, f"{name} and guided differ"
    total = found["guided"].sum(axis=1)
    assert total.std() / total.mean() / math.sqrt(seeds) < 0.01
    return found
