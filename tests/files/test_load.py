"""One loader, and commands, for every file that spadwarp writes."""

import shutil

import h5py
import numpy as np
import pytest

import spadwarp
from helpers.cli import DEVICE, run, tables
from helpers.datasets import make, recipe
from helpers.scenes import scene as make_scene
from spadwarp.analytic import AnalyticFile
from spadwarp.dataset import FrameReader
from spadwarp.files import gate_of, locate, open_source, sequence, stored_depth, summary
from spadwarp.frames import FramesFile, record_frames
from spadwarp.transport import PhotonRecords, save_records, trace

SCENE = make_scene(
    camera={"width": 8, "height": 8},
    gate={"start_ns": 5.0, "bin_width_ps": 200.0, "bins": 150},
    laser={"pulse_energy": 1e-12, "repetition_rate": 1e6},
)


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """One of each, by what it is."""
    folder = tmp_path_factory.mktemp("files")
    for name in ("run", "unfinished", "counts", "model"):
        (folder / name).mkdir()
    result = spadwarp.simulate(SCENE, photons=20_000, device="cpu")
    result.save(folder / "run" / "result.h5")
    result.save(folder / "unfinished" / "checkpoint.h5")
    record_frames(result, folder / "counts" / "frames.h5", pulses=500, frames=2, seed=1, device="cpu")
    spadwarp.simulate_analytic(SCENE, frames=3, seed=1, device="cpu").save(folder / "model" / "analytic.h5")
    save_records(trace(SCENE.with_overrides({"targets": []}), photons=100, device="cpu"), folder / "records.h5")
    make(recipe(), folder / "dataset")
    shard = next((folder / "dataset").glob("frames-*.h5")).name
    inside = {name: name for name in ("run", "unfinished", "dataset")} | {"frames": "counts", "analytic": "model"}
    inside |= {"result": "run/result.h5", "checkpoint": "unfinished/checkpoint.h5", "records": "records.h5"}
    inside |= {"shard": f"dataset/{shard}", "shard's scenes": f"dataset/scenes/{shard.replace('frames', 'scenes')}"}
    return {name: folder / place for name, place in inside.items()}


KINDS = dict.fromkeys(("result", "run", "checkpoint", "unfinished"), spadwarp.Result)
KINDS |= {"frames": FramesFile, "analytic": AnalyticFile, "records": PhotonRecords}
KINDS |= dict.fromkeys(("dataset", "shard", "shard's scenes"), FrameReader)


@pytest.mark.parametrize("name", KINDS)
def test_load_and_info_take_every_file(files, name, tmp_path):
    held = spadwarp.load(files[name])
    assert isinstance(held, KINDS[name])
    kind = summary(held)["kind"]
    assert kind in ("result", "frames", "analytic", "records", "dataset")
    assert spadwarp.load(str(files[name])).__class__ is held.__class__
    printed = run("info", files[name], "--json", tmp_path / "printed.json").stdout
    assert kind in printed.lower() and tables(tmp_path / "printed.json").get("kind", "result") == kind
    assert name != "frames" or tables(tmp_path / "printed.json")["noise_ratio"] > 0.0


@pytest.mark.parametrize(
    "name",
    ["frames", "dataset", *(pytest.param(n, marks=pytest.mark.slow) for n in ("unfinished", "analytic", "shard"))],
)
def test_view_depth_and_export_take_every_file_with_an_image(files, name, tmp_path):
    run("view", files[name], "--out", tmp_path / "view.html", *DEVICE)
    assert (tmp_path / "view.html").stat().st_size > 1e6
    run("depth", files[name], "--out", tmp_path / "depth", *DEVICE)
    assert np.isfinite(np.load(tmp_path / "depth" / "depth.npy")).any()
    run("export", files[name], "--format", "npy", "--format", "exr", "--out", tmp_path / "exported")
    assert list((tmp_path / "exported").glob("*.npy")) and list((tmp_path / "exported").glob("*.exr"))


@pytest.mark.parametrize("name", ["unfinished", pytest.param("shard", marks=pytest.mark.slow)])  # counts, depths
def test_denoise_takes_files_with_an_image(files, name, tmp_path):
    run("denoise", files[name], "--model", "median", "--out", tmp_path / "denoised", *DEVICE)
    written = list((tmp_path / "denoised").glob("*.npy"))
    assert len(written) == 3 and sum(path.stem.endswith(("_target", "_confidence")) for path in written) == 2


@pytest.mark.parametrize("name", ["analytic", "shard"])
def test_video_shows_reported_depths(files, name, tmp_path):
    run("view", files[name], "--pictures", 5, "--out", tmp_path / "light.gif")
    assert (tmp_path / "light.gif").stat().st_size > 1000


def test_analytic_files_give_back_what_was_saved(files):
    held = spadwarp.load(files["analytic"])
    twin = spadwarp.simulate_analytic(SCENE, frames=3, seed=1, device="cpu")
    assert held.scene == SCENE and held.frames == 3 and held.seed == 1
    assert np.array_equal(held.depth(), twin.depth, equal_nan=True) and np.array_equal(held.labels(2), twin.labels[2])
    assert np.array_equal(held.maps["sigma_depth"], twin.sigma_depth, equal_nan=True)
    assert np.array_equal(held.truth.normal, twin.truth.normal, equal_nan=True)
    assert np.array_equal(stored_depth(held).values, twin.depth, equal_nan=True)
    assert gate_of(held)[0] < np.nanmin(twin.truth.range) < np.nanmax(twin.truth.range) < gate_of(held)[1]
    with pytest.raises(spadwarp.ArgumentError, match=r"frame = 3 is outside \[0, 3\)"):
        held.depth(3)


def test_a_shard_is_its_part_of_the_dataset(files):
    whole, part = spadwarp.load(files["dataset"]), spadwarp.load(files["shard"])
    assert part.shards == [files["shard"].name] and len(part) * len(whole.shards) == len(whole)
    samples = [item["sample"] for item in part]
    twins = [item for item in whole if item["sample"] in samples]
    assert all(np.array_equal(a["noisy"], b["noisy"], equal_nan=True) for a, b in zip(part, twins, strict=True))
    assert list(whole.same_scene(4)) == [3, 4, 5]
    assert spadwarp.load(files["shard's scenes"]).shards == part.shards


def test_the_loader_says_what_it_cannot_take(files, tmp_path):
    with pytest.raises(spadwarp.FileError, match=r"no frames.h5 and no result.h5"):
        spadwarp.load(tmp_path)
    for name, source in (("result.h5", "result"), ("frames.h5", "frames"), ("frames-00000.h5", "shard")):
        source = files[source]
        shutil.copy(source / name if source.is_dir() else source, tmp_path / name)
    with pytest.raises(spadwarp.FileError, match=r"frames.h5 and result.h5; name the file"):
        locate(tmp_path)
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file.attrs["format"] = "someone else's"
    for name, words in (
        ("nothing.h5", "no such file"),
        ("frames-00000.h5", "no dataset there"),  # without its dataset
        ("other.h5", 'none of ours: its format is "someone else\'s"'),
    ):
        with pytest.raises(spadwarp.FileError, match=words):
            spadwarp.load(tmp_path / name)


def test_sequences_of_all_kinds(files):
    for name in ("frames", "analytic", "dataset"):
        frames = sequence(spadwarp.load(files[name]))
        assert frames.count >= 2 and "Z" in frames.at(1).images
        with pytest.raises(spadwarp.ArgumentError, match="frame = 99"):
            frames.at(99)
    with pytest.raises(spadwarp.ArgumentError, match="source is a int"):
        sequence(3)
    assert open_source(files["dataset"], split="test").count == 6


def test_checkpoints_and_results_are_told_apart(files):
    for name, file in (("unfinished", "checkpoint.h5"), ("run", "result.h5"), ("dataset", "dataset")):
        assert locate(files[name]).name == file
    run("detect", files["unfinished"], "--pulses", 100, "--out", files["unfinished"].parent / "detected", *DEVICE)
