"""Surfaces: reflectance from mesh files, interpolated and sampled; the specular lobe in every estimator."""

from __future__ import annotations

import json
import math
import struct
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

import spadwarp
from helpers.estimators import agreeing_cells
from helpers.scenes import scene
from spadwarp import simulate
from spadwarp.device import pick_device
from spadwarp.mesh import build_mesh
from spadwarp.mesh.files import srgb_to_linear
from spadwarp.transport.model import first_hits
from spadwarp.values import ConfigError, MeshError

pytestmark = pytest.mark.physics

CORNERS = np.array([(-1.5, -1.5, 0.0), (1.5, -1.5, 0.0), (1.5, 1.5, 0.0), (-1.5, 1.5, 0.0)])
SQUARE = [(0, 2, 1), (0, 3, 2)]  # faces -z, as the built-in plane does
GREENS = (20, 80, 140, 200)  # of the corners


def square(**visual) -> trimesh.Trimesh:
    return trimesh.Trimesh(CORNERS, SQUARE, process=False, **visual)


def shaded_square(path: Path, greens=GREENS) -> str:
    """A square with a colour at each corner, of which only green counts at 532 nm."""
    square(vertex_colors=[(255, green, 0, 255) for green in greens]).export(path)
    return str(path)


def target(path, **fields) -> dict:
    return {"mesh": str(path), "translation": [0.0, 0.0, 2.2], "reflectance": "from_file", **fields}


def truth(path, pixels=33, **fields):
    """Reflectance that a camera sees of the square at 2.2 m, and x and y of its pixels' centres there, in sides."""
    one = scene(camera={"width": pixels, "height": pixels}, targets=[target(path, **fields)])
    side = (np.arange(pixels) + 0.5 - pixels / 2) * one.camera.pixel_tangent * 2.2 / 3 + 0.5
    return spadwarp.truth_maps(one, device="cpu").reflectance, *np.meshgrid(side, side)


# What files hold


@pytest.mark.parametrize("ending", ["ply", "obj", "glb", "off"])
def test_colours_of_vertices_are_interpolated_over_faces(ending, tmp_path):
    """Against barycentric coordinates in float64: the diagonal runs from the first corner to the third."""
    path = tmp_path / f"square.{ending}"
    if ending == "off":
        rows = [f"{x} {y} {z} 255 {green} 0" for (x, y, z), green in zip(CORNERS, GREENS, strict=True)]
        path.write_text("\n".join(["COFF", "4 2 0", *rows, "3 0 2 1", "3 0 3 2"]))
    else:
        shaded_square(path)
    seen, x, y = truth(path)
    a, b, c, d = np.array(GREENS) / 255 if ending == "glb" else srgb_to_linear(np.array(GREENS) / 255)
    expected = np.where(x > y, a + (b - a) * x + (c - b) * y, a + (d - a) * y + (c - d) * x)
    np.testing.assert_allclose(seen, expected, atol=2e-6)


def chart(path: Path, ending: str, rows=12, columns=20) -> tuple[Path, np.ndarray]:
    """The square with an image of random greens on its two triangles, upright as the camera sees it."""
    green = np.random.default_rng(5).integers(0, 256, size=(rows, columns))
    pixels = np.stack([255 - green, green, green // 2], axis=-1).astype(np.uint8)
    material = trimesh.visual.material.SimpleMaterial(image=Image.fromarray(pixels), diffuse=(255, 255, 255, 255))
    material.glossiness = 1.0
    visual = trimesh.visual.TextureVisuals(uv=[(0, 1), (1, 1), (1, 0), (0, 0)], material=material)
    square(visual=visual).export(path / f"chart.{ending}")
    return path / f"chart.{ending}", green


def bilinear(image, x, y):
    """The image at x to the right and y down, in [0, 1], between texel centres; it repeats."""
    rows, columns = image.shape
    column, row = x * columns - 0.5, y * rows - 0.5
    left, top = np.floor(column).astype(int), np.floor(row).astype(int)
    across, down = column - left, row - top
    corner = [[image[(top + i) % rows, (left + j) % columns] for j in (0, 1)] for i in (0, 1)]
    upper, lower = (a * (1 - across) + b * across for a, b in corner)
    return upper * (1 - down) + lower * down


@pytest.mark.parametrize("ending", ["obj", "glb"])
def test_an_image_on_two_triangles_shows_its_detail(ending, tmp_path):
    path, green = chart(tmp_path, ending)
    seen, x, y = truth(path)
    np.testing.assert_allclose(seen, bilinear(srgb_to_linear(green / 255), x, y), atol=2e-4)
    if ending == "obj":
        next(tmp_path.glob("*.png")).unlink()
        with pytest.raises(MeshError, match=r"names an image that is missing: 'map_Kd .*png'"):
            build_mesh(scene(targets=[target(path)]))


def test_wavelength_picks_the_channel_and_encoding_and_scale_apply(tmp_path):
    path, green = chart(tmp_path, "glb")
    one = scene(targets=[target(path, colour_encoding="linear", reflectance_scale=0.5, specular=0.5)])
    mesh = build_mesh(one)
    np.testing.assert_allclose(mesh.pattern.corners, 0.5)
    np.testing.assert_allclose(mesh.pattern.images[0], green / 255, atol=1e-7)
    np.testing.assert_allclose(mesh.reflectance, green.mean() / 510, rtol=1e-5)
    for wavelength, values in ((640.0, 255 - green), (450.0, green // 2)):
        mesh = build_mesh(one.with_overrides({"laser.wavelength_nm": wavelength}))
        np.testing.assert_allclose(mesh.pattern.images[0], values / 255, atol=1e-7)


def test_an_obj_file_with_two_materials_and_a_ply_file_with_an_image(tmp_path):
    """Kd is linear and multiplies map_Kd, to more than the 8 bits that a colour has."""
    chart(tmp_path, "obj")[0].unlink()
    image = next(tmp_path.glob("*.png"))
    materials = f"newmtl dark\nKd 0.5 0.0123 0.5\n\nnewmtl picture\nKd 0.5 0.5 0.5\nmap_Kd {image.name}\n"
    (tmp_path / "two.mtl").write_text(materials)
    corners = "v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\n"
    faces = "usemtl dark\nf 1/1 2/2 3/3\nusemtl picture\nf 2/2 3/3 1/1\n"
    (tmp_path / "two.obj").write_text(f"mtllib two.mtl\n{corners}{faces}")
    pattern = build_mesh(scene(targets=[target(tmp_path / "two.obj")])).pattern
    order = np.argsort(pattern.texture)
    np.testing.assert_allclose(pattern.corners[order], [[0.0123] * 3, [0.5] * 3], rtol=1e-6)
    assert pattern.texture[order].tolist() == [-1, 0]
    (tmp_path / "one.ply").write_text(
        f"ply\nformat ascii 1.0\ncomment TextureFile {image.name}\nelement vertex 3\n"
        "property float x\nproperty float y\nproperty float z\nproperty float s\nproperty float t\n"
        "element face 1\nproperty list uchar int vertex_indices\n"
        "end_header\n0 0 0 0.25 0.5\n1 0 0 1 0\n0 1 0 0 1\n3 0 1 2\n"
    )
    of_ply = build_mesh(scene(targets=[target(tmp_path / "one.ply")])).pattern
    np.testing.assert_array_equal(of_ply.images[0], pattern.images[0])
    assert of_ply.coordinates.tolist() == [[[0.25, 0.5], [1, 0], [0, 1]]]


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
def test_glb_colours_are_linear_at_any_depth(dtype, tmp_path):
    """A triangle written by hand: trimesh itself would cut 16 bits to 8."""
    greens = np.array([0.0, 0.2, 1.0])
    top = 1.0 if dtype is np.float32 else np.iinfo(dtype).max
    colours = (np.array([[1.0, green, 0.0, 1.0] for green in greens]) * top).astype(dtype)
    chunks = [np.eye(3, dtype=np.float32).tobytes(), np.arange(3, dtype=np.uint32).tobytes(), colours.tobytes()]
    starts = np.cumsum([0, *map(len, chunks)]).tolist()
    codes = [5126, 5125, {np.uint8: 5121, np.uint16: 5123, np.float32: 5126}[dtype]]
    accessors = zip(codes, ("VEC3", "SCALAR", "VEC4"), strict=True)
    document = {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "COLOR_0": 2}, "indices": 1}]}],
        "buffers": [{"byteLength": starts[-1]}],
        "bufferViews": [{"buffer": 0, "byteOffset": starts[i], "byteLength": len(chunks[i])} for i in range(3)],
        "accessors": [
            {"bufferView": i, "componentType": code, "type": kind, "count": 3, "normalized": i == 2 and top > 1}
            for i, (code, kind) in enumerate(accessors)
        ],
    }
    text = json.dumps(document).encode()
    parts = [(text + b" " * (-len(text) % 4), b"JSON"), (b"".join(chunks), b"BIN\0")]
    body = b"".join(struct.pack("<I", len(part)) + name + part for part, name in parts)
    path = tmp_path / "deep.glb"
    path.write_bytes(b"glTF" + struct.pack("<II", 2, 12 + len(body)) + body)
    mesh = build_mesh(scene(targets=[target(path)]))
    np.testing.assert_allclose(np.sort(mesh.pattern.corners[0]), greens, atol=1 / min(top, 255) ** 2 + 1e-7)


def test_faces_of_one_colour_need_no_pattern(tmp_path):
    path = tmp_path / "faces.ply"
    square(face_colors=[(0, 51, 0, 255), (0, 255, 0, 255)]).export(path)
    mesh = build_mesh(scene(targets=[target(path)]))
    assert mesh.pattern is None
    np.testing.assert_allclose(mesh.reflectance, srgb_to_linear(np.array([0.2, 1.0])), rtol=1e-6)
    off = tmp_path / "faces.off"
    off.write_text("OFF\n4 1 0\n-1 -1 0\n1 -1 0\n1 1 0\n-1 1 0\n4 0 3 2 1 0.0 0.25 1.0\n")
    mesh = build_mesh(scene(targets=[target(off, colour_encoding="linear")]))
    assert mesh.reflectance.tolist() == [0.25, 0.25]


def test_colours_follow_the_mesh_through_subdivision_and_placement(tmp_path):
    """Turned by 90° about z and mirrored in x, in 128 faces: x, y of the square become -y', -x' of the view."""
    path = shaded_square(tmp_path / "square.ply")
    plain = truth(path)[0]
    fields = {"subdivisions": 3, "rotation_deg": [0.0, 0.0, 90.0], "scale": [-1.0, 1.0, 1.0]}
    np.testing.assert_allclose(truth(path, **fields)[0], plain[::-1, ::-1].T, atol=2e-6)


def test_several_targets_keep_their_own_surfaces(tmp_path):
    image, green = chart(tmp_path, "obj")
    small = {"scale": 0.2, "reflectance": "from_file"}
    targets = [
        {"mesh": str(image), "translation": [-0.5, 0.0, 2.0], **small},
        {"builtin": "plane", "size": 0.6, "translation": [0.5, 0.0, 2.0], "reflectance": 0.3, "specular": 0.6},
        {"mesh": shaded_square(tmp_path / "square.ply"), "translation": [0.0, 0.5, 2.0], **small, "roughness": 0.1},
    ]
    one = scene(camera={"width": 64, "height": 64}, targets=targets)
    mesh = build_mesh(one)
    assert mesh.specular.tolist() == pytest.approx([0.0] * 2 + [0.6] * 2 + [0.0] * 2)
    assert mesh.pattern.texture.tolist() == [0, 0, -1, -1, -1, -1]
    seen = spadwarp.truth_maps(one, device="cpu").reflectance
    x, y = np.meshgrid(*[(np.arange(64) + 0.5 - 32) * one.camera.pixel_tangent * 2.0] * 2)
    left, right = ((abs(x - at) < 0.29) & (abs(y) < 0.19) for at in (-0.5, 0.5))
    expected = bilinear(srgb_to_linear(green / 255), (x[left] + 0.8) / 0.6, (y[left] + 0.3) / 0.6)
    np.testing.assert_allclose(seen[left], expected, atol=2e-4)
    assert (seen[right] == np.float32(0.3)).all()
    assert np.isfinite(seen[(abs(x) < 0.19) & (abs(y - 0.5) < 0.29)]).all()


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("plain.ply", None, "neither colours nor materials"),
        ("plain.stl", None, "cannot be combined with .stl; PLY, OBJ, GLB and OFF files can hold colours"),
        ("uv.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nf 1/1 2/2 3/3\n", "coordinates and no image"),
        ("lost.obj", "mtllib lost.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "lost.mtl' is missing"),
        ("noise.off", "OFF\nnothing\n", "not a readable mesh file"),
        ("empty.off", "OFF\n0 0 0\n", "holds no triangles"),
    ],
)
def test_files_without_colours_are_refused_with_what_they_have(name, content, message, tmp_path):
    path = tmp_path / name
    if content is None:
        square().export(path)
    else:
        path.write_text(content)
    with pytest.raises(MeshError, match=r"targets\[0\]") as caught:
        build_mesh(scene(targets=[target(path)]))
    assert str(caught.value).startswith(f"targets[0].mesh = {str(path)!r}: ")
    assert message in str(caught.value)


def test_more_light_than_arrives_is_refused(tmp_path):
    for fields, text in (
        ({"specular": 0.6, "reflectance": 0.5}, "specular = 0.6 and reflectance = 0.5 reflect more than arrives"),
        ({"reflectance": "from_file"}, "reflectance = 'from_file' goes with mesh only"),
        ({"reflectance_scale": 0.5}, "reflectance_scale = 0.5 goes with reflectance = 'from_file' only"),
    ):
        with pytest.raises(ConfigError, match=text):
            scene(targets=[{"builtin": "plane", **fields}])
    path = shaded_square(tmp_path / "white.ply", greens=(255, 0, 0, 0))
    with pytest.raises(MeshError, match=r"reaches 1; times reflectance_scale = 0.9, plus specular = 0.2, that is 1.1"):
        build_mesh(scene(targets=[target(path, reflectance_scale=0.9, specular=0.2)]))


# Transport


def _corner(path) -> list[dict]:
    """A shiny, shaded plate and a wall beside it, so that light goes from one to the other."""
    plate = target(path, reflectance_scale=0.8, specular=0.4, roughness=0.3)
    wall = {"builtin": "plane", "size": [1.5, 3.0], "rotation_deg": [0.0, 90.0, 0.0], "translation": [1.0, 0.0, 1.5]}
    return [plate, {**wall, "reflectance": 0.2, "specular": 0.7, "roughness": 0.15}]


@pytest.fixture
def hidden(tmp_path):
    """Out of view, shiny and shaded: scenes with it share one kernel."""
    path = shaded_square(tmp_path / "hidden.ply")
    return target(path, specular=0.1, translation=[0.0, 0.0, -40.0])


@pytest.mark.slow
def test_estimators_agree_on_shiny_and_shaded_surfaces(device, tmp_path):
    targets = _corner(shaded_square(tmp_path / "square.ply", greens=(40, 120, 180, 200)))
    agreeing_cells(scene(targets=targets), device, photons={"analog": 40_000, "guided": 20_000})


@pytest.mark.slow
@pytest.mark.parametrize(("alpha", "aside"), [(0.25, 0.3), (0.05, 0.42)])
def test_ballistic_return_of_a_shiny_plate_meets_the_closed_form(alpha, aside, hidden, device):
    """A pencil beam from the side onto a tilted plate: (R/pi + s D G/(4 cos cos)) cos A/r^2 exp(-c path) to 1 %; a
    glossy one shines where its facets face half-way."""
    point, laser = np.array([0.0, 0.0, 2.0]), np.array([-0.8, aside, 0.2])
    s, reflectance = 0.6, 0.3
    one = scene(
        laser={"profile": "collimated", "position": laser.tolist(), "direction": (point - laser).tolist()},
        camera={"aperture_diameter": 0.01, "width": 3, "height": 3},
        gate={"bin_width_ps": 200.0, "bins": 200},
        targets=[
            {"builtin": "plane", "size": [3.0, 3.0], "rotation_deg": [5.0, 12.0, 0.0], "translation": point.tolist()}
            | {"reflectance": reflectance, "specular": s, "roughness": alpha, "subdivisions": 0},
            hidden,
        ],
    )
    result = simulate(one, photons=400_000, seed=3, device=device)
    a, b = np.radians(5.0), np.radians(12.0)
    normal = -np.array([np.sin(b), -np.sin(a) * np.cos(b), np.cos(a) * np.cos(b)])  # -Rx Ry z, towards the lens
    w, v = (laser - point) / np.linalg.norm(laser - point), -point / 2.0
    h = (w + v) / np.linalg.norm(w + v)
    tangent2 = {name: 1 / (normal @ d) ** 2 - 1 for name, d in (("h", h), ("w", w), ("v", v))}
    facets = 1 / (np.pi * alpha**2 * (normal @ h) ** 4 * (1 + tangent2["h"] / alpha**2) ** 2)
    masks = sum((np.sqrt(1 + alpha**2 * tangent2[name]) - 1) / 2 for name in "wv")
    lobe = facets / (1 + masks) / (4 * (normal @ w) * (normal @ v))
    path = np.linalg.norm(laser - point) + 2.0
    area = math.pi * 0.005**2
    expected = (reflectance / np.pi + s * lobe) * (normal @ v) * area / 2.0**2 * math.exp(-0.5 * path)
    assert s * lobe > reflectance / np.pi  # the lobe is what is tested
    assert result.component("ballistic").sum() == pytest.approx(expected, rel=0.01)


@pytest.mark.slow
def test_an_image_shows_in_the_picture(hidden, tmp_path):
    path, _ = chart(tmp_path, "glb", rows=4, columns=4)
    one = scene(
        medium={"extinction": 0.01, "albedo": 0.5},
        laser={"position": [0.0, 0.0, 0.0], "half_angle_deg": 35.0},
        camera={"width": 24, "height": 24, "aperture_diameter": 0.02},
        targets=[target(path), hidden],
    )
    result = simulate(one, photons=400_000, seed=1, device="cpu")
    x = (np.arange(24) + 0.5 - 12) * one.camera.pixel_tangent
    cosine = 1 / np.sqrt(1 + x**2 + x[:, None] ** 2)
    # An even cone on a plate: cos^3 of the lighting, cos^4 of the view (lens, square of the distance, plate).
    image = result.component("ballistic").sum(axis=2) / cosine**7
    assert np.corrcoef(image.ravel(), result.truth.reflectance.ravel())[0, 1] > 0.9


def test_rays_along_faces_meet_nothing_beyond_the_mesh():
    corners = np.random.default_rng(1).uniform(-0.5, 0.5, (2000, 3, 3)) * [1.0, 1e-7, 1.0] + [0.0, 0.0, 5.0]
    x = np.linspace(-0.15, 0.15, 3001)
    rays = np.stack([x, np.zeros_like(x), np.sqrt(1.0 - x**2)], axis=-1)
    distance = first_hits(corners, np.zeros(3), rays, pick_device("cpu"))
    assert np.isfinite(distance).any() and np.nanmax(distance) <= np.linalg.norm(corners, axis=-1).max()
