"""Scenes that move: a frame at each row of a trajectory is a run of its own, and the file says where all stood."""

import importlib.util
import itertools

import numpy as np
import pytest
from PIL import Image

import spadwarp
from helpers.cli import run
from helpers.synthetic_result import make_scene
from spadwarp.frames import simulate_sequence
from spadwarp.scene import Trajectory, load_trajectory
from spadwarp.scene.pose import rotation_matrix
from spadwarp.values import ArgumentError, ConfigError

TABLE = """# a camera that comes nearer, a target that moves to the side
time,camera.position[2],camera.rotation_deg[1],targets[0].translation[0],laser.position[0]
0.0, 0.0, 0.0, 0.0, 0.1
0.1, 0.2, -1.0, 0.3, 0.1
0.3, 0.4, -2.0, 0.6, 0.2
"""


@pytest.fixture(scope="module")
def base():
    return make_scene(width=8, height=6, bins=32)


@pytest.fixture(scope="module")
def poses(tmp_path_factory):
    path = tmp_path_factory.mktemp("poses") / "poses.csv"
    path.write_text(TABLE)
    return path


@pytest.fixture(scope="module")
def moving(base, poses):
    options = {"photons": 4000, "pulses": 2000, "seed": 5, "tags": True, "device": "cpu"}
    return simulate_sequence(base, poses, poses.parent / "sequence.h5", **options)


def test_a_refitted_mesh_gives_the_bits_of_one_that_is_built(base, poses, device):
    mesh_cache = {}
    for scene in load_trajectory(poses).scenes(base):
        one = spadwarp.simulate(scene, photons=3000, seed=3, device=device, mesh_cache=mesh_cache)
        other = spadwarp.simulate(scene, photons=3000, seed=3, device=device)
        assert one.tallies.any() and np.array_equal(one.tallies, other.tallies)
        assert np.array_equal(one.truth.depth, other.truth.depth, equal_nan=True)
    assert len(mesh_cache) == 1


def test_frames_have_the_truth_of_the_scene_at_their_time(base, moving, poses):
    trajectory, loaded = load_trajectory(poses), spadwarp.load(moving.path)
    assert loaded.frames == 3 and loaded.trajectory.fields == trajectory.fields
    for number in range(3):
        scene = trajectory.scene(base, number)
        assert loaded.scene(number) == scene
        truth = spadwarp.truth_maps(scene, device="cpu")
        for name in ("depth", "normal"):
            np.testing.assert_array_equal(getattr(loaded.truth(number), name), getattr(truth, name))
        assert loaded.depth("matched", number).shape == (6, 8) and loaded.counts(number).sum() > 0
    assert scene.camera.position[2] == 0.4 and scene.targets[0].translation[0] == 0.6
    with pytest.raises(ArgumentError, match=r"frame = 3 is outside \[0, 3\)"):
        loaded.counts(3)


def test_tags_poses_and_labels_of_the_file(moving):
    import h5py

    with h5py.File(moving.path) as file:
        counts = np.zeros(file["counts"].shape, int)
        np.add.at(counts, tuple(file[f"tags/{name}"][:] for name in ("frame", "y", "x", "bin")), 1)
        np.testing.assert_array_equal(counts, file["counts"])
        np.testing.assert_array_equal(file["frame_time"], [0.0, 0.1, 0.3])
        np.testing.assert_allclose(file["camera_rotation"][2], rotation_matrix((0, -2, 0)))
        np.testing.assert_allclose(file["camera_position"][:, 2], [0.0, 0.2, 0.4])
    pytest.importorskip("h5netcdf")
    with pytest.importorskip("xarray").open_dataset(moving.path, engine="h5netcdf") as data:
        assert data.counts.dims == ("frame", "y", "x", "time")
        assert data.trajectory.sel(field="targets[0].translation[0]").values.tolist() == [0.0, 0.3, 0.6]


def test_frames_in_between_turn_the_shortest_way(base):
    fields = ("camera.position[0]", *(f"camera.rotation_deg[{axis}]" for axis in range(3)))
    values = np.array([[0, 0, 0, 0], [1, 0, 90, 0], [1, 0, 90, 90]], float)
    sampled = Trajectory(times=np.array([0.0, 1.0, 2.0]), fields=fields, values=values).sampled(4)
    assert len(sampled) == 9 and sampled.times[-1] == 2.0
    np.testing.assert_allclose(sampled.values[:5, 0], np.arange(5) / 4)
    np.testing.assert_allclose(sampled.values[:5, 2], 22.5 * np.arange(5), atol=1e-9)
    matrices = [rotation_matrix(angles) for angles in sampled.values[:, 1:]]
    turns = [np.degrees(np.arccos((np.trace(a.T @ b) - 1) / 2)) for a, b in itertools.pairwise(matrices)]
    np.testing.assert_allclose(turns, 22.5, atol=1e-6)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("tme,camera.position[2]\n0,0\n", "line 1: 'tme,camera.position[2]' is not time and names of fields, such"),
        ("time,camera.position[2]\n0,0\n1,x\n", "line 3: camera.position[2] = 'x' is not a number"),
        ("time,camera.position[2]\n1,0\n0,1\n", "line 3: time = 0 is not after 1"),
        ("time,camera.position[0]\n0,0,1\n", "line 2: 3 values for 2 names"),
        ("time,camera.position[0]\n0,nan\n", "camera.position[0]"),
        ("time,camera.position[0],camera.position[0]\n0,0,0\n", "is there twice"),
        ("time,camera.position[0]\n", "no row of numbers"),
        ("time,camera.speed\n0,1\n", "row 1, time 0 s: camera.speed"),
        ("time,gate.start_ns\n0,1\n", "gate.start_ns cannot change from frame to frame"),
        ("time,targets[3].translation[0]\n0,1\n", "row 1, time 0 s"),
    ],
)
def test_what_is_no_trajectory_is_named_before_the_first_photon(base, text, words, tmp_path):
    (tmp_path / "poses.csv").write_text(text)
    with pytest.raises(ConfigError) as caught:
        simulate_sequence(base, tmp_path / "poses.csv", tmp_path / "out.h5", photons=10, device="cpu")
    assert words in str(caught.value) and "poses.csv" in str(caught.value)
    assert not (tmp_path / "out.h5").exists()


def test_command_and_exports(base, poses, tmp_path):
    (tmp_path / "scene.toml").write_text(base.to_toml())
    options = ("--photons", 2000, "--set", "detector.pulses_per_frame=500", "--device", "cpu", "--out")
    options += (tmp_path / "moving",)
    printed = run("simulate", tmp_path / "scene.toml", "--trajectory", poses, "--frame-rate", 10, *options).output
    assert "0, 0.3 s" in printed and "camera.position[2]" in printed
    with Image.open(tmp_path / "moving" / "sequence.gif") as picture:
        assert picture.n_frames == 4
    assert "is not empty" in run("simulate", tmp_path / "scene.toml", "--trajectory", poses, *options, code=2).output
    run("export", tmp_path / "moving", "--format", "npy", "--out", tmp_path / "exported")
    held = spadwarp.load(tmp_path / "moving")
    exported = np.load(tmp_path / "exported" / "sequence.npy")
    assert exported.shape[0] == 4 and np.array_equal(exported[3], held.counts(3))
    run("depth", tmp_path / "moving", "--out", tmp_path / "depth", "--quiet", "--device", "cpu")
    np.testing.assert_array_equal(np.load(tmp_path / "depth" / "depth.npy")[2], held.depth("matched", 2))
    if importlib.util.find_spec("plotly"):
        assert "scene that moves" in run("view", tmp_path / "moving", "--out", tmp_path / "a.html", code=2).output
    assert "needs --trajectory" in run("simulate", tmp_path / "scene.toml", "--tags", code=2).output
    assert "moving" in run("info", tmp_path / "moving").output
