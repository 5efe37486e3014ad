"""A plane with steps in a gate, and depth frames of it in which some pixels report backscatter."""

import numpy as np

from spadwarp.denoise import estimate
from spadwarp.evaluation import datasets

GATE = (13.5, 16.0)


def scene(height=48, width=64):
    """A plane at 15 m with three steps of 10 cm, and sky in a corner."""
    depth = np.full((height, width), 15.0, np.float32)
    for k in range(3):
        depth[6:-6, 10 + 14 * k : 24 + 14 * k] = 14.9 - 0.1 * k
    depth[:5, :5] = np.nan
    return depth


def noisy_frame(clean, share=0.3, seed=0):
    """Jitter of 3 mm, and a share of the pixels that report backscatter from nearer than the target."""
    generator = np.random.default_rng(seed)
    frame = clean + generator.normal(0, 0.003, clean.shape).astype(np.float32)
    replaced = generator.random(clean.shape) < share
    reach = np.nan_to_num(clean, nan=GATE[1]) - GATE[0]
    frame[replaced] = (GATE[0] + generator.random(clean.shape) * reach)[replaced]
    return frame.astype(np.float32)


def denoised(depth, mask=0.0, **options):
    """Depth denoised on the CPU, over `GATE` unless options say otherwise."""
    return estimate(depth, **{"gate": GATE, "device": "cpu", **options}).masked(mask)


def scores(clean, estimate):
    """Scores over `GATE`; a pixel without an estimate counts as one in the middle of the gate."""
    return datasets.score(clean, np.nan_to_num(estimate, nan=14.75), gate=GATE)
