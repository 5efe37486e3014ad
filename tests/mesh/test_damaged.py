"""Mesh files that somebody has changed: an error that names the file, whether their colours count or not."""

import io
import json
import struct

import numpy as np
import pytest
import trimesh
from PIL import Image

from spadwarp.mesh import load_target
from spadwarp.scene import Target
from spadwarp.values import MeshError

TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\n"
PLY = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n{}"
FACES = "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
TEXTS = [
    ("index.obj", TRIANGLE + "f 1 2 30\n", ""),
    ("index.off", "COFF\n3 1 0\n0 0 0 1 1 1\n1 0 0 1 1 1\n0 1 0 1 1 1\n3 0 1 20\n", "face"),
    ("index.ply", PLY.format(FACES) + "0 0 0\n1 0 0\n0 1 0\n3 0 1 20\n", ""),
    ("flat.obj", "v 0 0\nv 1 0\nv 0 1\nf 1 2 3\n", ""),
    *((f"{value}.obj", f"v 0 0 {value}\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "") for value in ("nan", "inf")),
]


def refused(path, words=""):
    for reflectance in (0.5, "from_file"):
        with pytest.raises(MeshError) as caught:
            load_target(Target(mesh=str(path), reflectance=reflectance))
        assert path.name in str(caught.value) and words in str(caught.value), caught.value


def coloured(folder, material, coordinates="0 0", lines="mtllib box.mtl", image=None):
    """The target of a triangle with such a material, and an image beside it."""
    text = f"{lines}\n{TRIANGLE}vt {coordinates}\nvt 1 0\nvt 0 1\nusemtl one\nf 1/1 2/2 3/3\n"
    (folder / "box.obj").write_text(text)
    (folder / "box.mtl").write_text(f"newmtl one\n{material}\n")
    if image is not None:
        (folder / "box.png").write_bytes(image)
    return Target(mesh=str(folder / "box.obj"), reflectance="from_file")


@pytest.mark.parametrize(("name", "text", "words"), TEXTS)
def test_text_with_wrong_numbers(name, text, words, tmp_path):
    (tmp_path / name).write_text(text)
    refused(tmp_path / name, words)


COLOURS = ["0.4 0.3", "0.4 0.3 0.2 0.1 0", "spectral file.rfl", "0.4 x 0.3", "1e999 0 0", "", "0", "0.5"]


def png(values):
    stream = io.BytesIO()
    Image.fromarray(values).save(stream, "png")
    return stream.getvalue()


PIXELS = np.random.default_rng(1).integers(255, size=(64, 64, 3), dtype="u1")
IMAGE = {"material": "map_Kd box.png", "image": png(PIXELS)}


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        *(({"material": "Kd 0.4 0.4 0.4", "lines": line}, "mtllib stands without") for line in ("mtllib", "mtllib   ")),
        # trimesh passes over such an image, and would leave the material's plain colour.
        ({"material": "Kd 0.4 0.4 0.4\nmap_Kd box.png", "image": b"\x89PNG and no more"}, r"box\.png.*no image"),
        *((IMAGE | {"coordinates": wrong}, "texture coordinates") for wrong in ("0", "nan 0", "0 inf")),
        # Pillow opens it and fails when the pixels are read.
        (IMAGE | {"image": IMAGE["image"][: len(IMAGE["image"]) // 2]}, r"box\.obj"),
        *(({"material": f"Kd {colour}"}, r"box\.obj.*(red, green and blue|colour component)") for colour in COLOURS),
    ],
)
def test_materials_and_images_that_are_none(changes, words, tmp_path, capfd):
    with pytest.raises(MeshError, match=words):
        load_target(coloured(tmp_path, **changes))
    assert "Traceback" not in capfd.readouterr().err  # of trimesh


def test_texture_coordinates_may_be_three(tmp_path):
    assert load_target(coloured(tmp_path, coordinates="0 0 0", **IMAGE))


@pytest.fixture
def glb():
    """Bytes of a textured box, and its header as a table with where the numbers begin."""
    box = trimesh.creation.box()
    image = Image.fromarray(np.full((4, 4, 3), 128, np.uint8))
    material = trimesh.visual.material.PBRMaterial(baseColorTexture=image)
    visual = trimesh.visual.TextureVisuals(uv=np.zeros((8, 2)), material=material)
    content = trimesh.Trimesh(box.vertices, box.faces, visual=visual, process=False).export(file_type="glb")
    (length,) = struct.unpack_from("<I", content, 12)
    return content, json.loads(content[20 : 20 + length]), 20 + length + 8


def packed(header, numbers):
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 4)
    size = 12 + 8 + len(text) + 8 + len(numbers)
    head = struct.pack("<4sIIII", b"glTF", 2, size, len(text), 0x4E4F534A)
    return head + text + struct.pack("<II", len(numbers), 0x004E4942) + numbers


def test_an_index_out_of_range_in_glb(glb, tmp_path):
    content, header, begin = glb
    place = begin + header["bufferViews"][header["accessors"][0]["bufferView"]].get("byteOffset", 0)
    for index in (8, 10**6, 2**32 - 1):
        changed = bytearray(content)
        struct.pack_into("<I", changed, place, index)
        (tmp_path / "box.glb").write_bytes(changed)
        refused(tmp_path / "box.glb", "does not exist")


@pytest.mark.parametrize("count", [10**10, -1, 2**31])
def test_numbers_that_a_glb_declares_and_does_not_have(glb, tmp_path, count):
    """Without a buffer, memory is taken for so many zeros."""
    content, header, begin = glb
    header["accessors"][0]["count"] = count
    del header["accessors"][0]["bufferView"]
    (tmp_path / "box.glb").write_bytes(packed(header, content[begin:]))
    refused(tmp_path / "box.glb", "declares")


@pytest.mark.parametrize("damage", ["cut", "middle", "start"])
def test_a_broken_image_in_glb(glb, tmp_path, damage):
    content = bytearray(glb[0])
    place = content.index(b"\x89PNG")
    begin = place if damage == "start" else place + 30
    content[begin : place + 50] = b"x" * (place + 50 - begin)
    (tmp_path / "box.glb").write_bytes(content[: place + 40] if damage == "cut" else content)
    with pytest.raises(MeshError, match=r"box\.glb"):
        load_target(Target(mesh=str(tmp_path / "box.glb"), reflectance="from_file"))
