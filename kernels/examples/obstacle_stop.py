"""Vehicles stop before a wall in turbid water by what their single-photon camera sees: one world for each turbidity.

    python obstacle_stop.py [curve.png]

A filter of the significant depths decides when to brake. The curve is the clearance that is left over the extinction.
"""

import sys

import numpy as np
import warp as wp

import spadwarp_kernels as sk

SPEED, DECELERATION, STEP = 1.5, 0.5, 0.1  # [m/s], [m/s^2], [s]
MARGIN = 1.0  # clearance that the vehicle wants to keep [m]
SEEN = 8  # pixels with a significant depth that make an obstacle


def nearest_obstacle(distance, status):
    """Range of each world's obstacle [m], from its SEEN nearest significant pixels; infinite where there are fewer."""
    ranges = np.where(status == sk.CAMERA_STATUS.index("no_return"), np.nan, distance).reshape(len(distance), -1)
    found = np.sort(np.where(np.isfinite(ranges), ranges, np.inf), axis=1)  # NaN is no obstacle
    return np.median(found[:, :SEEN], axis=1)


def main(extinctions, start=12.0, device=None):
    """Clearance that each vehicle keeps [m], and the range at which it began to brake [m]; 0 or less is a crash."""
    worlds = len(extinctions)
    water = {"scattering": 0.7 * np.asarray(extinctions), "absorption": 0.3 * np.asarray(extinctions)}
    shapes = sk.make_shapes(
        ["plane"], [(0, 0, 0)], local=[(0, 0, start, 0, 0, 0, 1)], worlds=worlds, frame="optical", device=device
    )
    config = sk.SpadConfig(width=32, height=24, bins=256, gate_distance=(0.3, 12.0), method="matched", pulses=5000)
    camera = sk.SpadCamera(config, worlds, by_world=water, outputs=("depth",), body=range(worlds), device=device)
    bodies = wp.zeros(worlds, dtype=wp.transform, device=device)
    place, speed = np.zeros(worlds), np.full(worlds, SPEED)
    braking, began = np.zeros(worlds, bool), np.full(worlds, np.nan)
    while (speed > 0.0).any():
        pose = np.zeros((worlds, 7), np.float32)
        pose[:, 2], pose[:, 6] = place, 1.0
        bodies.assign(pose)
        camera.update(shapes, body_q=bodies)
        ranges = nearest_obstacle(camera.distance.numpy(), camera.status.numpy())
        near = ranges < MARGIN + speed**2 / (2.0 * DECELERATION) + speed * STEP
        began[near & ~braking] = (start - place)[near & ~braking]
        braking |= near
        slower = np.maximum(speed - DECELERATION * STEP * braking, 0.0)
        place, speed = place + 0.5 * (speed + slower) * STEP, slower
        speed[place >= start] = 0.0  # a crash
    return start - place, began


if __name__ == "__main__":
    extinction = np.linspace(0.2, 4.0, 20)
    clearance, began = main(extinction)
    for row in zip(extinction, began, clearance, strict=True):
        print("extinction {:.2f} / m: brakes at {:5.2f} m, stops {:5.2f} m before the wall".format(*row))
    if len(sys.argv) > 1:
        import matplotlib.pyplot as plt

        plt.figure(figsize=(5.0, 3.2), layout="constrained")
        plt.plot(extinction, clearance, "o-", label="clearance at the stop")
        plt.plot(extinction, began, "s--", label="range at which it brakes")
        plt.axhline(MARGIN, color="0.6", linewidth=0.8)
        plt.xlabel("extinction [1/m]")
        plt.ylabel("[m]")
        plt.legend()
        plt.savefig(sys.argv[1], dpi=120)
