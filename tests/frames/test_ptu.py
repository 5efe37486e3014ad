"""PicoQuant files of which one number was changed: read or refused, and soon."""

import struct

import numpy as np
import pytest

pytest.importorskip("ptufile")

import spadwarp
from helpers.synthetic_result import make_result, make_scene
from spadwarp.errors import FileError
from spadwarp.frames import read_histograms


@pytest.fixture(scope="module")
def content(tmp_path_factory):
    result = make_result(make_scene(width=6, height=4, bins=16))
    frames = spadwarp.detect(result, pulses=1000, frames=2, seed=1, device="cpu")
    path = tmp_path_factory.mktemp("ptu") / "frames.ptu"
    spadwarp.export(frames, path, result=result)
    return path.read_bytes()


def changed(content, tag, value):
    """The file with another value of a tag: its name in 32 bytes, an index and a type, then the value."""
    place = content.index(tag.encode() + b"\0") + 40
    packed = struct.pack("<d" if isinstance(value, float) else "<q", value)
    return content[:place] + packed + content[place + 8 :]


@pytest.mark.parametrize("value", [2**62, 2**31, 10**9, -1])
@pytest.mark.parametrize("tag", ["ImgHdr_LineStart", "ImgHdr_LineStop", "ImgHdr_Frame"])
def test_markers_that_no_record_has_are_refused(content, tag, value, tmp_path):
    """Two to their power is a number of gigabytes."""
    (tmp_path / "frames.ptu").write_bytes(changed(content, tag, value))
    with pytest.raises(FileError, match=rf"frames\.ptu: {tag} = "):
        read_histograms(tmp_path / "frames.ptu")


@pytest.mark.parametrize("value", [0.0, -1.0, 1e300, float("nan"), float("inf")])
def test_resolutions_that_no_clock_has_are_refused(content, value, tmp_path):
    (tmp_path / "frames.ptu").write_bytes(changed(content, "MeasDesc_Resolution", value))
    with pytest.raises(FileError, match=r"frames\.ptu: "):
        read_histograms(tmp_path / "frames.ptu")


def test_more_records_than_the_file_has_are_refused(content, tmp_path):
    (tmp_path / "frames.ptu").write_bytes(changed(content, "TTResult_NumberOfRecords", 2**40))
    with pytest.raises(FileError, match="TTResult_NumberOfRecords"):
        read_histograms(tmp_path / "frames.ptu")


@pytest.mark.parametrize("tag", ["ImgHdr_PixX", "ImgHdr_PixY"])
def test_images_that_are_too_large_are_refused(content, tag, tmp_path):
    (tmp_path / "frames.ptu").write_bytes(changed(content, tag, 10**9))
    with pytest.raises(spadwarp.SpadwarpError):
        read_histograms(tmp_path / "frames.ptu")


def test_channels_are_added_up_and_named(tmp_path):
    import ptufile

    counts = np.random.default_rng(1).poisson(1.0, (4, 5, 3, 16)).astype(np.uint8)
    ptufile.imwrite(tmp_path / "three.ptu", counts, global_resolution=50e-9, tcspc_resolution=1e-10)
    read = read_histograms(tmp_path / "three.ptu", gate_start=0.0)
    np.testing.assert_array_equal(read.values, counts.sum(2))
    assert "3 channels, added up" in "; ".join(read.notes)
