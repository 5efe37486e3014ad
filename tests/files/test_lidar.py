"""What a lidar delivers: photons and waveforms, read back by the programs that others read them with."""

import dataclasses
import json
import struct

import numpy as np
import pytest

import spadwarp
from helpers.scenes import scene
from spadwarp.files import photon_cloud
from spadwarp.result import COMPONENTS
from spadwarp.scene import shots_of
from spadwarp.values import SPEED_OF_LIGHT

SCAN = {"mode": "trajectory", "pattern": "conical", "half_angle_deg": 5.0, "velocity": [0.0, 300.0, 0.0]}
FAR = 1e5  # from the world's origin [m]


@pytest.fixture(scope="module")
def result():
    """16 shots of 200 pulses, 0.02 s from shot to shot, of a laser in the lens."""
    one = scene(
        scan=SCAN,
        medium={"group_index": 1.35},
        laser={"half_angle_deg": 3.0, "position": [0, 0, 0], "repetition_rate": 1e4, "pulse_energy": 3e-15},
        camera={"horizontal_fov_deg": 8.0, "rotation_deg": [3.0, 2.0, 10.0], "position": [FAR, 0.0, -0.2]},
        targets=[{"builtin": "plane", "size": [300, 300], "translation": [FAR, 0.0, 2.2], "reflectance": 0.7}],
        gate={"bin_width_ps": 100.0, "bins": 300},
        detector={"pulses_per_frame": 200, "dark_count_rate": 1e7, "wrap": False, "pdp": 0.5}
        | {"mode": "free_running", "dead_time_ns": 0.0},
    )
    return spadwarp.simulate(one, photons=16 * 3000, seed=1, device="cpu")


@pytest.fixture(scope="module")
def cloud(result):
    return photon_cloud(result, seed=3, device="cpu")


def test_photons_are_those_of_the_detector(result, cloud):
    """The counts of `detect`, each with the component whose share it is."""
    counts = spadwarp.detect(result, seed=3, tags=True, device="cpu").counts[0]
    found = np.zeros_like(counts)
    bins = np.rint(cloud.time_of_flight / 1e-10 - 0.5).astype(int)
    np.add.at(found, (cloud.row, cloud.column, bins), 1)
    np.testing.assert_array_equal(found, counts)
    np.testing.assert_array_equal(cloud.shot, 4 * cloud.row + cloud.column)
    np.testing.assert_allclose(cloud.time, (cloud.shot * 200 + cloud.pulse) / 1e4, rtol=1e-12)
    assert (np.diff(cloud.time) >= 0.0).all()
    # What is detected of a component without dead time goes with its light, and noise with the dark counts.
    scale = result.scene.laser.photons_per_pulse * result.scene.detections_per_photon * 200
    expected = [result.component(name).sum() * scale for name in COMPONENTS]
    expected.append(16 * 200 * 1e7 * 300 * 1e-10)
    share = np.bincount(cloud.component, minlength=4) / len(cloud)
    expected = np.array(expected) / sum(expected)
    assert (expected > 0.02).all() and len(cloud) > 1000
    assert (np.abs(share - expected) < 4.0 * np.sqrt(expected / len(cloud))).all()


def test_photons_stand_where_their_light_was_reflected(result, cloud):
    """On the line of their shot, at half the path: those of the target within bins of the plane z = 2.2 m."""
    shots = shots_of(result.scene)
    distance = 0.5 * cloud.time_of_flight * SPEED_OF_LIGHT / 1.35
    along = shots.rotation[cloud.shot, :, 2]
    np.testing.assert_allclose(cloud.position, shots.position[cloud.shot] + distance[:, None] * along, atol=1e-6)
    ballistic = cloud.component == 0
    bin_range = 0.5 * 1e-10 * SPEED_OF_LIGHT / 1.35
    # The pulse and the receiver's field widen the return.
    assert abs(np.median(cloud.position[ballistic, 2]) - 2.2) < 2.0 * bin_range
    assert (cloud.target == 0).all()
    np.testing.assert_allclose(cloud.true_range * along[:, 2] + shots.position[cloud.shot, 2], 2.2, atol=1e-5)


@pytest.mark.slow
def test_the_table_is_that_of_pandas(result, cloud, tmp_path):
    pandas, _ = pytest.importorskip("pandas"), pytest.importorskip("pyarrow")
    (path,) = spadwarp.export(result, tmp_path / "photons.parquet", seed=3)
    table = pandas.read_parquet(path)
    names = "shot row column pulse time time_of_flight x y z component target true_range"
    assert sorted(table.columns) == sorted(names.split()) and len(table) == len(cloud)
    np.testing.assert_array_equal(table[["x", "y", "z"]], cloud.position)
    np.testing.assert_array_equal(table.component, np.array([*COMPONENTS, "noise"])[cloud.component])
    index = pytest.importorskip("pyarrow.parquet").read_schema(path).metadata[b"group_index"]
    assert float(index) == result.scene.medium.group_index
    with pytest.raises(spadwarp.ArgumentError, match="for a result"):
        spadwarp.export(spadwarp.detect(result, seed=1, device="cpu"), tmp_path / "frames.parquet")


@pytest.mark.parametrize("ending", ["las", "laz"])
def test_points_are_right_to_a_millimetre(result, cloud, tmp_path, ending):
    laspy = pytest.importorskip("laspy")
    (path,) = spadwarp.export(result, tmp_path / f"photons.{ending}", seed=3)
    las = laspy.read(path)
    assert str(las.header.version) == "1.4" and las.header.point_format.id == 6
    axis = json.loads(las.header.vlrs.get_by_id("LASF_Spec", [3])[0].record_data_bytes())
    assert axis == {"gate_start": 0.0, "bin_width": result.scene.gate.bin_width, "group_index": 1.35}
    np.testing.assert_allclose(las.xyz, cloud.position, rtol=0.0, atol=1e-4)
    np.testing.assert_allclose(las.gps_time, cloud.time, rtol=1e-12)
    classes = np.array([40, 40, 45, 7])[cloud.component]
    np.testing.assert_array_equal(las.classification, classes)
    for name in ("shot", "pulse", "component", "target", "time_of_flight"):
        np.testing.assert_array_equal(las[name], getattr(cloud, name))
    # Photons of one pulse are its returns, in the order of their times.
    of_pulse = cloud.shot * 200 + cloud.pulse
    assert (las.return_number[1:] == np.where(np.diff(of_pulse) == 0, las.return_number[:-1] + 1, 1)).all()
    assert las.number_of_returns.max() == np.bincount(of_pulse).max()
    pdal = pytest.importorskip("pdal") if ending == "las" else None
    if pdal is not None:
        pipeline = pdal.Reader.las(str(path)).pipeline()
        assert pipeline.execute() == len(cloud)
        np.testing.assert_allclose(pipeline.arrays[0]["X"], cloud.position[:, 0], rtol=0.0, atol=1e-4)


@pytest.mark.slow
def test_waveforms_are_the_counts_of_each_shot(result, tmp_path):
    laspy = pytest.importorskip("laspy")
    paths = spadwarp.export(result, tmp_path / "shots.wdp", seed=3)
    assert [path.name for path in paths] == ["shots.las", "shots.wdp"]
    las, data = laspy.read(paths[0]), paths[1].read_bytes()
    assert las.header.point_format.id == 9 and las.header.global_encoding.waveform_data_packets_external
    form = las.header.vlrs.get_by_id("LASF_Spec", [100])[0].parsed_record
    assert (form.bits_per_sample, form.number_of_samples, form.temporal_sample_spacing) == (16, 300, 100)
    _, user, record, size, _ = struct.unpack("<H16sHQ32s", data[:60])
    assert (user.rstrip(b"\0"), record, size) == (b"LASF_Spec", 65535, len(data) - 60)
    counts = spadwarp.detect(result, seed=3, tags=True, device="cpu").counts[0].reshape(16, 300)
    shots = shots_of(result.scene)
    for k in range(16):
        start = int(las.wavepacket_offset[k])
        samples = np.frombuffer(data[start : start + int(las.wavepacket_size[k])], "<u2")
        np.testing.assert_array_equal(samples, counts[k])
        peak = int(np.argmax(samples))
        assert las.return_point_wave_location[k] == pytest.approx(100.0 * (peak + 0.5))
        # From the point back to the first sample, which is of the lens's plane: the gate begins at 0.
        first = las.xyz[k] - float(las.return_point_wave_location[k]) * np.array([las.x_t[k], las.y_t[k], las.z_t[k]])
        np.testing.assert_allclose(first, shots.position[k], rtol=0.0, atol=1e-3)
    odd = dataclasses.replace(result, scene=result.scene.with_overrides({"gate.bin_width_ps": 90.983}))
    with pytest.raises(spadwarp.ArgumentError, match="whole picoseconds"):
        spadwarp.export(odd, tmp_path / "odd.wdp")


def test_the_file_of_a_scan_tells_where_its_shots_are(result, tmp_path):
    """Without spadwarp: start + range times the line of sight is the point, here of the plane."""
    h5py = pytest.importorskip("h5py")
    loaded = spadwarp.load(result.save(tmp_path / "scan.h5"))
    np.testing.assert_array_equal(loaded.tallies, result.tallies)
    with h5py.File(tmp_path / "scan.h5") as file:
        points = file["shot/position"] + file["truth/range"][...][..., None] * file["shot/line_of_sight"][...]
        np.testing.assert_allclose(points[..., 2], 2.2, atol=1e-5)
        np.testing.assert_allclose(file["shot/time"][...].ravel(), 0.02 * np.arange(16), rtol=1e-12)
