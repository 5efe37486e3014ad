"""Files that a scene names are part of it: photons before and after a change of their content are never added up."""

import numpy as np
import pytest
import trimesh

import spadwarp
from helpers.datasets import make, recipe
from helpers.scenes import scene
from spadwarp.values import ConfigError, FileError

ANGLES = np.linspace(0.0, 180.0, 361)


def write_phase_table(path, g):
    cosine = np.cos(np.radians(ANGLES))
    density = (1.0 - g * g) / (1.0 + g * g - 2.0 * g * cosine) ** 1.5
    rows = np.column_stack([ANGLES, density])
    np.savetxt(path, rows, delimiter=",", header="angle_deg,phase_function", comments="", fmt="%.9g")


def write_profile(path, radius):
    image = np.zeros((8, 8))
    image[4 - radius : 4 + radius, 4 - radius : 4 + radius] = 1.0
    np.save(path, image)


def write_mesh(path, width):
    trimesh.creation.box((width, 2.0, 0.2)).export(path)


CASES = {
    "phase table": (
        "phase.csv",
        write_phase_table,
        (0.9, 0.5),
        {"medium": {"phase_function": "tabulated"}},
        "medium.phase_table",
    ),
    "beam": (
        "beam.npy",
        write_profile,
        (2, 3),
        {"laser": {"profile": "measured", "half_angle_deg": 20.0}},
        "laser.profile_image",
    ),
    "mesh": ("box.stl", write_mesh, (2.0, 2.0001), {"targets": [{"translation": [0.0, 0.0, 2.0]}]}, "targets.0.mesh"),
}


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_a_changed_file_is_named_by_resume_and_merge(tmp_path, case):
    name, write, (before, after), sections, key = CASES[case]
    path = tmp_path / name
    write(path, before)
    part, *fields = key.split(".")
    if part == "targets":
        sections = {"targets": [{**sections["targets"][0], "mesh": str(path)}]}
    else:
        sections = {part: {**sections[part], fields[0]: str(path)}}
    whole = scene(**sections)
    first = spadwarp.simulate(whole, photons=2000, device="cpu")
    first.save(tmp_path / "result.h5")
    kept = spadwarp.load(tmp_path / "result.h5")
    assert kept.file_hashes == first.file_hashes and len(kept.file_hashes) == len(whole.files) == 1
    longer = spadwarp.simulate(whole, photons=4000, device="cpu", run=spadwarp.RunOptions(resume=kept))
    assert longer.photons == 4000

    write(path, after)
    with pytest.raises(ConfigError, match=f"{name} is another file than it was"):
        spadwarp.simulate(whole, photons=4000, device="cpu", run=spadwarp.RunOptions(resume=kept))
    second = spadwarp.simulate(whole, photons=2000, device="cpu", run=spadwarp.RunOptions(first_photon=2000))
    with pytest.raises(ConfigError, match=f"{name} is another file than it was"):
        spadwarp.merge([kept, second])


def test_a_changed_mesh_of_a_dataset_is_named(tmp_path):
    """Also one that its recipe names by its folder."""
    meshes = tmp_path / "meshes"
    meshes.mkdir()
    write_mesh(meshes / "box.stl", 1.0)
    small = recipe(
        **{"frames.per_scene": 1, "targets": {"builtin": [], "meshes": [str(meshes)], "validation": [], "test": []}}
    )
    make(small, tmp_path / "data", part=(2, 2))
    write_mesh(meshes / "box.stl", 1.1)
    with pytest.raises(FileError, match=r"box\.stl is another file than it was"):
        make(small, tmp_path / "data")
