"""Exported datasets, read by the programs that trainers use, against our own reader."""

import gc
import io
import json
import tarfile

import numpy as np
import pytest

import spadwarp
from helpers.cli import run
from helpers.datasets import make, recipe
from spadwarp.dataset import FrameReader, export_dataset
from spadwarp.dataset.export import FEATURE_NAMES, histogram_features
from spadwarp.values import ArgumentError, FileError

FIELDS = ("noisy", "clean", "label", "intensity", "bound")
NUMBERS = ("sample", "scene", "backscatter_fraction", "attenuation_lengths", "distance")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Half of its scenes traced photon by photon."""
    place = tmp_path_factory.mktemp("dataset") / "data"
    traced = {"monte_carlo.share": 0.5, "monte_carlo.photons": 20_000, "gate.bins": 32, "license": "CC-BY-4.0"}
    small = {"scene.camera.width": 12, "scene.camera.height": 8, "frames.per_scene": 2}
    make(recipe(**traced, **small, **{"scene.laser.half_angle_deg": 8.0}), place)
    return place


@pytest.fixture(scope="module")
def parquet(folder, tmp_path_factory):
    pytest.importorskip("pyarrow")
    out = tmp_path_factory.mktemp("exported") / "parquet"
    run("export", folder, "--format", "parquet", "--out", out, "--frames-per-file", 3)
    return out


def assert_is_frame(row, item, manifest, name="{}"):
    for field in FIELDS:
        np.testing.assert_array_equal(np.asarray(row[name.format(field)]), item[field][0], err_msg=field)
        assert np.asarray(row[name.format(field)]).dtype != np.float64
    numbers = row.get("json", row)
    for number in NUMBERS:
        value = numbers[number]
        assert (value is None and np.isnan(item[number])) or np.allclose(value, item[number], equal_nan=True), number
    assert numbers["target"] == manifest["targets"][item["target"]]


@pytest.mark.slow
def test_hugging_face_loads_parquet_in_one_line(folder, parquet, tmp_path, monkeypatch):
    datasets = pytest.importorskip("datasets")
    loaded = datasets.load_dataset(str(parquet), cache_dir=str(tmp_path / "cache"))
    assert set(loaded) == {"train", "validation", "test"}
    for split, rows in loaded.items():
        reader = FrameReader(folder, split, fields=FIELDS)
        assert len(rows) == len(reader) == 4
        for row, item in zip(rows.with_format("numpy"), reader, strict=True):
            assert_is_frame(row, item, reader.manifest)
            assert row["features"].shape == (len(FEATURE_NAMES), 8, 12)
    assert loaded["train"].features["noisy"].shape == (8, 12)
    torch = pytest.importorskip("torch")
    batch = next(iter(torch.utils.data.DataLoader(loaded["train"].with_format("torch"), batch_size=2)))
    assert batch["noisy"].shape == (2, 8, 12) and batch["noisy"].dtype == torch.float32


def test_the_card_has_licence_splits_and_sizes(parquet):
    import yaml

    front, text = (parquet / "README.md").read_text().split("---\n")[1:]
    facts = yaml.safe_load(front)
    assert facts["license"] == "cc-by-4.0" and "Licence: CC-BY-4.0." in text
    splits = {split["name"]: split for split in facts["dataset_info"]["splits"]}
    assert {name: split["num_examples"] for name, split in splits.items()} == {"train": 4, "validation": 4, "test": 4}
    for name, split in splits.items():
        assert split["num_bytes"] == sum(path.stat().st_size for path in parquet.glob(f"data/{name}-*"))
    assert len(list(parquet.glob("data/train-*.parquet"))) == 2  # of three frames and one


@pytest.mark.filterwarnings("ignore")
def test_croissant_metadata_is_valid(folder, parquet):
    mlcroissant = pytest.importorskip("mlcroissant")
    described = mlcroissant.Dataset(jsonld=parquet / "croissant.json")
    assert not described.metadata.ctx.issues.errors
    found = next(iter(described.records("train-00000-of-00002")))
    item = FrameReader(folder, "train", fields=FIELDS)[0]
    assert found["train-00000-of-00002/sample"] == item["sample"]
    rows = np.stack([np.asarray(row) for row in found["train-00000-of-00002/clean"]])
    np.testing.assert_array_equal(rows.astype(np.float32), item["clean"][0])
    own = mlcroissant.Dataset(jsonld=folder / "croissant.json")
    assert not own.metadata.ctx.issues.errors
    assert {file.name for file in own.metadata.distribution} >= {"frames-00000.h5"}


@pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning")
def test_archives_are_read_by_webdataset_and_without_a_library(folder, tmp_path):
    out = export_dataset(folder, tmp_path / "tar", "webdataset", fields=(*FIELDS, "counts"), frames_per_file=3)
    archives = sorted(map(str, out.glob("train-*.tar")))
    reader = FrameReader(folder, "train", fields=FIELDS)
    with tarfile.open(archives[0]) as file:
        key, names = f"{reader[0]['sample']:09}", {name.partition(".")[2] for name in file.getnames()}
        assert names == {"json", "counts.npy", *(f"{field}.npy" for field in FIELDS)}
        stored = np.load(io.BytesIO(file.extractfile(f"{key}.noisy.npy").read()))
        np.testing.assert_array_equal(stored, reader[0]["noisy"][0])
        assert json.loads(file.extractfile(f"{key}.json").read())["sample"] == reader[0]["sample"]
    webdataset = pytest.importorskip("webdataset")
    assert len(archives) == 2
    rows = list(webdataset.WebDataset(archives, shardshuffle=False).decode())
    for row, item in zip(rows, reader, strict=True):
        assert_is_frame(row, item, reader.manifest, "{}.npy")
    gc.collect()  # it leaves archives open


@pytest.mark.slow
def test_xarray_opens_zarr(folder, tmp_path):
    pytest.importorskip("zarr")
    xarray = pytest.importorskip("xarray")
    out = export_dataset(folder, tmp_path / "zarr", "zarr", fields=(*FIELDS, "normal", "counts"))
    reader = FrameReader(folder, "train", fields=(*FIELDS, "normal"))
    with xarray.open_zarr(out / "frames.zarr", group="train") as rows:
        assert rows.noisy.dims == ("frame", "y", "x") and rows.noisy.attrs["units"] == "m"
        assert rows.normal.dims == ("frame", "axis", "y", "x") and rows.counts.dims == ("frame", "bin", "y", "x")
        for number, item in enumerate(reader):
            row = rows.isel(frame=number)
            assert_is_frame({name: values.values[()] for name, values in row.items()}, item, reader.manifest)
            np.testing.assert_array_equal(row.normal, item["normal"])


def test_features_find_the_return_and_a_second_one(folder):
    scene = FrameReader(folder, "train").scene(0)
    gate, counts = scene.gate, np.zeros((scene.gate.bins, 8, 12))
    counts[10], counts[11], counts[25], counts[2] = 7, 2, 4, 1
    counts[:, 3, 4] = 0
    features = dict(zip(FEATURE_NAMES, histogram_features(counts, scene), strict=True))
    assert np.isnan(features["peak_depth"][3, 4]) and features["peak_counts"][3, 4] == 0
    assert features["second_counts"][0, 0] == 4 and features["peak_counts"][0, 0] in (7, 9)
    peak = 10 if features["peak_counts"][0, 0] == 7 else (70 + 22) / 9
    for name, bin in {"peak": peak, "second": 25, "first": 2, "mean": 194 / 14}.items():
        time = np.full((8, 12), gate.start + (bin + 0.5) * gate.bin_width)
        depth = spadwarp.scene.sight.depth_from_time(time, scene=scene)
        found = features[f"{name}_depth"]
        np.testing.assert_allclose(np.delete(found, 3, axis=0), np.delete(depth, 3, axis=0), rtol=1e-5)


def test_what_cannot_be_exported_is_named(folder, whole, tmp_path):
    for dataset, arguments, problem in (
        (folder, {"fields": ("depth",)}, "fields = 'depth' is not one of 'noisy'"),
        (folder, {"format": "csv"}, "'csv' is not"),
        (whole, {"fields": ("counts",)}, "it has no histograms"),
    ):
        with pytest.raises(ArgumentError, match=problem):
            export_dataset(dataset, tmp_path / "a", **arguments)
    (tmp_path / "b").mkdir()
    (tmp_path / "b" / "mine").write_text("")
    with pytest.raises(FileError, match="exists"):
        export_dataset(folder, tmp_path / "b", "webdataset")
    for words, problem in (
        (("--out", tmp_path / "b"), "exists"),
        (("--out", folder, "--overwrite"), "holds the dataset"),
    ):
        assert problem in run("export", folder, "--format", "parquet", *words, code=2).output
    assert not (tmp_path / "a").exists() and [path.name for path in (tmp_path / "b").iterdir()] == ["mine"]
