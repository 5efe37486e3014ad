"""Water over wavelength, temperature, salinity and chlorophyll: published values, and the scenes that use them."""

import math

import numpy as np
import pytest

import spadwarp
from helpers.scenes import scene as make_scene
from reference import fournier_forand
from reference.single_scatter import henyey_greenstein
from spadwarp.scene import Medium, Scene
from spadwarp.scene.medium import WATER_INDICES
from spadwarp.values import ArgumentError
from spadwarp.water import (
    clear_sky_irradiance,
    daylight_attenuation,
    group_index,
    pure_water_absorption,
    pure_water_scattering,
    refractive_index,
    surface_reflectance,
    water_optics,
)

TABLES = {
    "camera": {"width": 4, "height": 4, "horizontal_fov_deg": 20.0, "aperture_diameter": 0.01},
    "gate": {"bin_width_ps": 100.0, "bins": 500},
}


def scene(medium, wavelength_nm=532.0):
    return Scene.from_dict({**TABLES, "medium": medium, "laser": {"wavelength_nm": wavelength_nm}})


def test_indices_are_those_in_use_and_the_group_index_is_that_of_the_slope():
    """Quan and Fry at 532 nm; n − λ·dn/dλ."""
    for name, salinity in (("seawater", 35.0), ("fresh", 0.0)):
        found = (law(532.0, temperature=20.0, salinity=salinity) for law in (refractive_index, group_index))
        assert tuple(found) == pytest.approx(WATER_INDICES[name], abs=5e-5)
    wavelength, step, water = np.array([405.0, 450.0, 532.0, 660.0]), 1e-3, {"temperature": 7.0, "salinity": 30.0}
    low, index, high = (refractive_index(wavelength + shift, **water) for shift in (-step, 0.0, step))
    expected = index - wavelength * (high - low) / (2 * step)
    np.testing.assert_allclose(group_index(wavelength, **water), expected, atol=1e-9)


def test_absorption_and_scattering_of_pure_water_are_the_published_ones():
    """Pope & Fry 1997. Zhang, Hu and He's own program at 18 °C and a salinity of 37, as other ports reproduce it. Morel
    1974: sea salt adds 30 % of scattering."""
    absorption = {400: 0.00663, 417.5: 0.00442, 450: 0.00922, 500: 0.0204, 532.5: 0.0447, 600: 0.2224, 700: 0.624}
    assert {wavelength: pure_water_absorption(wavelength) for wavelength in absorption} == absorption
    published = [0.00668, 0.00403, 0.00258, 0.00173, 0.00120, 0.00086, 0.00063]
    computed = pure_water_scattering(np.arange(400.0, 701.0, 50.0), temperature=18.0, salinity=37.0)
    np.testing.assert_allclose(computed, published, atol=5.1e-6)
    salty, fresh = (pure_water_scattering(np.array([400.0, 532.0, 700.0]), salinity=s) for s in (37.0, 0.0))
    np.testing.assert_allclose(salty / fresh, 1.30, atol=0.04)


# Bricaud et al. 1998: a_p(440) = 0.0520 C^0.635; Morel & Maritorena 2001: b_p(550) = 0.416 C^0.766.
@pytest.mark.parametrize("chlorophyll", [0.03, 0.3, 1.0, 5.0])
def test_chlorophyll_adds_what_was_published(chlorophyll):
    blue, green, red = (water_optics(at, chlorophyll=chlorophyll) for at in (440.0, 550.0, 676.0))
    particles = 0.0520 * chlorophyll**0.635
    assert blue.absorption - blue.water_absorption == pytest.approx(1.2 * particles, rel=1e-3)
    assert green.scattering - green.water_scattering == pytest.approx(0.416 * chlorophyll**0.766)
    dissolved = 0.2 * particles * math.exp(-0.014 * (676.0 - 440.0))
    assert red.absorption - red.water_absorption == pytest.approx(0.0203 * chlorophyll**0.8223 + dissolved, rel=1e-3)


def test_particles_scatter_blue_light_more_in_clear_water_only():
    def slope(chlorophyll):
        blue, red = (water_optics(at, chlorophyll=chlorophyll) for at in (450.0, 650.0))
        of_particles = (blue.scattering - blue.water_scattering) / (red.scattering - red.water_scattering)
        return math.log(of_particles) / math.log(450.0 / 650.0)

    assert slope(0.02) == pytest.approx(-1.0, abs=1e-3)
    assert slope(0.2) == pytest.approx(0.5 * (math.log10(0.2) - 0.3))
    assert slope(4.0) == 0.0


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ({"wavelength_nm": 399.0}, "wavelength_nm = 399.0 is outside [400, 700]"),
        ({"wavelength_nm": math.nan}, "wavelength_nm = nan"),
        ({"wavelength_nm": 532.0, "chlorophyll": -1.0}, "chlorophyll = -1.0 is outside [0, 30]"),
        ({"wavelength_nm": 532.0, "temperature": 31.0}, "temperature = 31.0 is outside [0, 30]"),
        ({"wavelength_nm": 532.0, "salinity": 41.0}, "salinity = 41.0 is outside [0, 40]"),
    ],
)
def test_values_outside_the_fits_are_refused(arguments, text):
    with pytest.raises(ValueError) as caught:
        water_optics(**arguments)
    assert text in str(caught.value)


def test_a_scene_s_water_follows_its_laser():
    blue = scene({"chlorophyll": 0.5, "temperature": 10.0}, 450.0)
    optics = water_optics(450.0, chlorophyll=0.5, temperature=10.0)
    for name in ("absorption", "scattering", "extinction", "albedo", "phase_index", "group_index"):
        assert getattr(blue.medium, name) == getattr(optics, name), name
    green = blue.with_overrides({"laser.wavelength_nm": 532.0})
    assert green.medium.absorption == water_optics(532.0, chlorophyll=0.5).absorption
    assert green.medium == Medium(chlorophyll=0.5, temperature=10.0)
    assert blue.medium.given == ()
    again = Scene.from_toml(blue.to_toml())
    assert again == blue and again.with_overrides({"laser.wavelength_nm": 532.0}) == green
    pure = water_optics(532.0)
    assert (pure.absorption, pure.scattering) == (pure.water_absorption, pure.water_scattering)


def test_temperature_and_salinity_replace_a_preset_s_indices():
    plain, cold = scene({"preset": "uwoc-clear"}), scene({"preset": "uwoc-clear", "temperature": 0.0})
    assert plain.medium.group_index == 1.3638
    assert cold.medium.group_index == group_index(532.0, temperature=0.0)
    assert (cold.medium.absorption, cold.medium.preset) == (plain.medium.absorption, "uwoc-clear")
    assert plain.with_overrides({"medium.salinity": 0.0}).medium.group_index == group_index(532.0, salinity=0.0)
    assert cold.with_overrides({"medium.group_index": 1.36}).medium.group_index == 1.36


def test_chlorophyll_and_coefficients_displace_each_other():
    green = scene({"preset": "uwoc-clear"}).with_overrides({"medium.chlorophyll": 1.0}).medium
    assert (green.preset, green.absorption) == (None, water_optics(532.0, chlorophyll=1.0).absorption)
    clear = scene({"chlorophyll": 1.0}).with_overrides({"medium.preset": "uwoc-clear"}).medium
    assert (clear.chlorophyll, clear.absorption) == (None, 0.069)
    given = scene({"chlorophyll": 1.0}).with_overrides({"medium": {"absorption": 0.1, "scattering": 0.2}}).medium
    assert (given.chlorophyll, given.extinction) == (None, pytest.approx(0.3))


def findings(one, field):
    return {message.level: message for message in spadwarp.check(one) if message.field == field}


def test_a_preset_at_another_wavelength_is_warned_about():
    blue = scene({"preset": "uwoc-clear"}, 450.0)
    assert findings(blue, "medium.preset")["warning"].values["pure_water"] == pytest.approx(0.00922)
    index = findings(blue, "medium.group_index")["warning"].values
    assert index["group_index"] == group_index(450.0)
    # A gate of 50 ns ends at 5.5 m.
    assert index["error"] == pytest.approx(5.4956 * (group_index(450.0) / 1.3638 - 1.0), rel=1e-4)
    assert not findings(scene({"preset": "uwoc-clear"}), "medium.preset")
    assert not findings(scene({"preset": "uwoc-clear", "temperature": 20.0}, 450.0), "medium.group_index")
    # Beyond the tables it is said without their numbers.
    assert "850 nm" in findings(scene({"preset": "uwoc-clear"}, 850.0), "medium.preset")["warning"].text


@pytest.mark.parametrize("law", [{"anisotropy": 0.924}, {"phase_function": "fournier_forand"}])
@pytest.mark.parametrize("chlorophyll", [0.05, 0.5])
def test_the_water_s_own_scattering_is_in_the_phase_function(chlorophyll, law):
    medium = Medium(chlorophyll=chlorophyll, **law)
    optics = water_optics(532.0, chlorophyll=chlorophyll)
    share = optics.water_scattering / optics.scattering
    particles = spadwarp.scene.phase_function(Medium(extinction=1.0, albedo=0.5, **law))
    both = spadwarp.scene.phase_function(medium)
    angles = np.radians([1.0, 45.0, 90.0, 135.0, 180.0])
    # 3/(4 pi) (1 + delta + (1 - delta) cos^2)/(4 + 2 delta): at 90 degrees 0.0608, at 180 degrees 0.1171 per steradian.
    molecules = 3.0 / (4.0 * np.pi) * (1.039 + 0.961 * np.cos(angles) ** 2) / 4.078
    assert molecules[[2, 4]] == pytest.approx([0.0608, 0.1171], abs=5e-5)
    expected = share * molecules + (1.0 - share) * particles.density(angles)
    np.testing.assert_allclose(both.density(angles), expected, rtol=1e-9)
    assert both.mean_cosine == pytest.approx((1.0 - share) * particles.mean_cosine, rel=1e-4)
    backward = share * 0.5 + (1.0 - share) * particles.backscatter_fraction
    assert both.backscatter_fraction == pytest.approx(backward, rel=1e-4)


def test_light_is_scattered_by_the_water_itself(tmp_path):
    """As by a table of its phase function, and not as by the particles alone."""
    medium, path = Medium(chlorophyll=0.05, anisotropy=0.8), tmp_path / "law.csv"
    angles = np.linspace(0.0, 180.0, 721)
    density = spadwarp.scene.phase_function(medium).density(np.radians(angles))
    np.savetxt(path, np.stack([angles, density], axis=1), delimiter=",")
    numbers = {"extinction": medium.extinction, "albedo": medium.albedo}

    def backscatter(**water):
        one = make_scene(medium={"extinction": None, "albedo": None, **water}, transport={"estimator": "guided"})
        return spadwarp.simulate(one, photons=40_000, seed=1, device="cpu").component("backscatter").sum()

    found = backscatter(chlorophyll=0.05)
    table = backscatter(**numbers, phase_function="tabulated", phase_table=str(path))
    assert found == pytest.approx(table, rel=0.01)
    assert found > 1.5 * backscatter(**numbers)


def test_henyey_greenstein_in_natural_water_is_told():
    """Against the laws' own formulas: molecules with a depolarisation of 0.039, Fournier and Forand."""
    below = [{"start": 2.0, "chlorophyll": 20.0}, {"start": 3.0, "preset": "uwoc-clear"}]
    layers = {"chlorophyll": 0.05, "layers": below}
    found = [one for one in spadwarp.check(scene(layers)) if one.field.endswith("anisotropy")]
    assert [one.field for one in found] == [f"medium.{name}anisotropy" for name in ("", "layers[0].", "layers[1].")]
    b_water, g = pure_water_scattering(532.0, salinity=35.0), 0.924
    molecules, particles = 3 / (4 * math.pi) * 2 / (4 + 2 * 0.039), fournier_forand.density(2.0, 1.10, 3.5835)
    backward = (1 - g) / (2 * g) * ((1 + g) / math.sqrt(1 + g * g) - 1)
    for one, water in zip(found, scene(layers).medium.waters, strict=True):
        share = b_water / water.scattering
        ratio = (share * molecules + (1 - share) * particles) / henyey_greenstein(-1.0, g)
        expected = {"used": backward, "natural": 0.5 * share + (1 - share) * 0.01831, "ratio": ratio}
        assert one.values == pytest.approx(expected, rel=1e-3)
    texts = [one.text.partition("; ")[2] for one in found]
    assert texts[0].startswith("constituents fit: 'rayleigh' with scattering = 0.002 and")
    assert texts[1] == "phase_function = 'fournier_forand' with particle_index = 1.1, junge_slope = 3.5835 fits"
    # With one water of chlorophyll, the molecules are there already, and particles alone fall short.
    (one,) = [one for one in spadwarp.check(scene({"chlorophyll": 0.05})) if one.field == "medium.anisotropy"]
    assert one.values["ratio"] < 1.2 < found[0].values["ratio"] and one.text.endswith(texts[1])
    for silent in (
        *({"preset": name} for name in ("lu2024", "maccarone-3m-7.5", "petzold-autec-8-constituents")),
        *({"absorption": 0.1, "scattering": 0.2}, {"preset": "uwoc-clear", "phase_function": "fournier_forand"}),
    ):
        assert not [one for one in spadwarp.check(scene(silent)) if one.field.endswith("anisotropy")], silent


# Daylight above and below the surface, against published numbers


# sun elevation [°] → direct normal and diffuse horizontal [W/m²/nm]: pvlib 0.16.1, spectrum.spectrl2, day 94 (distance
# factor 0.999636), aerosol 0.084, ozone 0.3438 atm cm, water vapour 1.416 cm, albedo 0.06.
WAVELENGTHS = [450.0, 500.0, 530.0, 550.0, 610.0]
PVLIB = {
    90.0: "1.4564079 1.5021556 1.5253743 1.5441758 1.4534831  0.3201952 0.2387259 0.2059263 0.1889107 0.1375801",
    41.81: "1.2421324 1.3333198 1.3708513 1.3959304 1.3339105  0.2768890 0.2089615 0.1805727 0.1657094 0.1210789",
    20.0: "0.7930034 0.9529407 1.0150932 1.0512190 1.0485957  0.2023525 0.1563513 0.1352896 0.1240562 0.0911652",
}


@pytest.mark.parametrize("elevation", PVLIB)
def test_clear_sky_is_that_of_pvlib(elevation):
    normal, diffuse = np.array(PVLIB[elevation].split(), float).reshape(2, 5)
    sky = clear_sky_irradiance(WAVELENGTHS, sun_elevation_deg=elevation)
    factor = 2.00427086 / 2.005
    assert sky.direct * factor == pytest.approx(normal * math.sin(math.radians(elevation)), rel=2e-6)
    assert sky.diffuse * factor == pytest.approx(diffuse, rel=2e-6)


def test_direct_sun_is_that_of_astm_g173():
    """ASTM G173-03 direct normal and circumsolar at air mass 1.5 (sun at 41.81°) [W/m²/nm]: bands of 10 nm."""
    g173 = {450.0: 1.2881, 500.0: 1.3391, 550.0: 1.3648, 600.0: 1.3278, 650.0: 1.2299}
    direct = clear_sky_irradiance(list(g173), sun_elevation_deg=41.81).direct / math.sin(math.radians(41.81))
    assert direct == pytest.approx(list(g173.values()), rel=0.05)


def test_surface():
    assert surface_reflectance(90.0, 1.34) == pytest.approx((0.34 / 2.34) ** 2)
    brewster = 90.0 - math.degrees(math.atan(1.34))
    # At Brewster's angle half of what is left of one polarisation: ((n² − 1)/(n² + 1))²/2.
    assert surface_reflectance(brewster, 1.34) == pytest.approx(0.5 * ((1.34**2 - 1) / (1.34**2 + 1)) ** 2)
    assert surface_reflectance(1e-6) == pytest.approx(1.0, abs=1e-4)


@pytest.mark.parametrize("chlorophyll", [0.05, 0.2, 1.0, 3.0])
def test_attenuation_of_daylight_in_the_ocean(chlorophyll):
    """K_d(490) = 0.0166 + 0.07242·C^0.68955 (Morel & Maritorena 2001), a fit; here from a and b_b, particles
    scattering 1 % of their light backward."""
    optics = water_optics(490.0, chlorophyll=chlorophyll)
    water = pure_water_scattering(490.0)
    backward = 0.5 * water + 0.01 * (optics.scattering - water)
    expected = 0.0166 + 0.07242 * chlorophyll**0.68955
    assert daylight_attenuation(optics.absorption, backward, sun_elevation_deg=60.0) == pytest.approx(expected, rel=0.2)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("sun_elevation_deg", 0.0),
        ("sun_elevation_deg", 91.0),
        ("aerosol_optical_depth", -1.0),
        ("wavelength_nm", 800.0),
    ],
)
def test_refused(name, value):
    with pytest.raises(ArgumentError, match=name):
        clear_sky_irradiance(**{"wavelength_nm": 532.0, "sun_elevation_deg": 45.0, name: value})
