"""Daylight above and below the surface, against published numbers."""

import math

import numpy as np
import pytest

from spadwarp.values import ArgumentError
from spadwarp.water import (
    clear_sky_irradiance,
    daylight_attenuation,
    pure_water_scattering,
    surface_reflectance,
    water_optics,
)

pytestmark = pytest.mark.fast

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
