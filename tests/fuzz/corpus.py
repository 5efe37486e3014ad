"""Valid files of every kind, small, made by spadwarp itself and by the libraries that others use."""

import dataclasses
import json
from pathlib import Path

import h5py
import numpy as np
import ptufile
import scipy.io
import scipy.sparse
import trimesh
from PIL import Image

import spadwarp
from helpers.datasets import recipe
from spadwarp.frames import record_frames
from spadwarp.io.arrays import write_exr
from spadwarp.transport import save_records, trace

SCENE = b"""[medium]
extinction = 0.5            # 1/m
albedo = 0.8
anisotropy = 0.9
group_index = "seawater"
[laser]
half_angle_deg = 20.0
position = [-0.05, 0.0, 0.0]
pulse_energy = 1e-14
repetition_rate = 1e7
[camera]
width = 10
height = 8
horizontal_fov_deg = 20.0
aperture_diameter = 0.02
[gate]
start_ns = 16.0
bin_width_ps = 200.0
bins = 30
[detector]
dark_count_rate = 1e3
pulses_per_frame = 500
[[targets]]
builtin = "plane"
size = [1.5, 1.5]
translation = [0.0, 0.0, 2.0]
reflectance = 0.5
[transport]
photons = 2000
seed = 3
[output]
png = false
"""
GRID = SCENE + b'[medium.grid]\nfile = "cells.npz"\ntranslation = [0.0, 0.0, 1.0]\n'


def _with(**sections: str) -> bytes:
    """The scene with more lines in some of its sections."""
    text = SCENE.decode()
    for name, lines in sections.items():
        text = text.replace(f"[{name}]\n", f"[{name}]\n{lines}\n")
    return text.encode()


# Scenes with a feature of its own each: cells of water, glass before the lens, walls that reflect, polarised light.
WALLS = (
    'shape = "box"\nlower = [-1.0, -1.0, -0.5]\nupper = [1.0, 1.0, 3.0]\noutside_index = {y_low = 1.0, x_high = 1.2}'
)
SPECIAL = {
    "grid.toml": GRID,
    "port.toml": _with(
        medium='phase_index = "seawater"',
        laser='port = "camera"',
        camera='port = {distance = 0.05, thickness = 0.01, material = "BK7"}',
    ),
    "walls.toml": SCENE + f"[domain]\n{WALLS}\n".encode(),
    "polarised.toml": _with(
        medium='scattering_matrix = "scaled_rayleigh"',
        laser='polarisation = "linear"',
        camera='polarisation = "stokes"',
        transport="axis_threshold = 1.0",
    ).replace(b"anisotropy = 0.9\n", b""),
}

CALIBRATED = b"""medium = {extinction = 0.5, albedo = 0.8, phase_function = "tabulated", phase_table = "phase.csv"}
laser = {profile = "measured", profile_image = "beam.npy", half_angle_deg = 10}
camera = {calibration = "camera.yaml", aperture_diameter = 0.02}
gate = {bin_width_ps = 200.0, bins = 30}
detector = {irf = "irf.csv"}
[[targets]]
mesh = "target.obj"
translation = [0, 0, 2.0]
reflectance = "from_file"
[transport]
photons = 500
"""

CAMERA = b"""%YAML:1.0
---
image_width: 10
image_height: 8
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 17.0, 0.0, 3.0, 0.0, 17.0, 2.0, 0.0, 0.0, 1.0 ]
distortion_coefficients: !!opencv-matrix {rows: 1, cols: 5, dt: d, data: [-0.01, 0.001, 0.0, 0.0, 0.0]}
"""

CAMERA_XML = b"""<?xml version="1.0"?><opencv_storage><image_width>10</image_width><image_height>8</image_height>
<camera_matrix type_id="opencv-matrix">
  <rows>3</rows><cols>3</cols><dt>d</dt><data>17. 0. 3. 0. 17. 2. 0. 0. 1.</data></camera_matrix>
<distortion_coefficients type_id="opencv-matrix">
  <rows>1</rows><cols>5</cols><dt>d</dt><data>-0.01 0.001 0. 0. 0.</data></distortion_coefficients></opencv_storage>
"""

TRAINING = b"""model = "usdn"
seed = 4
noise = {backscatter = [0.0, 0.5], photons = [1.0, 300.0]}
[optimiser]
steps = 6
batch = 2
crop = 32
scenes = 4
learning_rate = 1e-3
report_every = 3
"""

PHASE = b"# angle, value\nangle_deg,value\n0.1,1000\n1,100\n10,5\n60,0.3\n120,0.1\n180,0.12\n"
IRF = b"time_ps,value\n-200,0\n-100,1\n0,4\n100,2\n300,0\n"
COUNTS = np.random.default_rng(1).poisson(1.0, (8, 10, 30)).astype(np.uint16)


def make_corpus(folder: Path) -> None:
    """Writes all files."""
    matrix = [[17.0, 0.0, 3.0], [0.0, 17.0, 2.0], [0.0, 0.0, 1.0]]
    camera = {"image_width": 10, "image_height": 8, "camera_matrix": matrix, "distortion_coefficients": [-0.01] * 5}
    for name, content in {
        **SPECIAL, "scene.toml": SCENE, "calibrated.toml": CALIBRATED, "training.toml": TRAINING,
        "camera.yaml": CAMERA, "camera.xml": CAMERA_XML, "camera.json": json.dumps(camera).encode(),
        "phase.csv": PHASE, "irf.csv": IRF, "recipe.toml": recipe().to_toml().encode(),
    }.items():  # fmt: skip
        (folder / name).write_bytes(content)
    # Meshes.
    box = trimesh.creation.box((1.0, 1.0, 0.2))
    box.visual.face_colors = np.arange(48, dtype=np.uint8).reshape(12, 4)
    for ending in ("stl", "ply", "off", "glb"):
        box.export(folder / f"box.{ending}")
    (folder / "box.ascii.stl").write_text(trimesh.exchange.stl.export_stl_ascii(box))
    (folder / "target.mtl").write_text("newmtl one\nKd 0.5 0.4 0.3\nmap_Kd target.png\n")
    (folder / "target.obj").write_text(
        "mtllib target.mtl\nv -1 -1 0\nv 1 -1 0\nv 1 1 0\nv -1 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\nvn 0 0 -1\n"
        "usemtl one\nf 1/1/1 2/2/1 3/3/1\nf 1/1/1 3/3/1 4/4/1\n"
    )
    Image.fromarray(np.arange(48, dtype=np.uint8).reshape(4, 4, 3)).save(folder / "target.png")
    # HDF5 of every kind, and a dataset.
    scene = spadwarp.load_scene(folder / "scene.toml")
    result = spadwarp.simulate(scene, photons=2000, seed=3, device="cpu")
    result.save(folder / "result.h5")
    record_frames(result, folder / "frames.h5", pulses=300, frames=2, seed=1, tags=True, device="cpu")
    spadwarp.simulate_analytic(scene, frames=2, seed=1, device="cpu").save(folder / "analytic.h5")
    save_records(trace(scene, photons=20, device="cpu"), folder / "records.h5", scene=scene)
    small = recipe(**{"scenes_per_target": 1, "frames.per_scene": 2, "gate.bins": 32})
    spadwarp.dataset.make_dataset(small, folder / "data", device="cpu")
    # Arrays and histograms of others.
    np.save(folder / "counts.npy", COUNTS)
    np.savez(folder / "counts.npz", counts=COUNTS, bin_width=2e-10)
    np.save(folder / "zero.npy", 0 * COUNTS)
    np.save(folder / "many.npy", np.full(COUNTS.shape, 2**62))
    np.save(folder / "gate.npy", COUNTS[..., :17])
    cells = {"density": np.linspace(0.0, 2.0, 60).reshape(3, 4, 5), "cell_size": np.full(3, 0.1)}
    np.savez(folder / "cells.npz", **cells)
    with h5py.File(folder / "cells.h5", "w") as file:
        for name, values in cells.items():
            file[name] = values
    np.save(folder / "beam.npy", np.outer([1.0, 3.0, 2.0], [1.0, 4.0, 5.0, 1.0]))
    np.save(folder / "response.npy", np.array([1.0, 4.0, 2.0]))
    np.save(folder / "depth.npy", np.linspace(1.0, 2.0, 192, dtype=np.float32).reshape(12, 16))
    tags = np.empty((8, 10), object)
    for index in np.ndindex(tags.shape):
        tags[index] = np.repeat(np.arange(30), COUNTS[index])[:, None]
    sparse = scipy.sparse.csc_array(COUNTS.transpose(1, 0, 2).reshape(80, 30).astype(float))
    scipy.io.savemat(folder / "counts.mat", {"counts": COUNTS.astype(float), "bin_size": 2e-10})
    scipy.io.savemat(folder / "packed.mat", {"counts": COUNTS}, do_compression=True)
    scipy.io.savemat(folder / "tags.mat", {"Ts": tags})
    scipy.io.savemat(folder / "sparse.mat", {"spad": sparse, "depth": np.ones((8, 10))})
    options = {"global_resolution": 50e-9, "tcspc_resolution": 2e-10}
    ptufile.imwrite(folder / "counts.ptu", COUNTS, **options)
    depth = np.full((8, 10), 2.0, np.float32)
    write_exr(folder / "depth.exr", {"Z": depth, "A": depth, "Y": 0.2 * depth}, {"content": "test"})
    weights = Path(spadwarp.__file__).parent / "denoise" / "weights" / "usdn.safetensors"
    (folder / "usdn.safetensors").write_bytes(weights.read_bytes())


@dataclasses.dataclass(frozen=True)
class Corpus:
    """The folder, and its files read as they are asked for."""

    folder: Path

    def __getitem__(self, name: str) -> bytes:
        return (self.folder / name).read_bytes()
