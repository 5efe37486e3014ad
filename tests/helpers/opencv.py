"""The projection of OpenCV from its published formulas, in float64."""

import math

import numpy as np


def project_points(points, rvec, tvec, fx, fy, cx, cy, distortion):
    """Pixels as in the documentation of OpenCV's `projectPoints`, written out point by point; the first pixel's centre
    is at (0, 0)."""
    angle = math.sqrt(sum(r * r for r in rvec))
    k1, k2, p1, p2, k3 = distortion
    pixels = []
    for point in points:
        turned = list(point)
        if angle > 0:  # Rodrigues
            axis = [r / angle for r in rvec]
            along = sum(a * p for a, p in zip(axis, point, strict=True))
            cross = np.cross(axis, point)
            turned = [
                p * math.cos(angle) + c * math.sin(angle) + a * along * (1 - math.cos(angle))
                for p, c, a in zip(point, cross, axis, strict=True)
            ]
        x, y, z = (a + b for a, b in zip(turned, tvec, strict=True))
        x, y = x / z, y / z
        r2 = x**2 + y**2
        radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
        seen_x = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x**2)
        seen_y = y * radial + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y
        pixels.append((fx * seen_x + cx, fy * seen_y + cy))
    return np.array(pixels)
