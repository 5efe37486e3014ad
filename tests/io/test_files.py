"""Files appear whole or not at all, and EXR stores what it was given."""

import os
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from helpers.cli import ENVIRONMENT
from spadwarp.io.arrays import read_exr, write_exr
from spadwarp.io.hdf5 import write_hdf5
from spadwarp.io.paths import atomic_path, lock, remove_temporaries
from spadwarp.values import FileError


def test_a_write_that_fails_midway_says_where_and_cleans_up(tmp_path):
    path = tmp_path / "new" / "file.bin"
    with pytest.raises(FileError, match=r"file\.bin: cannot be written: disk full"), atomic_path(path) as temporary:
        assert temporary.parent == path.parent  # a rename across file systems would not be atomic
        temporary.write_bytes(b"half")
        raise OSError("disk full")
    assert list(path.parent.iterdir()) == []


def test_hdf5_does_not_wait_in_memory(tmp_path):
    with write_hdf5(tmp_path / "large.h5") as file:
        file["zeros"] = np.zeros(1 << 20)
        file.flush()
        assert sum(one.stat().st_size for one in tmp_path.iterdir()) > 8 << 20
    assert [one.name for one in tmp_path.iterdir()] == ["large.h5"]


def test_folders_and_names_that_cannot_be_made_are_named(tmp_path):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(FileError, match="cannot be written"):
        write_exr(tmp_path / "file" / "image.exr", {"Z": np.ones((2, 2))})
    for make, name, words in (
        (write_hdf5, tmp_path / "file" / "result.h5", "cannot be written"),
        (lock, tmp_path / "file" / "lock", "cannot be written"),
        (atomic_path, tmp_path / ("a" * 300), "cannot be written"),
        (atomic_path, "", "no name"),
    ):
        with pytest.raises(FileError, match=words), make(name):
            pass
    path = tmp_path / ("é" * 127)  # 254 bytes, as long as a file system allows
    with atomic_path(path) as temporary:
        temporary.write_text("whole")
    assert path.read_text() == "whole"


def test_two_writers_of_one_file_do_not_share_a_temporary_one(tmp_path, monkeypatch):
    """Processes in containers have the same number: a name made of it would be one for both."""
    monkeypatch.setattr(os, "getpid", lambda: 1)
    path = tmp_path / "file.txt"
    with atomic_path(path) as one, atomic_path(path) as two:
        assert one != two
        one.write_text("one")
        two.write_text("two")
    assert path.read_text() == "one" and list(tmp_path.iterdir()) == [path]


def test_permissions_are_those_of_any_new_file(tmp_path):
    with atomic_path(tmp_path / "atomic") as temporary:
        temporary.write_text("")
    (tmp_path / "plain").write_text("")
    assert (tmp_path / "atomic").stat().st_mode == (tmp_path / "plain").stat().st_mode


def test_a_link_to_a_file_is_replaced_and_a_link_to_a_folder_followed(tmp_path):
    (tmp_path / "folder").mkdir()
    (tmp_path / "link").symlink_to("folder")
    (tmp_path / "mine.txt").write_text("mine")
    (tmp_path / "folder" / "file.txt").symlink_to(tmp_path / "mine.txt")
    with atomic_path(tmp_path / "link" / "file.txt") as temporary:
        temporary.write_text("new")
    assert (tmp_path / "mine.txt").read_text() == "mine"
    assert (tmp_path / "folder" / "file.txt").read_text() == "new" and (tmp_path / "link").is_symlink()


def test_what_killed_processes_left_is_removed_and_nothing_else(tmp_path):
    for name in (".file.h5.0123456789abcdef.tmp", ".file.h5.77.tmp", ".file.h50.77.tmp", "file.h5", ".file.h5.txt"):
        (tmp_path / name).touch()
    remove_temporaries(tmp_path / "file.h5")
    assert sorted(path.name for path in tmp_path.iterdir()) == [".file.h5.txt", ".file.h50.77.tmp", "file.h5"]


# Locks


def test_a_lock_has_one_holder_and_leaves_no_file(tmp_path):
    path, asked = tmp_path / "lock", []
    with lock(path) as first, lock(path) as second:
        assert first and not second
        with lock(path, wait=lambda: asked.append(1) or len(asked) < 3) as third:
            assert not third and len(asked) == 3
    with lock(path) as again:
        assert again
    assert not list(tmp_path.iterdir())


HOLD = "import sys; from spadwarp.io.paths import lock\nwith lock(sys.argv[1]): print(flush=True); sys.stdin.read()"


@pytest.mark.skipif(os.name != "posix", reason="has no such locks")
def test_the_lock_of_a_killed_process_is_free(tmp_path):
    command = [sys.executable, "-c", HOLD, str(tmp_path / "lock")]
    process = subprocess.Popen(command, env=ENVIRONMENT, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    process.stdout.readline()
    with lock(tmp_path / "lock") as held:
        assert not held
    process.kill()
    process.communicate()
    assert list(tmp_path.iterdir())
    with lock(tmp_path / "lock") as free:
        assert free


# EXR


SHAPES = arrays.array_shapes(min_dims=2, max_dims=2)


@settings(max_examples=30)
@given(arrays.arrays(dtype=st.sampled_from([np.float16, np.float32, np.uint32]), shape=SHAPES))
def test_exr_gives_back_what_it_was_given(tmp_path_factory, pixels):
    path = tmp_path_factory.mktemp("exr") / "image.exr"
    write_exr(path, {"Z": pixels, "N.X": pixels[::-1, ::-1]})
    channels, _ = read_exr(path)
    assert channels.keys() == {"Z", "N.X"}
    np.testing.assert_array_equal(channels["Z"], pixels, strict=True)
    np.testing.assert_array_equal(channels["N.X"], pixels[::-1, ::-1], strict=True)


def test_exr_stores_arrays_that_are_not_contiguous(tmp_path):
    cube = np.random.default_rng(1).normal(size=(8, 10, 3)).astype(np.float32)
    views = {"transposed": cube[:, :8, 0].T, "strided": np.repeat(cube[:, :8, 0], 2, axis=1)[:, ::2]}
    views |= {"channel": cube[:, 1:9, 2], "fortran": np.asfortranarray(cube[:, :8, 1])}
    views |= {"reversed": cube[::-1, 7::-1, 1], "broadcast": np.broadcast_to(cube[0, :8, 0], (8, 8))}
    write_exr(tmp_path / "views.exr", views)
    channels, _ = read_exr(tmp_path / "views.exr")
    for name, view in views.items():
        np.testing.assert_array_equal(channels[name], view, err_msg=name)


def test_exr_metadata_are_not_truncated(tmp_path):
    metadata = {"seed": 2**64 - 1, "unit": 0.1, "config": "[medium]\nextinction = 0.3\n", "empty": "", "text": "µ 水"}
    write_exr(tmp_path / "image.exr", {"Z": np.ones((2, 3))}, metadata)
    _, read = read_exr(tmp_path / "image.exr")
    assert read == {name: str(value) for name, value in metadata.items()}


@pytest.mark.parametrize(
    ("channels", "metadata", "message"),
    [
        ({}, {}, "at least one channel"),
        ({"Z": np.ones((2, 3)), "R": np.ones((3, 2))}, {}, "one shape for all"),
        ({"Z": np.ones((2, 3, 1))}, {}, r"'Z' has shape \(2, 3, 1\)"),
        ({"Z": np.ones((0, 3))}, {}, r"'Z' has shape \(0, 3\)"),
        ({"Z": np.ones((2, 3), dtype=np.int64)}, {}, "'Z' is int64"),
        ({"Z": np.ones((2, 3), dtype=complex)}, {}, "'Z' is complex128"),
        ({"Z": np.ones((2, 3))}, {"dataWindow": "mine"}, "'dataWindow' is one that EXR uses itself"),
    ],
)
def test_exr_refuses_what_it_cannot_hold(tmp_path, channels, metadata, message):
    with pytest.raises(ValueError, match=message):
        write_exr(tmp_path / "image.exr", channels, metadata)
    assert list(tmp_path.iterdir()) == []


def test_exr_files_that_are_not_whole_are_refused(tmp_path):
    path = write_exr(tmp_path / "image.exr", {"Z": np.random.default_rng(0).normal(size=(40, 50))})
    content = path.read_bytes()
    for length in (0, 3, 100, len(content) // 2, len(content) - 5):
        path.write_bytes(content[:length])
        with pytest.raises(FileError, match=r"image\.exr: not an EXR image, or damaged"):
            read_exr(path)
    for other, words in ((tmp_path / "none.exr", "no such file"), (tmp_path, "is not a file")):
        with pytest.raises(FileError, match=words):
            read_exr(other)
