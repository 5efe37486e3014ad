"""The analytic simulator and photon budgets: numbers without photon transport."""

from spadwarp.analytic.model import pixel_maps
from spadwarp.analytic.photon_budget import OUTLIERS, TOLERANCE, BudgetRow, budget
from spadwarp.analytic.result import AnalyticResult, background_photons
from spadwarp.analytic.simulate import simulate_analytic
from spadwarp.analytic.sweeps import DepthErrorRow, Sweep, parse_vary, sweep

__all__ = [
    "OUTLIERS",
    "TOLERANCE",
    "AnalyticResult",
    "BudgetRow",
    "DepthErrorRow",
    "Sweep",
    "background_photons",
    "budget",
    "parse_vary",
    "pixel_maps",
    "simulate_analytic",
    "sweep",
]
