"""What a wrong scene is answered with: field, value, range, unit, and the way out."""

import pytest

import spadwarp

BOX = 'domain={shape="box", lower=[-1, -1, -1], upper=[1, 1, 9]'


def message(tmp_path, *overrides):
    with pytest.raises(spadwarp.SpadwarpError) as caught:
        spadwarp.load_scene("plane_5m", list(overrides))
    return str(caught.value).replace(f"{tmp_path}/", "")


@pytest.mark.parametrize(
    ("override", "text"),
    [
        # Ports
        ('camera.port={distance="5 cm", thickness="10 ns"}', "thickness = '10 ns' (an override) is a time; a length"),
        ('camera.port={distance=0.05, thickness=0.01, material="glass"}', "is not one of 'BK7', 'fused silica'"),
        ('camera.port={preset="dome-acryl"}', "did you mean 'dome-acrylic'?"),
        ('camera.port={preset="dome-acrylic", distance=0.05}', "distance = 0.05 goes with shape = 'flat' only"),
        ('camera.port={preset="dome-acrylic", offset=[0, 0, 0.06]}', "outside: it is 0.06 m from the dome's centre"),
        ("camera.port={distance=-0.05}", "camera.port.distance = -0.05 (an override) is outside [1e-6, 1e6] m"),
        ("laser.port=flat-glass", 'a preset is taken by {preset = "flat-glass"}'),
        ("laser.port=window", "is neither a table nor 'camera'; presets are 'flat-acrylic', "),
        ("laser.port=camera", "laser.port = 'camera' needs a camera.port"),
        ('laser.port={"preset": "flat-glass"}', "TOML writes a table as {name = value}"),
        # Walls
        ('domain={shape="box", upper=[1, 1]}', "domain.upper = [1, 1] has the wrong number of values; 3 are needed"),
        ("domain={outside_index={y_low=1.0}}", "no such face with shape = 'unbounded'; a slab has z_low and z_high"),
        (BOX + ", outside_index={y_lw=1.0}}", "did you mean 'y_low'?"),
        (BOX + ", outside_index=1.0}", "is not a table of x_low, x_high, y_low, y_high, z_low, z_high"),
        (BOX + ", outside_index={y_low=0.5}}", "domain.outside_index.y_low = 0.5 (an override) is outside [1, 1e9]"),
        (BOX + ", max_reflections=9}", "domain.max_reflections = 9 (an override) is outside [0, 8]"),
        # Cameras and lasers
        ("camera.rotation_deg=10", "camera.rotation_deg = 10 (an override) is not a list of 3 values"),
        ("camera.calibration=cal.yml", "camera.calibration = cal.yml: cannot be read: No such file or directory"),
        ("laser.profile=measured", "needs profile_image with profile = 'measured': the path of an image"),
        ("detector.pdp=25", 'detector.pdp = 25 (an override) is outside [0, 1]; did you mean "25 %"?'),
        # Daylight and water
        ("daylight={sun_elevation_deg=45}", "daylight.depth is missing (of the lens below the surface [m])"),
        ("daylight={sun_elevation_deg=-5, depth=10}", "sun_elevation_deg = -5 (an override) is outside (0, 90] °"),
        ("medium.grid.file=smoke.vdb", "does not end in .npz, .h5, .hdf5, .nvdb"),
        ("medium.layers=[{extinction=0.4}]", "medium.layers[0].start is missing"),
    ],
)
def test_newer_tables(override, text, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert text in message(tmp_path, override)


def test_a_laser_outside_its_port(tmp_path):
    text = message(tmp_path, 'camera.port={preset="dome-acrylic"}', "laser.port=camera", "laser.position=[-0.12, 0, 0]")
    assert text.endswith(
        "laser.position = [-0.12, 0.0, 0.0] is outside laser.port: it is 0.12 m from the dome's centre, the radius is "
        "0.05 m; move the laser, or give it a port of its own: [laser.port]"
    )


@pytest.mark.parametrize(
    ("table", "text"),
    [
        ("tme,camera.position[2]\n0,0\n", "line 1: 'tme,camera.position[2]' is not time and names of fields, such"),
        ("time,camera.position[2]\n0,0\n1,x\n", "line 3: camera.position[2] = 'x' is not a number"),
        ("time,camera.position[2]\n1,0\n0,1\n", "line 3: time = 0 is not after 1"),
    ],
)
def test_trajectories(table, text, tmp_path):
    path = tmp_path / "poses.csv"
    path.write_text(table)
    with pytest.raises(spadwarp.ConfigError) as caught:
        spadwarp.scene.load_trajectory(path)
    assert text in str(caught.value)
