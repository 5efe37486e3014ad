"""Published Stokes vectors of what Rayleigh-scattering slabs reflect.

Azimuths φ of the directions of propagation, anticlockwise seen from above; Q = ⟨E_φ² − E_θ²⟩ and U = 2⟨E_θ·E_φ⟩, with
θ̂ and φ̂ of increasing zenith angle and azimuth, at the zenith those of the meridian φ.

Rows: face, µ, azimuth of propagation from that of the beam [°], I, Q, U for a flux of π; without depolarisation.
Natraj, Li & Yung (2009, ApJ 691, 1909), which corrects Coulson, Dave & Sekera (1960); Natraj & Hovenier (2012, ApJ 748,
28), whose Q and U have the other sign; Kokhanovsky et al. (2010, JQSRT 111, 1931), scaled from π·I/(µ0·F).
"""

from dataclasses import dataclass

UPPER = "upper"
Row = tuple[str, float, float, float, float, float]


@dataclass(frozen=True)
class Table:
    """Values of one slab; `digits` is the largest error of a value."""

    source: str
    optical_depth: float
    mu0: float
    ground: float
    digits: float
    rows: tuple[Row, ...]


def _hovenier(rows: tuple[Row, ...]) -> tuple[Row, ...]:
    return tuple((face, mu, phi, i, -q, -u) for face, mu, phi, i, q, u in rows)


TABLES = (
    Table("Natraj et al. 2009", 0.5, 0.2, 0.0, 1e-8, (
        (UPPER, 0.02, 0.0, 0.44129802, -0.01753141, 0.0),
        (UPPER, 0.02, 60.0, 0.30091208, -0.15965601, 0.07365528),
        (UPPER, 0.10, 90.0, 0.21348201, -0.16821107, 0.06357361),
        (UPPER, 0.10, 180.0, 0.36354469, -0.02795997, 0.0),
        (UPPER, 0.40, 0.0, 0.16889020, 0.01119511, 0.0),
        (UPPER, 0.40, 60.0, 0.12752450, -0.06066038, 0.05293867),
        (UPPER, 1.00, 0.0, 0.05300496, 0.03755859, 0.0),
        (UPPER, 1.00, 60.0, 0.05300496, -0.01877930, 0.03252669),
    )),
    Table("Kokhanovsky et al. 2010", 0.3262, 0.5, 0.0, 1e-6, tuple(
        (face, mu, phi, 0.5 * i, 0.5 * q, 0.5 * u) for face, mu, phi, i, q, u in (
            (UPPER, 1.0, 0.0, 0.1433981, 0.07253129, 0.0),
            (UPPER, 0.7660444431, 0.0, 0.1560517, 0.1140612, 0.0),
            (UPPER, 0.7660444431, 90.0, 0.1746397, -0.08605730, 0.07322031),
            (UPPER, 0.0174524064, 90.0, 0.5458706, -0.2592859, 0.3917105),
        )
    )),
    Table("Natraj et al. 2009", 1.0, 0.6, 0.8, 1e-8, (
        (UPPER, 0.20, 60.0, 0.49089856, -0.03578087, 0.20191494),
        (UPPER, 0.52, 0.0, 0.47725195, 0.11269547, 0.0),
        (UPPER, 0.84, 120.0, 0.50469021, -0.06450226, 0.00462844),
        (UPPER, 1.00, 0.0, 0.46917958, 0.06476738, 0.0),
    )),
    Table("Natraj & Hovenier 2012", 2.0, 0.5, 0.25, 1e-8, _hovenier((
        (UPPER, 0.10, 0.0, 0.52908133, -0.03666586, 0.0),
        (UPPER, 0.10, 90.0, 0.38996680, 0.14594872, -0.20141378),
        (UPPER, 0.50, 180.0, 0.49055823, 0.03618719, 0.0),
        (UPPER, 0.90, 90.0, 0.28930984, 0.08588871, -0.04780830),
        (UPPER, 1.00, 0.0, 0.27723461, -0.08017274, 0.0),
    ))),
)  # fmt: skip
