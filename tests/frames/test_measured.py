"""Files of other programs: what they say is read, what they do not say is asked for, what is damaged is refused."""

import inspect
import os
import struct
from pathlib import Path

import h5py
import numpy as np
import pytest

import spadwarp
from helpers.synthetic_result import make_result, make_scene
from spadwarp.frames import read_histograms, read_response
from spadwarp.values import ArgumentError, FileError, SpadwarpWarning

scipy_io = pytest.importorskip("scipy.io")

COUNTS = np.random.default_rng(3).poisson(2.0, (3, 5, 40)).astype(np.uint16)
START = {"gate_start": 0.0}


def cells(counts, first):
    """The time tags of counts, in cells of columns and rows by turns as MATLAB users have them."""
    tags = np.empty(counts.shape[:2], object)
    for index in np.ndindex(tags.shape):
        one = np.repeat(np.arange(counts.shape[2]) + first, counts[index])
        tags[index] = one[:, None] if sum(index) % 2 else one[None]
    return tags


def write_v73(path, **variables):
    """As MATLAB 7.3 lays arrays, cells and sparse matrices out."""
    with h5py.File(path, "w") as file:
        for name, value in variables.items():
            if isinstance(value, np.ndarray) and value.dtype == object:
                references = np.empty(value.T.shape, h5py.ref_dtype)
                for index, cell in np.ndenumerate(value.T):
                    item = file.create_dataset(f"#refs#/{name}{index[0]}_{index[1]}", data=cell.T.astype(float))
                    references[index] = item.ref
                file[name] = references
                file[name].attrs["MATLAB_class"] = np.bytes_("cell")
            elif hasattr(value, "tocsc"):
                matrix = value.tocsc()
                group = file.create_group(name)
                group.attrs["MATLAB_sparse"] = np.uint64(matrix.shape[0])
                group["ir"], group["jc"] = matrix.indices.astype(np.uint64), matrix.indptr.astype(np.uint64)
                group["data"] = matrix.data
            else:
                file[name] = value.T


def test_every_kind_of_file_holds_the_same_histograms(tmp_path):
    sparse = pytest.importorskip("scipy.sparse")
    ptufile = pytest.importorskip("ptufile")
    flat = sparse.csc_array(COUNTS.transpose(1, 0, 2).reshape(15, 40).astype(float))  # pixels column by column
    truth, tags = np.ones((3, 5)), cells(COUNTS, 7)
    np.save(tmp_path / "a.npy", COUNTS)
    np.save(tmp_path / "floats.npy", COUNTS.astype(float))
    np.save(tmp_path / "tyx.npy", COUNTS.transpose(2, 0, 1))
    scipy_io.savemat(tmp_path / "a.mat", {"counts": COUNTS, "small": COUNTS[:1, ..., :9], "name": "wall"})
    write_v73(tmp_path / "b.mat", counts=COUNTS)
    scipy_io.savemat(tmp_path / "sparse.mat", {"spad": flat, "depth": truth, "rates": 0.3 * COUNTS})
    write_v73(tmp_path / "sparse73.mat", spad=flat, depth=truth)
    scipy_io.savemat(tmp_path / "tags.mat", {"Ts": tags})
    write_v73(tmp_path / "tags73.mat", Ts=tags)
    with h5py.File(tmp_path / "c.h5", "w") as file:
        file["camera/hits"], file["camera/map"] = COUNTS, truth
    ptufile.imwrite(tmp_path / "a.ptu", COUNTS, global_resolution=50e-9, tcspc_resolution=4e-12)
    for name in sorted(path.name for path in tmp_path.iterdir()):
        unit = {"tag_unit": 4e-12} if name.startswith("tags") else {}
        found = read_histograms(tmp_path / name, **START, **unit)
        assert np.array_equal(found.values, COUNTS) and found.values.dtype.kind in "iu", name
        width = None if name.partition(".")[0] not in ("tags", "tags73") and name != "a.ptu" else 4e-12
        assert found.bin_width == (width if width is None else pytest.approx(width)), name
        assert found.gate_start == pytest.approx(28e-12 if unit else 0.0), name


def test_our_own_export_is_read_with_its_counts_and_its_axis(tmp_path):
    result = make_result(make_scene(width=6, height=4))
    frames = spadwarp.detect(result, pulses=500, frames=1, seed=2, device="cpu")
    [path] = spadwarp.export(frames, tmp_path / "a.mat", result=result)
    found = read_histograms(path)
    assert np.array_equal(found.values, frames.counts[0])
    assert (found.bin_width, found.gate_start) == pytest.approx((frames.bin_width, frames.gate_start))
    assert any("reads spad, not rates" in note for note in found.notes)
    assert read_histograms(path, dataset="rates").values.dtype.kind == "f"


def test_frames_stay_frames_in_every_format(tmp_path):
    ptufile = pytest.importorskip("ptufile")
    frames = np.stack([COUNTS, 2 * COUNTS, COUNTS])
    np.save(tmp_path / "a.npy", frames)
    newer = "dims" in inspect.signature(ptufile.imwrite).parameters
    axes = {"dims": "TYXH"} if newer else {"has_frames": True}
    ptufile.imwrite(tmp_path / "a.ptu", frames, **axes, global_resolution=50e-9, tcspc_resolution=4e-12)
    for name in ("a.npy", "a.ptu"):
        assert np.array_equal(read_histograms(tmp_path / name, **START).values, frames), name
        summed = read_histograms(tmp_path / name, sum_frames=True, **START).values
        assert np.array_equal(summed, frames.sum(axis=0)), name
    assert any("3 frames; sum_frames" in note for note in read_histograms(tmp_path / "a.ptu", **START).notes)


@pytest.mark.parametrize(
    ("shape", "order"),
    [
        ((72, 88, 1024), "yxt"),
        ((1024, 72, 88), "tyx"),
        ((1, 5, 40), "yxt"),
        ((5, 3, 5, 40), "nyxt"),
        ((5, 40, 3, 5), "ntyx"),
        ((64, 64, 64), None),
        ((48, 64, 80), None),
        ((3, 4, 5), None),
    ],
)
def test_axes_are_inferred_where_one_order_is_clear(shape, order, tmp_path):
    values = np.zeros(shape, np.uint8)
    values.flat[1] = 1
    np.save(tmp_path / "a.npy", values)
    if order is None:
        with pytest.raises(ArgumentError, match=r"order of the axes is missing \(axes\): shape .* yxt .* or tyx"):
            read_histograms(tmp_path / "a.npy", **START)
        order = "yxt"
    else:
        assert any(f"(axes = {order})" in note for note in read_histograms(tmp_path / "a.npy", **START).notes)
    found = read_histograms(tmp_path / "a.npy", axes=order, **START).values
    assert np.array_equal(found, np.transpose(values, [order.index(one) for one in "nyxt"[-values.ndim :]]))
    with pytest.raises(ArgumentError, match="are not the letters of"):
        read_histograms(tmp_path / "a.npy", axes="xxt", **START)


def test_cells_that_all_hold_as_many_tags(tmp_path):
    counts = np.zeros((3, 5, 9), np.uint16)
    counts[..., 4] = 2
    scipy_io.savemat(tmp_path / "tags.mat", {"Ts": cells(counts, 0)})
    found = read_histograms(tmp_path / "tags.mat", tag_unit=4e-12, **START)
    assert np.array_equal(found.values, counts[..., 4:5]) and found.gate_start == pytest.approx(16e-12)


@pytest.mark.slow
def test_a_mat_file_that_brings_its_reader_down_is_an_error(tmp_path):
    """A change of one byte near the class and the sizes of the array, after which scipy's reader faults or fails."""
    scipy_io.savemat(tmp_path / "a.mat", {"Ts": cells(COUNTS, 7)})
    whole = (tmp_path / "a.mat").read_bytes()
    place = whole.index(b"Ts")
    for k in range(place - 40, place + 60, 9):
        (tmp_path / "b.mat").write_bytes(whole[:k] + b"\x7f" + whole[k + 1 :])
        try:
            read_histograms(tmp_path / "b.mat", tag_unit=4e-12, **START)
        except (FileError, ArgumentError):
            continue


def test_floats_are_counts_if_all_are_whole(tmp_path):
    for name, factor, kind in (("counts", 1.0, "i"), ("rates", 0.5, "f")):
        np.save(tmp_path / f"{name}.npy", factor * COUNTS)
        found = read_histograms(tmp_path / f"{name}.npy", **START)
        assert found.values.dtype.kind == kind and any(note.startswith(f"{name}: ") for note in found.notes)


def test_facts_that_are_missing_are_asked_for_or_said(tmp_path):
    np.save(tmp_path / "a.npy", COUNTS)
    with pytest.warns(SpadwarpWarning, match=r"gate start is not given \(gate_start\): bin 0 is taken"):
        assert read_histograms(tmp_path / "a.npy").gate_start == 0
    scipy_io.savemat(tmp_path / "tags.mat", {"Ts": cells(COUNTS, 7)})
    with pytest.raises(ArgumentError, match=r"unit of the time tags in Ts is missing \(tag_unit\)"):
        read_histograms(tmp_path / "tags.mat")
    with pytest.raises(ArgumentError, match="bin width = 10 ps is not a multiple of the tags' unit, 4 ps"):
        read_histograms(tmp_path / "tags.mat", tag_unit=4e-12, bin_width=1e-11, **START)
    wide = read_histograms(tmp_path / "tags.mat", tag_unit=4e-12, bin_width=2e-11, **START)
    assert np.array_equal(wide.values, np.pad(COUNTS, [(0, 0), (0, 0), (2, 3)]).reshape(3, 5, 9, 5).sum(-1))
    assert (wide.bin_width, wide.gate_start) == pytest.approx((2e-11, 5 * 4e-12))
    far = cells(COUNTS, 7)
    for tag in (2**40, 2**20 + 30):  # one bit that is wrong
        far[0, 0] = np.array([[tag]])
        scipy_io.savemat(tmp_path / "far.mat", {"Ts": far})
        with pytest.raises(ArgumentError, match=rf"to {tag} are .* a wider bin than 4 ps \(bin_width\) would help"):
            read_histograms(tmp_path / "far.mat", tag_unit=4e-12, **START)
    far[0, 0] = np.array([[2**63 + 5]], np.uint64)
    scipy_io.savemat(tmp_path / "far.mat", {"Ts": far})
    with pytest.raises(FileError, match=r"beyond 2\^62|not all whole"):
        read_histograms(tmp_path / "far.mat", tag_unit=4e-12, **START)
    scipy_io.savemat(tmp_path / "flat.mat", {"spad": pytest.importorskip("scipy.sparse").eye_array(15, 40).tocsc()})
    with pytest.raises(ArgumentError, match=r"image's size is missing \(image_size\): 15 pixels"):
        read_histograms(tmp_path / "flat.mat", **START)
    assert read_histograms(tmp_path / "flat.mat", image_size=(3, 5), **START).values.shape == (3, 5, 40)
    with h5py.File(tmp_path / "two.h5", "w") as file:
        file["a"], file["b"] = COUNTS, COUNTS
    with pytest.raises(ArgumentError, match=r"dataset is missing \(dataset\); the file holds a \(3, 5, 40\), b"):
        read_histograms(tmp_path / "two.h5")
    assert read_histograms(tmp_path / "two.h5", dataset="b", **START).values.shape == (3, 5, 40)
    with pytest.raises(FileError, match=r"no array 'big'; it holds a \(3, 5, 40\)"):
        read_histograms(tmp_path / "two.h5", dataset="big")


@pytest.mark.parametrize("markers", ["pixels", "lines"])
def test_a_scan_of_t3_records_with_markers(markers, tmp_path):
    """A point measurement in whose records markers begin the pixels or the lines, without an image's header."""
    ptufile = pytest.importorskip("ptufile")
    ptufile.imwrite(tmp_path / "image.ptu", COUNTS, global_resolution=50e-9, tcspc_resolution=4e-12)
    header = (tmp_path / "image.ptu").read_bytes()
    header = header[: header.index(b"Header_End") + 48].replace(b"ImgHdr_Dimensions", b"Nobody_Dimensions")
    records, sync = [], 0
    for y, x in np.ndindex(3, 5):
        if markers == "pixels" or x == 0:
            records.append((0xF << 28) | (2 << 16) | (sync % 65536))  # PicoHarp T3: channel 15, marker, sync
        for k, dtime in enumerate(np.repeat(np.arange(40), COUNTS[y, x])):
            records.append((1 << 28) | (int(dtime) << 16) | (sync + k))
        sync += 200
    for tag, value in (("Measurement_SubMode", 1), ("TTResult_NumberOfRecords", len(records))):
        place = header.index(tag.encode()) + 40
        header = header[:place] + value.to_bytes(8, "little") + header[place + 8 :]
    (tmp_path / "scan.ptu").write_bytes(header + np.array(records, "<u4").tobytes())
    with pytest.raises(ArgumentError, match=r"image's size is missing \(image_size\): a scan of \d+ markers"):
        read_histograms(tmp_path / "scan.ptu", **START)
    found = read_histograms(tmp_path / "scan.ptu", image_size=(3, 5), **START)
    assert np.array_equal(found.values, COUNTS)
    assert any(f"a {markers[:-1]} at each marker 2" in note for note in found.notes)
    with pytest.raises(ArgumentError, match=r"image size = 7 x 7: 49 markers of one kind, or 7, are needed"):
        read_histograms(tmp_path / "scan.ptu", image_size=(7, 7), **START)


def test_a_response_has_times_or_a_value_for_each_bin(tmp_path):
    (tmp_path / "bins.csv").write_text("# of a pulse\n1\n4\n1\n")
    np.save(tmp_path / "bins.npy", np.array([1.0, 4.0, 1.0]))
    (tmp_path / "times.csv").write_text("time_ps,value\n-100,0\n-50,1\n0,4\n50,1\n100,0\n")
    same = [read_response(tmp_path / name, bin_width=50e-12) for name in ("bins.csv", "bins.npy", "times.csv")]
    for one in same:
        assert one.mean == pytest.approx(0.0, abs=1e-15) and one.fwhm == pytest.approx(same[0].fwhm)
        np.testing.assert_allclose(one.per_bin(50e-12), same[0].per_bin(50e-12), atol=1e-12)
    with pytest.raises(ArgumentError, match=r"bin width is missing \(bin_width\)"):
        read_response(tmp_path / "bins.npy")
    np.save(tmp_path / "bad.npy", np.zeros(4))
    with pytest.raises(ArgumentError, match="is not a response"):
        read_response(tmp_path / "bad.npy", bin_width=50e-12)


CAPTURES = Path(os.environ.get("SPADWARP_EXTRA_DATA", "")) / "captures"


@pytest.mark.slow
@pytest.mark.skipif(
    not os.environ.get("SPADWARP_EXTRA_DATA") or not CAPTURES.is_dir(), reason="SPADWARP_EXTRA_DATA holds no captures"
)
@pytest.mark.parametrize(
    ("name", "shape", "options", "metres"),
    [
        ("LR_Art.mat", (72, 88), {"bin_width": 80e-12}, (0.0, 12.3)),
        ("LR_Bowling1.mat", (72, 88), {"bin_width": 80e-12}, (0.0, 12.3)),
        ("pseudo_face.mat", (340, 340), {"tag_unit": 8e-12, "bin_width": 64e-12}, (4.2, 5.1)),
        ("tower.mat", (160, 160), {"tag_unit": 1e-12, "bin_width": 5e-10}, (776.0, 807.0)),
    ],
)
def test_captures_of_others(name, shape, options, metres):
    """Files as they were published: their histograms, and the range of the median pixel where it was measured."""
    found = read_histograms(CAPTURES / name, **options, **START)
    assert found.values.shape[:2] == shape and found.values.dtype == np.int32
    depth = spadwarp.frames.depth_of(found, method="peak", group_index=1.0, device="cpu").values
    assert metres[0] < np.nanmedian(depth) < metres[1]


@pytest.fixture(scope="module")
def content(tmp_path_factory):
    pytest.importorskip("ptufile")
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


MARKERS = ("ImgHdr_LineStart", "ImgHdr_LineStop", "ImgHdr_Frame")
DAMAGED = [(tag, value, f"{tag} = ") for tag in MARKERS for value in (2**62, 2**31, 10**9, -1)]  # powers of two of them
DAMAGED += [("MeasDesc_Resolution", value, r"frames\.ptu: ") for value in (0.0, -1.0, 1e300, np.nan, np.inf)]
DAMAGED += [("TTResult_NumberOfRecords", 2**40, "TTResult_NumberOfRecords")]
DAMAGED += [(side, 10**9, ".") for side in ("ImgHdr_PixX", "ImgHdr_PixY")]


@pytest.mark.parametrize(("tag", "value", "words"), DAMAGED)
def test_a_ptu_of_which_one_number_was_changed_is_refused_soon(content, tag, value, words, tmp_path):
    (tmp_path / "frames.ptu").write_bytes(changed(content, tag, value))
    with pytest.raises(spadwarp.SpadwarpError, match=words):
        read_histograms(tmp_path / "frames.ptu")


def test_channels_are_added_up_and_named(tmp_path):
    ptufile = pytest.importorskip("ptufile")
    counts = np.random.default_rng(1).poisson(1.0, (4, 5, 3, 16)).astype(np.uint8)
    ptufile.imwrite(tmp_path / "three.ptu", counts, global_resolution=50e-9, tcspc_resolution=1e-10)
    read = read_histograms(tmp_path / "three.ptu", gate_start=0.0)
    np.testing.assert_array_equal(read.values, counts.sum(2))
    assert "3 channels, added up" in "; ".join(read.notes)
