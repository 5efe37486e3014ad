"""The section `detector`."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal, Self

from pydantic import Field, model_validator

from spadwarp.scene.sections import CsvFile, FilePath, Section, Whole

__all__ = ["Detector"]


class Detector(Section):
    """The SPAD array and its timing electronics."""

    section: ClassVar[str] = "detector"
    preset: str | None = None
    """a named detector, see `spadwarp list presets detector`"""
    pdp: float = Field(0.247, ge=0, le=1)
    """photon detection probability of the active area"""
    fill_factor: float = Field(0.2, gt=0, le=1)
    """active part of a pixel's area, microlenses included"""
    jitter_fwhm_ps: float = Field(200.0, ge=0, le=1e12)
    """timing jitter, full width at half maximum [ps]"""
    irf: Annotated[str, FilePath(".csv", ("gaussian", "exponentially_modified_gaussian"))] = "gaussian"
    """instrument response: "gaussian", "exponentially_modified_gaussian", or the path of a .csv file"""
    irf_tail_ps: float = Field(100.0, ge=1e-12, le=1e12)
    """time constant of the exponential tail [ps]"""
    dark_count_rate: float = Field(100.0, ge=0, le=1e15)
    """median dark counts per second and pixel [1/s]"""
    dark_count_spread: float = Field(0.0, ge=0, le=10)
    """relative (log-normal) spread of the dark count rate over pixels"""
    hot_pixel_fraction: float = Field(0.0, ge=0, le=1)
    """part of the pixels that are hot"""
    hot_pixel_rate: float = Field(1e4, ge=0, le=1e15)
    """dark count rate of a hot pixel [1/s]"""
    ambient_rate: float = Field(0.0, ge=0, le=1e15)
    """detected background counts per second and pixel [1/s]"""
    filter_centre_nm: float | None = Field(None, ge=1e-9, le=1e6)
    """wavelength of largest transmission of the filter before the detector [nm]; default: the laser's"""
    filter_fwhm_nm: float | None = Field(None, ge=1e-6, le=1e6)
    """full width at half maximum of its Gaussian transmission [nm]; without it there is no filter"""
    filter_peak: float = Field(1.0, gt=0, le=1)
    """its largest transmission"""
    filter_table: CsvFile = None
    """a measured filter in place of these: .csv file of wavelength [nm] and transmission"""
    mode: Literal["first_photon", "free_running"] = "first_photon"
    """one count a pulse, or as many as come"""
    dead_time_ns: float = Field(0.0, ge=0, le=1e12)
    """dead time after a count, free-running [ns]"""
    afterpulsing_probability: float = Field(0.0, ge=0, lt=1)
    """probability that a count causes another"""
    afterpulsing_time_constant_ns: float = Field(50.0, ge=1e-12, le=1e12)
    """decay time of afterpulsing [ns]"""
    crosstalk_probability: float = Field(0.0, ge=0, lt=1)
    """probability that a count fires a neighbour"""
    wrap: bool = True
    """time of flight modulo the pulse period (range aliasing), as a detector sees it"""
    pulses_per_frame: Whole = Field(20_000, ge=1, le=2**63 - 1)
    """laser pulses in one frame of counts"""
    max_count: Whole = Field(0, ge=0, le=2**31 - 1)
    """largest count a histogram bin holds; 0 is unlimited"""

    @model_validator(mode="after")
    def _one_filter(self) -> Self:
        for name in ("filter_centre_nm", "filter_fwhm_nm", "filter_peak"):
            if getattr(self, name) == Detector.model_fields[name].default:
                continue
            if self.filter_table is not None:
                self._refuse(name, "cannot be combined with filter_table")
            if self.filter_fwhm_nm is None:
                self._refuse(name, "needs filter_fwhm_nm")
        return self

    @property
    def has_filter(self) -> bool:
        """Whether there is a filter before the detector."""
        return self.filter_fwhm_nm is not None or self.filter_table is not None

    @property
    def pde(self) -> float:
        """Photon detection efficiency: PDP × fill factor; the filter's transmission is left out."""
        return self.pdp * self.fill_factor

    @property
    def noise_rate(self) -> float:
        """Mean counts per second and pixel without light of the laser: dark counts and ambient light [1/s]."""
        return self.dark_count_rate + self.ambient_rate
