"""Files of other programs: what they say is read, what they do not say is asked for, what is damaged is refused."""

import inspect
import os
import struct
from pathlib import Path

import h5py
import numpy as np
import pytest

import spadwarp
from spadwarp.frames import Histograms, depth_of, instrument_response, read_histograms
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


PICOSECONDS = {"global_resolution": 50e-9, "tcspc_resolution": 4e-12}
FLAT = COUNTS.transpose(1, 0, 2).reshape(15, 40).astype(float)  # pixels column by column


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """The same histograms as files of every kind, beside some that lack a fact."""
    sparse = pytest.importorskip("scipy.sparse")
    folder, truth, flat = tmp_path_factory.mktemp("files"), np.ones((3, 5)), sparse.csc_array(FLAT)
    arrays = {"counts": COUNTS, "floats": 1.0 * COUNTS, "rates": 0.5 * COUNTS, "none": 0 * COUNTS}
    arrays |= {"pixels": COUNTS[0], "empty": COUNTS[:0], "nan": np.nan * COUNTS}
    for name, values in arrays.items():
        np.save(folder / f"{name}.npy", values)
    np.save(folder / "tyx.npy", COUNTS.transpose(2, 0, 1))
    for name, values in {
        "dense": {"counts": COUNTS, "small": COUNTS[:1, ..., :9], "name": "wall"},
        "sparse": {"spad": flat, "depth": truth, "rates": 0.3 * COUNTS},
        "tags": {"Ts": cells(COUNTS, 7)},
        "flat": {"spad": flat},
    }.items():
        scipy_io.savemat(folder / f"{name}.mat", values)
    write_v73(folder / "dense73.mat", counts=COUNTS)
    write_v73(folder / "sparse73.mat", spad=flat, depth=truth)
    write_v73(folder / "tags73.mat", Ts=cells(COUNTS, 7))
    for name, tag in (("far", 2**40), ("farther", 2**20 + 30), ("furthest", 2**63 + 5)):  # one bit that is wrong
        tags = cells(COUNTS, 7)
        tags[0, 0] = np.array([[tag]], np.uint64)
        scipy_io.savemat(folder / f"{name}.mat", {"Ts": tags})
    for name, arrays in {"camera": {"a/hits": COUNTS, "a/map": truth}, "two": {"a": COUNTS, "b": COUNTS}}.items():
        with h5py.File(folder / f"{name}.h5", "w") as file:
            file.update(arrays)
    return folder


@pytest.fixture(scope="module")
def image(files):
    pytest.importorskip("ptufile").imwrite(files / "image.ptu", COUNTS, **PICOSECONDS)
    return files / "image.ptu"


@pytest.mark.parametrize(
    ("name", "options", "bin_width"),
    [
        *[(f"{name}.npy", {}, None) for name in ("counts", "floats", "tyx")],
        *[(f"{name}.mat", {}, None) for name in ("dense", "dense73", "sparse", "sparse73")],
        *[(f"{name}.mat", {"tag_unit": 4e-12}, 4e-12) for name in ("tags", "tags73")],
        ("flat.mat", {"image_size": (3, 5)}, None),
        ("camera.h5", {}, None),
        ("two.h5", {"dataset": "b"}, None),
        ("image.ptu", {}, 4e-12),
    ],
)
def test_every_kind_of_file_holds_the_same_histograms(files, request, name, options, bin_width):
    if name == "image.ptu":
        request.getfixturevalue("image")
    found = read_histograms(files / name, **START, **options)
    assert np.array_equal(found.values, COUNTS) and found.values.dtype.kind in "iu"
    assert found.bin_width == (bin_width if bin_width is None else pytest.approx(bin_width))
    assert found.gate_start == pytest.approx(28e-12 if "tag_unit" in options else 0.0)


def test_facts_beside_an_array_are_read_where_they_are_seconds(tmp_path):
    others = {"camera": np.array([None]), "lens": np.array("25 mm")}
    np.savez(tmp_path / "a.npz", counts=COUNTS, bin_width=4e-12, gate_start=2e-9, group_index=1.33, **others)
    found = read_histograms(tmp_path / "a.npz")
    assert (found.bin_width, found.gate_start, found.group_index) == (4e-12, 2e-9, 1.33)
    with h5py.File(tmp_path / "a.h5", "w") as file:  # picoseconds and nanoseconds
        file["counts"], file["bin_width"], file["gate_start"] = COUNTS, 4.0, 2.0
    assert read_histograms(tmp_path / "a.h5", bin_width=4e-12, gate_start=2e-9).gate_start == 2e-9


WIDER = r"are .* a wider bin than 4 ps \(bin_width\) would help"


@pytest.mark.parametrize(
    ("name", "options", "match"),
    [
        ("tags.mat", {}, r"missing \(tag_unit\).*=64ps,gate_start=0,group_index=.*irf="),
        ("tags.mat", {"tag_unit": 4e-12, "bin_width": 1e-11}, "bin width = 10 ps is not a multiple of the tags' unit"),
        ("far.mat", {"tag_unit": 4e-12}, rf"to {2**40} {WIDER}"),
        ("farther.mat", {"tag_unit": 4e-12}, rf"to {2**20 + 30} {WIDER}"),
        ("furthest.mat", {"tag_unit": 4e-12}, r"beyond 2\^62|not all whole"),
        ("flat.mat", {}, r"image's size is missing \(image_size\): 15 pixels"),
        ("two.h5", {}, r"dataset is missing \(dataset\); the file holds a \(3, 5, 40\), b"),
        ("two.h5", {"dataset": "big"}, r"no array 'big' \(dataset\); it holds a \(3, 5, 40\)"),
        ("counts.npy", {"axes": "xxt"}, "are not the letters of"),
        ("counts.npy", {"dataset": "hits"}, r"no array 'hits' \(dataset\); it holds one without name \(3, 5, 40\)"),
        ("counts.npy", {"tag_unit": 4e-12, "image_size": (3, 5)}, "image_size and tag_unit cannot .*; it takes axes"),
        ("flat.mat", {"image_size": (3, 5), "axes": "yxt"}, "axes cannot be given; it takes dataset, image_size"),
        ("counts.npy", {"bin_width": 5e-11, "irf": instrument_response(jitter_fwhm=300.0, pulse_fwhm=0)}, "= 300 s"),
        ("pixels.npy", {}, r"reshape \[pixels, T\] to \[H, W, T\]"),
        ("empty.npy", {}, r"uint16 \(0, 5, 40\); real numbers .*, one or more"),
        ("nan.npy", {}, "holds NaN, .*as_depth"),
    ],
)
def test_facts_that_are_missing_or_wrong_are_asked_for(files, name, options, match):
    with pytest.raises((ArgumentError, FileError), match=match):
        read_histograms(files / name, **START, **options)


@pytest.mark.parametrize(
    ("facts", "words"),
    [
        ({"bin_width": 0.05, "gate_start": 0.0}, r"bin_width = 0.05 is outside \(0, 1e-3\) s; give it"),
        ({"bin_width": 5e-11, "gate_start": 40.0}, r"gate_start = 40 is outside \[-1, 1\] s"),
        ({"bin_width": 5e-8, "gate_start": 4e-8, "group_index": 1.36}, "no light comes back through water: another"),
        ({"bin_width": 5e-11, "gate_start": 4e-8, "group_index": 1.333}, "group_index = 1.333 is a phase index"),
    ],
)
def test_facts_of_a_file_in_another_unit_are_named(facts, words, tmp_path):
    np.savez(tmp_path / "counts.npz", counts=np.ones((4, 4, 300), int), **facts)
    with pytest.raises((ArgumentError, SpadwarpWarning), match=words):
        depth_of(read_histograms(tmp_path / "counts.npz"), device="cpu")


@pytest.mark.parametrize("background", [1e-4, 15.0, np.full(300, 6e-5)])
def test_a_background_that_does_not_explain_the_counts_is_warned_of(background):
    counts = np.random.default_rng(4).poisson(0.05, (8, 8, 300))
    counts[..., 100] += 9
    measured = Histograms(values=counts, bin_width=5e-11, gate_start=4e-8, group_index=1.36)
    with pytest.warns(SpadwarpWarning, match=r"background: .* counts in a pixel do not explain its 23.8"):
        depth_of(measured, background=background, device="cpu")
    assert "bins from 4.409 to 6.062 m" in depth_of(measured, background=0.05, device="cpu").notes


def test_what_is_assumed_is_said(files):
    with pytest.warns(SpadwarpWarning, match=r"gate start is not given \(gate_start\): bin 0 is taken"):
        assert read_histograms(files / "counts.npy").gate_start == 0
    with pytest.warns(SpadwarpWarning, match="holds no counts"):
        read_histograms(files / "none.npy", **START)
    short = instrument_response(jitter_fwhm=300e-12, pulse_fwhm=0)
    with pytest.warns(SpadwarpWarning, match=r"irf = 300 ps is 0.003 of bin_width = 1e\+05 ps; one of the two may"):
        read_histograms(files / "counts.npy", irf=short, bin_width=1e-7, **START)
    (text,) = read_histograms(files / "counts.npy", axes="tyx", **START).notes
    assert text.startswith("axes: 40 x 5 pixels, 3 bins (axes = tyx); yxt would be usual")
    for name, kind, word in (("floats", "i", "counts: "), ("rates", "f", "rates: ")):  # counts if all are whole
        found = read_histograms(files / f"{name}.npy", **START)
        assert found.values.dtype.kind == kind and any(note.startswith(word) for note in found.notes)


def test_tags_are_sorted_into_wider_bins_and_begin_where_the_first_one_is(files, tmp_path):
    wide = read_histograms(files / "tags.mat", tag_unit=4e-12, bin_width=2e-11, **START)
    assert np.array_equal(wide.values, np.pad(COUNTS, [(0, 0), (0, 0), (2, 3)]).reshape(3, 5, 9, 5).sum(-1))
    assert (wide.bin_width, wide.gate_start) == pytest.approx((2e-11, 5 * 4e-12))
    counts = np.zeros((3, 5, 9), np.uint16)
    counts[..., 4] = 2  # cells that all hold as many tags
    scipy_io.savemat(tmp_path / "tags.mat", {"Ts": cells(counts, 0)})
    found = read_histograms(tmp_path / "tags.mat", tag_unit=4e-12, **START)
    assert np.array_equal(found.values, counts[..., 4:5]) and found.gate_start == pytest.approx(16e-12)


def test_frames_stay_frames_in_every_format(tmp_path):
    ptufile = pytest.importorskip("ptufile")
    frames = np.stack([COUNTS, 2 * COUNTS, COUNTS])
    np.save(tmp_path / "a.npy", frames)
    newer = "dims" in inspect.signature(ptufile.imwrite).parameters
    ptufile.imwrite(tmp_path / "a.ptu", frames, **({"dims": "TYXH"} if newer else {"has_frames": True}), **PICOSECONDS)
    for name in ("a.npy", "a.ptu"):
        assert np.array_equal(read_histograms(tmp_path / name, **START).values, frames), name
        summed = read_histograms(tmp_path / name, sum_frames=True, **START).values
        assert np.array_equal(summed, frames.sum(axis=0)), name
    assert any("3 frames; sum_frames" in note for note in read_histograms(tmp_path / "a.ptu", **START).notes)
    channels = np.random.default_rng(1).poisson(1.0, (4, 5, 3, 16)).astype(np.uint8)
    ptufile.imwrite(tmp_path / "three.ptu", channels, **PICOSECONDS)
    read = read_histograms(tmp_path / "three.ptu", **START)
    np.testing.assert_array_equal(read.values, channels.sum(2))
    assert "3 channels, added up" in "; ".join(read.notes)


@pytest.mark.parametrize(
    ("shape", "order"),
    [
        *[((72, 88, 1024), "yxt"), ((1024, 72, 88), "tyx"), ((1, 5, 40), "yxt")],
        *[((5, 3, 5, 40), "nyxt"), ((5, 40, 3, 5), "ntyx")],
        *[(shape, None) for shape in ((64, 64, 64), (48, 64, 80), (3, 4, 5))],
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


@pytest.mark.parametrize("markers", ["pixels", "lines"])
def test_a_scan_of_t3_records_with_markers(image, markers, tmp_path):
    """A point measurement in whose records markers begin the pixels or the lines, without an image's header."""
    header = image.read_bytes()
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


CAPTURES = Path(os.environ.get("SPADWARP_EXTRA_DATA", "/nowhere")) / "captures"


@pytest.mark.slow
@pytest.mark.skipif(not CAPTURES.is_dir(), reason="SPADWARP_EXTRA_DATA holds no captures")
@pytest.mark.parametrize(
    ("name", "shape", "options", "metres"),
    [
        *[(name, (72, 88), {"bin_width": 80e-12}, (0.0, 12.3)) for name in ("LR_Art.mat", "LR_Bowling1.mat")],
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
def test_a_ptu_of_which_one_number_was_changed_is_refused_soon(image, tag, value, words, tmp_path):
    (tmp_path / "frames.ptu").write_bytes(changed(image.read_bytes(), tag, value))
    with pytest.raises(spadwarp.SpadwarpError, match=words):
        read_histograms(tmp_path / "frames.ptu")
