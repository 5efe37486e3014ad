"""Files of every kind that somebody has changed, or that were cut: an error that names file and dataset, nothing read
from elsewhere, no array made that the scene does not have. Random damage: `tests/fuzz`."""

import shutil

import h5py
import numpy as np
import pytest

import spadwarp
from helpers import hostile
from helpers.datasets import make, recipe
from helpers.synthetic_result import make_result, make_scene
from spadwarp.dataset import FIELDS, FrameReader
from spadwarp.files import open_source
from spadwarp.frames import FramesFile, record_frames
from spadwarp.transport import load_records, save_records, trace
from spadwarp.values import FileError

SMALL = {
    **{"targets.builtin": ["staircase"], "targets.validation": [], "frames.per_scene": 2, "scenes_per_target": 1},
    **{"gate.bins": 32, "scene.camera.width": 12, "scene.camera.height": 8, "scene.camera.polarisation": "analyser"},
    **{"scene.laser.polarisation": "linear", "scene.transport.axis_threshold": 1.0},
    **{"scene.medium.scattering_matrix": "scaled_rayleigh", "monte_carlo.share": 1.0, "monte_carlo.photons": 10_000},
}


def read_frames(path):
    file = FramesFile.load(path)
    file.counts(), file.intensity(), [file.depth(method) for method in file.methods]


def read_dataset(path):
    folder = path.parent.parent if path.parent.name == "scenes" else path.parent
    reader = FrameReader(folder, "all", fields=FIELDS)
    reader[0], reader.scene(0), reader.scene_numbers("signal"), reader.scene_numbers("pulses")


READERS = {
    "result.h5": spadwarp.load,
    "frames.h5": read_frames,
    "analytic.h5": lambda path: open_source(path).frame(0),
    "records.h5": load_records,
    "data/frames-00000.h5": read_dataset,
    "data/histograms-00000.h5": read_dataset,
    "data/scenes/scenes-00000.h5": read_dataset,
}
# Written for people and other programs.
NOT_READ = {
    "result.h5": {"bin_edges"},
    "frames.h5": {"bound/time", "bound/depth"},
    "analytic.h5": {"maps/", "truth/normal", "truth/range", "truth/reflectance"},
    "records.h5": {"config"},
    "data/frames-00000.h5": {"seed", "pulses"},
    "data/histograms-00000.h5": {"gate_start", "bin_width"},
}
SCENE_COLUMNS = {"depth", "bound", "normal", "reflectance", "backscatter_profile", "profile_edges"}
SCENE_COLUMNS |= {"gate_near", "gate_far", "config", "signal", "pulses", "distance"}


@pytest.fixture(scope="module")
def valid(tmp_path_factory):
    """A folder with a valid file of every kind."""
    folder = tmp_path_factory.mktemp("valid")
    scene = make_scene(width=6, height=4, bins=16)
    batches = {"second_moment": np.ones((2, 4, 6, 16), np.uint64), "batch_size": 10**8, "batches": 8}
    result = make_result(scene)
    spadwarp.result.save_result(type(result)(**{**vars(result), **batches}), folder / "result.h5")
    record_frames(result, folder / "frames.h5", pulses=1000, frames=2, seed=1, tags=True, device="cpu")
    spadwarp.simulate_analytic(scene, frames=2, seed=1, device="cpu").save(folder / "analytic.h5")
    water = scene.with_overrides({"targets": []})
    save_records(trace(water, photons=100, seed=1, device="cpu"), folder / "records.h5", scene=water)
    make(recipe(**SMALL), folder / "data")
    for name, read in READERS.items():
        read(folder / name)
    return folder


@pytest.fixture
def copy(valid, tmp_path):
    """A copy of the valid files that a test may change."""
    shutil.copytree(valid, tmp_path / "files")
    (tmp_path / "other.h5").write_bytes(hostile.SECRET)
    return tmp_path / "files"


def renew(source, path):
    """A new file: readers may still have the old one open."""
    path.unlink()
    shutil.copy(source, path)


def read_names(name, path):
    found = hostile.datasets(path)
    if name.startswith("data/scenes"):
        return [one for one in found if one in SCENE_COLUMNS]
    skipped = tuple(NOT_READ.get(name, ()))
    with h5py.File(path) as file:  # coordinates of the dimensions are for others; `edges` are ours, too
        found = [one for one in found if one == "edges" or not file[one].is_scale]
    return [one for one in found if not one.startswith((*skipped, "tags/"))]


# Every way with a result; one of each kind with the others, which the same code reads.
CASES = [("result.h5", way) for way in hostile.WAYS]
OTHERS = (hostile.external_storage, hostile.other_shape, hostile.missing)
CASES += [(name, way) for name in READERS for way in OTHERS[1:] if name != "result.h5"]
CASES += [pytest.param(name, OTHERS[0], marks=pytest.mark.slow) for name in READERS if name != "result.h5"]


@pytest.mark.parametrize(("name", "way"), CASES, ids=lambda case: getattr(case, "__name__", case))
def test_a_dataset_that_is_not_as_it_should_be_is_refused_by_name(name, way, valid, copy, tmp_path):
    path = copy / name
    # Optional ones may be missing.
    optional = {"expected", "background", "counts", "event_index", "event_start", "event_count"}
    optional |= {f"depth/{method}" for method in spadwarp.frames.METHODS}
    for dataset in read_names(name, path):
        if way is hostile.missing and dataset in optional:
            continue
        renew(valid / name, path)
        with h5py.File(path, "r+") as file:
            way(file, dataset, tmp_path / "other.h5")
        with pytest.raises(FileError) as caught:
            READERS[name](path)
        assert str(path) in str(caught.value) and dataset.split("/")[-1] in str(caught.value), (dataset, caught.value)


ODD = (np.nan, "text", np.zeros(3), np.zeros((0,)), h5py.Empty("f"), -(2**62))
WRONG = (("format", 3), ("format_version", "new"), ("format_version", 1e300))


@pytest.mark.parametrize("name", READERS)
def test_an_attribute_that_is_not_as_it_should_be_is_refused(name, valid, copy):
    """The odd values in turn."""
    path = copy / name
    with h5py.File(path) as file:
        attributes = list(file.attrs)
    changes = [(attribute, value) for attribute in attributes for value in ODD][::9]
    for number, (attribute, value) in enumerate([*changes, *WRONG]):
        refused = number >= len(changes)
        renew(valid / name, path)
        with h5py.File(path, "r+") as file:
            file.attrs[attribute] = value
        try:
            READERS[name](path)
            assert not refused
        except FileError as error:
            assert str(path) in str(error) and (attribute in str(error) or not refused)


@pytest.mark.parametrize("name", READERS)
def test_a_file_that_was_cut_is_refused(name, valid, copy):
    path, content = copy / name, (valid / name).read_bytes()
    for length in np.linspace(0, len(content) - 1, 12).astype(int):
        path.write_bytes(content[:length])
        with pytest.raises(FileError, match=path.name):
            READERS[name](path)
