"""Fresnel's equations; rays through a port in float64: Snell's law in vectors at each face, roots and derivatives by
brute force."""

import numpy as np
from scipy.optimize import root


def amplitudes(cosine, index):
    """Reflection amplitudes r_s and r_p at a face, from its cosine and the index behind it over that before it; complex
    beyond the critical angle (Bohren & Huffman 1983, eq 2.67)."""
    behind = np.emath.sqrt(1.0 - (1.0 - cosine**2) / index**2)
    s = (cosine - index * behind) / (cosine + index * behind)
    p = (index * cosine - behind) / (index * cosine + behind)
    return s, p


def reflectance(cosine, index):
    """Of unpolarised light."""
    return 0.5 * sum(np.abs(amplitude) ** 2 for amplitude in amplitudes(cosine, index))


def face_distance(face, x, u):
    """Distance along u to a plane ("plane", normal, offset) or the next crossing of a sphere ("sphere", centre, radius,
    whether from outside)."""
    if face[0] == "plane":
        return (face[2] - x @ face[1]) / (u @ face[1])
    y = x - face[1]
    b = y @ u
    rest = b * b - y @ y + face[2] ** 2
    return -b - np.sqrt(rest) if face[3] else -b + np.sqrt(rest)


def face_normal(face, x):
    return face[1] if face[0] == "plane" else (x - face[1]) / face[2]


def refract(u, normal, before, behind):
    """Direction behind a face, and the transmissions of both polarisations."""
    normal = normal if u @ normal > 0 else -normal
    cos_in = u @ normal
    sine = (u - cos_in * normal) * before / behind
    s, p = amplitudes(cos_in, behind / before)
    return sine + np.sqrt(1.0 - sine @ sine) * normal, 1.0 - s**2, 1.0 - p**2


def trace(faces, indices, x, u):
    """A ray through the faces in their order: last point, direction, the lengths up to each face, transmission.

    `indices`: of the layers, one more than faces; where two are equal nothing is refracted.
    """
    lengths, s, p = [], 1.0, 1.0
    for face, before, behind in zip(faces, indices[:-1], indices[1:], strict=True):
        length = face_distance(face, x, u)
        x = x + length * u
        lengths.append(length)
        u, t_s, t_p = refract(u, face_normal(face, x), before, behind)
        s, p = s * t_s, p * t_p
    return x, u, lengths, 0.5 * (s + p)


def flat_faces(normal, distance, thickness):
    """Faces as a ray from the water meets them."""
    return [("plane", normal, distance + thickness), ("plane", normal, distance)]


def dome_faces(centre, radius, thickness):
    return [("sphere", centre, radius + thickness, True), ("sphere", centre, radius, True)]


def meet_plane(x, u, point, normal):
    length = ((point - x) @ normal) / (u @ normal)
    return x + length * u, length


def axes_across(u):
    """Two unit vectors across u."""
    e = np.cross(u, np.eye(3)[np.argmin(np.abs(u))])
    e /= np.linalg.norm(e)
    return np.stack([e, np.cross(u, e)])


def connect(faces, indices, x, o, start):
    """The ray from x in the water to o inside, by a root in the direction at x.

    `start`: a first guess of the direction. Returns direction at x, direction at o, lengths (water, window, inside),
    transmission, and the solid angle at x over the area across the ray at o, by finite differences.
    """
    b = axes_across(start)

    def landing(slopes, plane_normal):
        u = start + slopes @ b
        u = u / np.linalg.norm(u)
        y, v, lengths, through = trace(faces, indices, x, u)
        met, last = meet_plane(y, v, o, plane_normal)
        return met, u, v, [*lengths, last], through

    across = axes_across(start)
    found = root(lambda s: across @ (landing(s, start)[0] - o), np.zeros(2), tol=1e-14)
    _, u, v, lengths, through = landing(found.x, start)
    miss = np.linalg.norm(landing(found.x, start)[0] - o)
    assert miss < 1e-9, (miss, found.message)
    # Solid angle over area: inverse of the determinant of the map from directions to points across the ray.
    c, plane, h = axes_across(u), axes_across(v), 1e-5
    columns = []
    for k in range(2):
        points = []
        for sign in (1, -1):
            w = u * np.cos(h) + sign * np.sin(h) * c[k]
            y, q, *_ = trace(faces, indices, x, w)
            points.append(meet_plane(y, q, o, v)[0])
        columns.append(plane @ (points[0] - points[1]) / (2 * h))
    return u, v, lengths, through, 1.0 / abs(np.linalg.det(np.stack(columns)))
