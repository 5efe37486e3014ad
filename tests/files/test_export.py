"""Exports: read back by the programs' own libraries, and as others' code reads them."""

import h5py
import numpy as np
import OpenEXR
import pytest
from scipy import io, sparse

import spadwarp
from helpers.cli import run
from helpers.datasets import make, recipe
from helpers.synthetic_result import make_result, make_scene
from spadwarp.frames import record_frames
from spadwarp.frames.measured import read_histograms
from spadwarp.values import SPEED_OF_LIGHT, FileError, SpadwarpWarning

WIDTH, HEIGHT, BINS, PULSES, FRAMES = 8, 5, 48, 20_000, 2
LASER = {"position": [0.1, 0.0, 0.0], "pulse_energy": 1e-7, "repetition_rate": 4e6}  # a period of 34.6 m of path


@pytest.fixture(scope="module")
def result():
    return make_result(make_scene(width=WIDTH, height=HEIGHT, bins=BINS, laser=LASER))


@pytest.fixture(scope="module")
def detection(result):
    return spadwarp.detect(result, pulses=PULSES, frames=FRAMES, seed=3, device="cpu")


@pytest.fixture(scope="module")
def frames(result, tmp_path_factory):
    path = tmp_path_factory.mktemp("frames") / "frames.h5"
    record_frames(result, path, pulses=PULSES, frames=FRAMES, seed=3, methods=("peak", "centroid"), device="cpu")
    return path


def read_exr_channels(path):
    with OpenEXR.File(str(path), separate_channels=True) as file:
        return {name: np.array(channel.pixels) for name, channel in file.channels().items()}


@pytest.fixture(params=["file", "memory", "torch"])
def source(request, frames, detection):
    """The same frames, wherever they are."""
    if request.param == "torch":
        pytest.importorskip("torch")
        return spadwarp.result.to_torch(detection)
    return frames if request.param == "file" else detection


def spad_of(file, width=WIDTH, height=HEIGHT):
    """Counts [T, H, W] by the index arithmetic of the public training code (Lindell, O'Toole and Wetzstein 2018)."""
    return np.asarray(file["spad"].todense()).reshape(width, height, -1).transpose(2, 1, 0)


def test_npz_has_axes(source, frames, detection, result, tmp_path):
    spadwarp.export(source, tmp_path / "all.npz")
    with np.load(tmp_path / "all.npz") as file:
        assert np.array_equal(file["counts"], detection.counts)
        assert file["time"].shape == (detection.counts.shape[-1],)
        assert file["time"][0] == pytest.approx(file["gate_start"] + 0.5 * file["bin_width"])
    spadwarp.export(result, tmp_path / "a.npz")
    with np.load(tmp_path / "a.npz") as file:
        assert np.array_equal(file["histogram"], result.histogram)
        assert np.array_equal(file["true_depth"], result.truth.depth, equal_nan=True)
        # The file alone says where the light came from: to half a bin, and as far as the laser is from the lens.
        metres = 0.5 * SPEED_OF_LIGHT / file["group_index"]
        near, bin_length = metres * file["time"][file["histogram"].argmax(axis=-1)], metres * file["bin_width"]
    directly = result.component("ballistic").max(axis=-1) > 0.5 * result.histogram.max(axis=-1)
    assert np.abs(near - result.truth.range)[directly].max() < 0.5 * bin_length + 2e-3 and directly.sum() > 9
    # The same from each that is read back; a file's own facts do not stand against those that are given.
    for path in (tmp_path / "a.npz", *spadwarp.export(frames, tmp_path / "b.mat", frames=0)):
        read = read_histograms(path)
        known = (read.group_index, read.gate_start, read.bin_width)
        assert known == pytest.approx((result.scene.medium.group_index, detection.gate_start, detection.bin_width))
        own, given = (spadwarp.frames.depth_of(read, group_index=index).first for index in (None, 1.0))
        assert given == pytest.approx(read.group_index * own, nan_ok=True)
    assert np.array_equal(read.values, detection.counts[0]) and "reads spad, not rates" in "; ".join(read.notes)
    assert read_histograms(path, dataset="rates").values.dtype.kind == "f"
    _, notes = spadwarp.io.read_exr(*spadwarp.export(result, tmp_path / "a.exr"))
    assert float(notes["group_index"]) == result.scene.medium.group_index


def test_png_is_depth_in_millimetres(result, tmp_path):
    imageio = pytest.importorskip("imageio.v3")
    spadwarp.export(result, tmp_path / "a.png")
    depth, image = result.depth(), imageio.imread(tmp_path / "a.png")
    assert image.dtype == np.uint16
    np.testing.assert_allclose(image[np.isfinite(depth)], 1e3 * depth[np.isfinite(depth)], atol=0.51)


def test_npy(source, detection, result, tmp_path):
    assert spadwarp.export(source, tmp_path / "all.npy") == [tmp_path / "all.npy"]
    assert np.array_equal(np.load(tmp_path / "all.npy"), detection.counts)
    spadwarp.export(source, tmp_path / "one.npy", frames=1)
    assert np.array_equal(np.load(tmp_path / "one.npy"), detection.counts[1])
    spadwarp.export(result, tmp_path / "a.npy")
    assert np.array_equal(np.load(tmp_path / "a.npy"), result.histogram)


@pytest.mark.parametrize("source", ["file", "memory"], indirect=True)
def test_mat_as_denoisers_read_it(source, detection, result, tmp_path):
    written = spadwarp.export(source, tmp_path / "a.mat", result=result)
    assert written == [tmp_path / "a-00000.mat", tmp_path / "a-00001.mat"]
    for number, path in enumerate(written):
        file = io.loadmat(path, spmatrix=False)
        assert sparse.issparse(file["spad"])
        assert np.array_equal(spad_of(file), detection.counts[number].transpose(2, 0, 1))
        assert np.allclose(file["rates"], PULSES * detection.expected, rtol=1e-6)
    # MATLAB's reshape(full(spad), size(rates)) is column by column.
    counts = np.asarray(file["spad"].todense()).reshape(HEIGHT, WIDTH, BINS, order="F")
    assert np.array_equal(counts, detection.counts[1])

    # Light that was neither scattered nor spread by the response arrives in `bin`.
    ballistic = result.component("ballistic")
    illuminated = (file["bin"] > 0) & (ballistic.max(axis=-1) > 0)
    assert illuminated.sum() > WIDTH * HEIGHT // 2
    assert np.array_equal(file["bin"][illuminated] - 1, ballistic.argmax(axis=-1)[illuminated])
    assert np.array_equal(file["range_bins"], file["bin"])
    assert file["bin_size"].item() == pytest.approx(result.scene.gate.bin_width)
    assert np.array_equal(file["depth"] > 0, np.isfinite(result.truth.depth))

    signal, noise = file["mean_signal_photons"].item(), file["mean_background_photons"].item()
    assert file["SBR"].item() == pytest.approx(signal / noise) and file["photons"].item() == signal
    assert signal + noise == pytest.approx(file["rates"].sum() / (WIDTH * HEIGHT), rel=1e-4)
    assert file["intensity"].min() >= 0 and file["intensity"].max() == 1


@pytest.fixture(scope="module")
def ptu(frames, tmp_path_factory):
    (path,) = spadwarp.export(frames, tmp_path_factory.mktemp("ptu") / "a.ptu")
    return path


def test_ptu_is_read_back_by_ptufile(ptu, detection):
    ptufile = pytest.importorskip("ptufile")
    with ptufile.PtuFile(ptu) as file:
        assert file.is_t3 and file.is_image
        assert file.tcspc_resolution == pytest.approx(detection.bin_width)
        assert file.global_resolution == pytest.approx(1 / LASER["repetition_rate"])
        assert f"{detection.gate_start * 1e9:.6f} ns" in file.comment
        image = file.decode_image(channel=0, keepdims=True)  # [frame, y, x, channel, bin]
    assert np.array_equal(image[:, :, :, 0, :], detection.counts[..., : image.shape[-1]])
    assert not detection.counts[..., image.shape[-1] :].any()


def test_ptu_is_read_by_phconvert(ptu, detection):
    reader = pytest.importorskip("phconvert.pqreader")
    stamps, detectors, dtime, facts, markers = reader.load_ptu(str(ptu))
    photon = ~np.isin(detectors, markers)
    assert np.array_equal(np.bincount(dtime[photon], minlength=BINS), detection.counts.sum(axis=(0, 1, 2)))
    assert facts["nanotimes_unit"] == pytest.approx(detection.bin_width)
    assert facts["timestamps_unit"] == pytest.approx(1 / LASER["repetition_rate"])
    assert facts["hardware_name"] == "simulated SPAD array" and facts["software"] == "spadwarp"
    # The scan takes as long as its last record says, to a pixel and to a millisecond.
    pixel = facts["tags"]["ImgHdr_TimePerPixel"]["value"] * 1e-3
    assert abs(facts["acquisition_duration"] - stamps[-1] * facts["timestamps_unit"]) < pixel + 1e-3


def test_ptu_is_read_by_tttrlib(ptu, detection):
    tttrlib = pytest.importorskip("tttrlib")
    events = tttrlib.TTTR(str(ptu), "PTU")
    photon = np.asarray(events.event_types) == 0
    found = np.bincount(np.asarray(events.micro_times)[photon], minlength=BINS)
    assert np.array_equal(found, detection.counts.sum(axis=(0, 1, 2)))
    assert events.header.micro_time_resolution == pytest.approx(detection.bin_width)
    image = tttrlib.CLSMImage(tttr_data=events, channels=[0], fill=True)
    assert np.array_equal(image.intensity, detection.counts.sum(axis=-1))


def test_counts_and_gate_of_an_exported_ptu_are_known(frames, detection, tmp_path):
    ptufile = pytest.importorskip("ptufile")
    [path] = spadwarp.export(frames, tmp_path / "a.ptu", frames=0)
    again = read_histograms(path)
    assert again.gate_start == pytest.approx(detection.gate_start, abs=1e-15) and detection.gate_start > 0
    assert again.group_index == pytest.approx(1.3638)
    assert again.values.sum() == detection.counts[0].sum()
    # The same words by another writer are not ours to believe.
    with ptufile.PtuFile(path) as file:
        options = {"global_resolution": 50e-9, "tcspc_resolution": 4e-12, "comment": file.comment}
    ptufile.imwrite(tmp_path / "b.ptu", np.ones((1, 2, 2, 1, 4), np.uint32), **options)
    with pytest.warns(SpadwarpWarning, match="gate start is not given"):
        assert read_histograms(tmp_path / "b.ptu").gate_start == 0

    ranges = {}
    for name, facts in {"own": [], "given": ["--input", "gate_start=0"]}.items():
        run("depth", path, *facts, "--device", "cpu", "--out", tmp_path / name)
        ranges[name] = np.load(tmp_path / name / "range.npy")
    later = 0.5 * SPEED_OF_LIGHT / 1.3638 * detection.gate_start
    assert np.nanmedian(ranges["own"] - ranges["given"]) == pytest.approx(later, rel=1e-4)


def test_exr_is_read_back_by_openexr(frames, detection, result, tmp_path):
    written = spadwarp.export(frames, tmp_path / "a.exr")
    assert [path.name for path in written] == ["a-00000.exr", "a-00001.exr"]
    channels = read_exr_channels(written[1])
    with h5py.File(frames) as file:
        for name in ("peak", "centroid"):
            assert np.array_equal(channels[f"{name}.Z"], file[f"depth/{name}"][1], equal_nan=True)
    assert np.array_equal(channels["Z"], channels["centroid.Z"], equal_nan=True)
    assert np.array_equal(channels["intensity"], detection.counts[1].sum(axis=-1).astype(np.float32))
    assert np.array_equal(channels["truth.Z"], result.truth.depth, equal_nan=True)

    channels = read_exr_channels(*spadwarp.export(result, tmp_path / "b.exr"))
    parts = sum(channels[name].astype(np.float64) for name in ("ballistic", "forward_scattered", "backscatter"))
    assert np.allclose(parts, result.histogram.sum(axis=-1), rtol=1e-6)
    assert np.array_equal(channels["Z"], result.depth().astype(np.float32), equal_nan=True)
    assert np.array_equal(channels["truth.N.Z"], result.truth.normal[..., 2], equal_nan=True)


def read_as_lindell(listed, noise):
    """Names, index arithmetic and normalisation of the loader of Lindell, O'Toole and Wetzstein's sensor fusion."""
    for intensity_file in listed.read_text().split():
        held = io.loadmat(intensity_file.replace("intensity", "spad").replace(".mat", f"_p{noise}.mat"), spmatrix=False)
        image = io.loadmat(intensity_file)["intensity"].astype(np.float32) / 255
        yield spad_of(held), image, held["bin"] - 1.0, held["bin_hr"] - 1.0, held["SBR"].item(), held["photons"].item()


def test_sensor_fusion_as_its_loader_reads_it(frames, detection, result, tmp_path):
    printed = run("export", frames, "--format", "fusion", "--factor", 5, "--out", tmp_path / "run").output
    assert "frames.txt" in printed
    items = list(read_as_lindell(tmp_path / "run" / "frames.txt", 1))
    assert len(items) == FRAMES
    view = spadwarp.scene.camera.pixel_directions(result.scene.camera)
    light = -result.truth.reflectance * (result.truth.normal * view).sum(axis=-1)
    there = np.isfinite(light)
    for number, (spad, image, bins, fine_bins, sbr, photons) in enumerate(items):
        assert np.array_equal(spad, detection.counts[number].transpose(2, 0, 1))
        assert photons > 0 and sbr > 0 and image.shape == fine_bins.shape == (5 * HEIGHT, 5 * WIDTH)
        assert image.max() == 1 and image.min() >= 0
        # The middle one of the finer pixels looks where the pixel does.
        seen, image = bins >= 0, image[2::5, 2::5]
        assert seen.sum() > WIDTH * HEIGHT // 2
        assert np.abs(fine_bins[2::5, 2::5] - bins)[seen].max() < 0.5 + 1e-3
        ratio = (image / light)[there]
        assert ratio.max() / ratio.min() < 1.001 and (image[~there] == 0).all()


def test_analytic_frames(tmp_path):
    scene = make_scene(width=WIDTH, height=HEIGHT, bins=BINS)
    analytic = spadwarp.simulate_analytic(scene, frames=3, seed=5, device="cpu")
    path = analytic.save(tmp_path / "analytic.h5")
    spadwarp.export(path, tmp_path / "depth.npy")
    assert np.array_equal(np.load(tmp_path / "depth.npy"), analytic.depth, equal_nan=True)
    [exr] = spadwarp.export(path, tmp_path / "depth.exr", frames=2)
    assert np.array_equal(read_exr_channels(exr)["Z"], analytic.depth[2], equal_nan=True)
    with pytest.raises(ValueError, match=r"frame 0 is depth without counts, which \.mat is for"):
        spadwarp.export(path, tmp_path / "a.mat")


def test_what_cannot_be_written_is_named(frames, detection, result, tmp_path):
    for source, name, options, words in (
        (result, "a.mat", {}, "draw frames first"),
        (result, "a.ptu", {}, "draw frames first"),
        (frames, "a.npy", {"frames": 2}, r"frames = 2 is outside \[0, 1\]"),
        (detection, "a.mat", {}, "result is missing"),
        (result, "a.tif", {}, r"'\.tif' is not one of \.npy"),
        (tmp_path / "none.h5", "a.npy", {}, "no such file"),
    ):
        with pytest.raises((ValueError, FileError), match=words):
            spadwarp.export(source, tmp_path / name, **options)
    for source, words in ((result, "draw frames first"), (detection, "no scene of meshes")):
        with pytest.raises(ValueError, match=words):
            spadwarp.files.export_sensor_fusion(source, tmp_path / "none")
    assert not list(tmp_path.iterdir())


def test_command(frames, result, tmp_path):
    def printed(source, out, *options, code=0):
        return run("export", source, "--format", "npy", "--out", tmp_path / out, *options, code=code).output

    assert "frames-00000.mat to frames-00001.mat (2 files)" in printed(frames.parent, "a", "--format", "mat")
    # A second format goes into the same folder.
    run("export", frames, "--format", "xml", "--out", tmp_path / "a")
    camera = spadwarp.scene.Camera(calibration=str(tmp_path / "a" / "frames.xml"), aperture_diameter=0.02)
    assert camera.focal_pixels == pytest.approx(result.scene.camera.focal_pixels)
    names = sorted(path.name for path in (tmp_path / "a").iterdir() if not path.name.startswith("."))
    assert names == ["frames-00000.mat", "frames-00001.mat", "frames.npy", "frames.xml"]
    assert "frames.npy exists; --overwrite replaces it" in " ".join(printed(frames, "a", code=2).split())
    printed(frames, "a", "--overwrite")
    printed(frames, "b", "--frames", "1:2", "--quiet")
    assert np.load(tmp_path / "b" / "frames.npy").shape == (HEIGHT, WIDTH, BINS)
    assert "outside" in printed(frames, "d", "--frames", 9, code=2)
    assert "none of them in 5:" in printed(frames, "d", "--frames", "5:", code=2)
    assert not (tmp_path / "d").exists()  # no empty folder


CHANGES = {
    **{"targets.builtin": ["staircase", "car"], "targets.validation": [], "targets.test": ["car"]},
    **{"scene.camera.width": 7, "scene.camera.height": 4, "gate.bins": 40, "frames.per_scene": 2},
    **{"monte_carlo.share": 1.0, "monte_carlo.photons": 20_000, "scenes_per_shard": 2},
    **{"exposure.signal_photons": None, "exposure.pulses_per_depth_frame": 3000},
}


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    place = tmp_path_factory.mktemp("dataset") / "traced"
    make(recipe(**CHANGES), place)
    return place


def test_datasets_with_histograms(dataset, tmp_path):
    items = list(spadwarp.dataset.FrameReader(dataset, "train", fields=("counts", "expected", "noisy", "clean")))
    written = spadwarp.export(dataset, tmp_path / "a.mat", split="train")
    assert len(written) == len(items) == 4
    for path, item in zip(written, items, strict=True):
        file = io.loadmat(path, spmatrix=False)
        assert np.array_equal(spad_of(file, 7, 4), item["counts"]) and item["counts"].any()
        assert np.array_equal(file["rates"].transpose(2, 0, 1), item["expected"])
        assert np.array_equal(file["depth"], np.nan_to_num(item["clean"][0]))
        assert file["SBR"] > 0
    # Where light comes straight back, the bin of the truth holds most of what was expected of the target.
    seen = file["bin"] > 0
    rates, at = file["rates"], file["bin"].astype(int) - 1
    near = sum(np.take_along_axis(rates, np.clip(at + k, 0, 39)[..., None], axis=-1)[..., 0] for k in (-1, 0, 1, 2))
    assert seen.sum() > 10 and np.median(near[seen] / rates.sum(axis=-1)[seen]) > 0.5

    spadwarp.export(dataset, tmp_path / "a.npy", split="train", frames=slice(1, 3))
    stacked = np.stack([item["counts"].transpose(1, 2, 0) for item in items[1:3]])
    assert np.array_equal(np.load(tmp_path / "a.npy"), stacked)
    spadwarp.export(dataset, tmp_path / "a.ptu", split="train", frames=0)
    assert read_histograms(tmp_path / "a.ptu").values.sum() == items[0]["counts"].sum()


def test_datasets_of_depth(dataset, tmp_path):
    """Images of a frame with those of its scene; a split of its own."""
    items = list(spadwarp.dataset.FrameReader(dataset, "test", fields=("noisy", "clean", "label")))
    written = spadwarp.export(dataset, tmp_path / "a.exr", split="test")
    assert len(written) == len(items)
    for path, item in zip(written, items, strict=True):
        channels = read_exr_channels(path)
        for name, field in {"Z": "noisy", "truth.Z": "clean", "background": "label"}.items():
            assert np.array_equal(channels[name], item[field][0], equal_nan=True), name
    shard = next(dataset.glob("frames-*.h5"))
    spadwarp.export(shard, tmp_path / "b.npy")
    assert len(np.load(tmp_path / "b.npy")) == len(spadwarp.load(shard))
    run("export", dataset, "--split", "test", "--frames", "0:1", "--format", "exr", "--out", tmp_path / "c")
    assert [path.name for path in (tmp_path / "c").iterdir()] == ["traced.exr"]
