"""The analytic simulator and photon budgets: numbers without photon transport."""

from spadwarp.analytic.experiment import Proposal, plan
from spadwarp.analytic.exposure_proposal import PILE_UP, Exposure
from spadwarp.analytic.eye_safety import EyeLimit, axis_fluence, eye_limit, permissible_exposure
from spadwarp.analytic.file import AnalyticFile, save_analytic
from spadwarp.analytic.labelled import to_xarray
from spadwarp.analytic.model import model_notes, pixel_maps
from spadwarp.analytic.optics import beam_axis_fluence, scene_eye_limit
from spadwarp.analytic.photon_budget import OUTLIERS, TOLERANCE, BudgetRow, budget
from spadwarp.analytic.pilot import Pilot
from spadwarp.analytic.result import AnalyticResult, background_photons
from spadwarp.analytic.simulate import simulate_analytic
from spadwarp.analytic.sweeps import DepthErrorRow, Sweep, parse_values, parse_vary, sweep

__all__ = [
    "OUTLIERS",
    "PILE_UP",
    "TOLERANCE",
    "AnalyticFile",
    "AnalyticResult",
    "BudgetRow",
    "DepthErrorRow",
    "Exposure",
    "EyeLimit",
    "Pilot",
    "Proposal",
    "Sweep",
    "axis_fluence",
    "background_photons",
    "beam_axis_fluence",
    "budget",
    "eye_limit",
    "model_notes",
    "parse_values",
    "parse_vary",
    "permissible_exposure",
    "pixel_maps",
    "plan",
    "save_analytic",
    "scene_eye_limit",
    "simulate_analytic",
    "sweep",
    "to_xarray",
]
