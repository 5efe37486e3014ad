"""Manifests and records of shards that are not as they should be: an error that names file and entry."""

import functools
import json
import shutil

import pytest

from helpers.cli import run
from helpers.datasets import make, recipe
from spadwarp.dataset import FrameReader, read_manifest, verify_dataset
from spadwarp.values import FileError

SMALL = {"targets.builtin": ["staircase"], "targets.validation": [], "frames.per_scene": 1, "scenes_per_target": 1}


@pytest.fixture(scope="module")
def one_shard(tmp_path_factory):
    folder = tmp_path_factory.mktemp("one") / "data"
    make(recipe(**SMALL), folder)
    return folder


@pytest.fixture
def folder(one_shard, tmp_path):
    return shutil.copytree(one_shard, tmp_path / "data")


def change(folder, path, value):
    """Writes the manifest with another value at a path such as "splits.train.frames"; `...` removes it."""
    manifest = json.loads((folder / "manifest.json").read_text())
    *outer, last = path.split(".")
    table = functools.reduce(dict.get, outer, manifest)
    table[last] = value
    if value is ...:
        del table[last]
    (folder / "manifest.json").write_text(json.dumps(manifest))


@pytest.mark.parametrize(
    ("path", "value", "named"),
    [
        ("splits", ..., "splits"),
        ("splits", [], "splits"),
        ("splits.train", ..., "train"),
        ("splits.test.shards", ["../../../etc/passwd"], "shards"),
        ("splits.test.shards", ["/etc/passwd"], "shards"),
        ("splits.test.frames", -1, "frames"),
        ("targets", "staircase", "targets"),
        ("targets", ["boat"], "not a whole manifest: the target 'boat' is in no split"),
        ("height", 10**9, "height"),
        ("width", None, "width"),
        ("depth_step", float("inf"), "depth_step"),
        ("files", {"../secret": {"bytes": 3, "sha256": "0" * 64}}, "files"),
        ("files", {"frames-00000.h5": {"bytes": 3}}, "files"),
        ("format_version", "one", ""),
        ("format_version", 99, ""),
        ("format", "another", ""),
    ],
)
def test_a_manifest_that_is_not_whole_is_refused(path, value, named, folder):
    change(folder, path, value)
    for read in (read_manifest, FrameReader, verify_dataset):
        with pytest.raises(FileError, match=rf"manifest\.json: .*{named}"):
            read(folder)


@pytest.mark.parametrize(
    "text", ["[]", "3", "null", '"text"', "{", "", "[" * 100_000, '{"a": ' * 10_000, "\xff", "NaN"]
)
def test_a_manifest_that_is_no_table_is_refused(text, folder):
    (folder / "manifest.json").write_bytes(text.encode("latin-1"))
    with pytest.raises(FileError, match=r"manifest\.json: "):
        read_manifest(folder)
    for words in (("info", folder), ("info", folder, "--verify"), ("view", folder, "--out", folder / "x.png")):
        assert "manifest.json" in run(*words, code=1).stderr


@pytest.mark.parametrize(
    "text", ["[]", "{", '{"../x.h5": {"bytes": 1, "sha256": "0"}}', '{"frames-00000.h5": 3}', "9" * 5000]
)
def test_a_record_that_is_not_whole_is_made_again(text, one_shard, folder):
    (folder / "shards" / "00000.json").write_text(text)
    (folder / "manifest.json").unlink()
    assert any("00000.json" in line or "not the record" in line for line in verify_dataset(folder))
    report = make(recipe(**SMALL), folder)
    assert report.made == ("frames-00000.h5",) and len(report.broken) == 1
    assert read_manifest(folder) == read_manifest(one_shard)


@pytest.mark.parametrize(
    ("name", "value", "word"), [("height", 25, "depth"), ("targets", [], "target"), ("scenes", 0, "scene")]
)
def test_a_manifest_whose_numbers_are_not_those_of_the_files_is_noticed(name, value, word, folder):
    change(folder, name, value)
    with pytest.raises(FileError, match=rf"frames-00000\.h5: not a whole spadwarp frames: {word}"):
        FrameReader(folder, "test")[0]
