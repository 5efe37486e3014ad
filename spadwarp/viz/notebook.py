"""Notebooks: a figure by `plot`, a picture with numbers by `html`, how far a call is by `progress_bar`."""

from __future__ import annotations

import base64
import html as markup
import io
import math
import sys
import time
from collections.abc import Callable
from typing import Any, Literal

import numpy as np
from matplotlib.figure import Figure

from spadwarp.analytic import AnalyticResult, Proposal
from spadwarp.checks import summary
from spadwarp.errors import ArgumentError, SpadwarpError
from spadwarp.frames import Frames, FramesFile
from spadwarp.inverse import Fit
from spadwarp.mesh import build_mesh
from spadwarp.result import Result
from spadwarp.scene import Scene
from spadwarp.transport import truth_maps
from spadwarp.units import with_prefix
from spadwarp.viz.result import KINDS, analytic_figure, fit_figure, frame_figure, result_figure, stored_frame_figure
from spadwarp.viz.style import INTENSITY_MAP, PAGE, Panels, paper, shown_limits, spaced

__all__ = ["html", "plot", "progress_bar"]

_PAUSE = 0.2  # between two reports [s]


def progress_bar(unit: str = "photons") -> Callable[[str, int, int], None]:
    """A bar for the argument `progress` of `spadwarp.simulate` and others: one call, one bar.

    In a notebook it is drawn below the cell, elsewhere it is a line of text on standard error.

        spadwarp.simulate(scene, photons=2e6, progress=spadwarp.viz.progress_bar())

    Args:
        unit: What is counted, such as "photons", "frames" or "steps".
    """
    return _Bar(unit)


class _Bar:
    """Called with a stage, the number done and the number to be done, 0 where nothing is counted."""

    def __init__(self, unit: str) -> None:
        self._unit = unit
        self._shown = 0.0
        self._first: tuple[float, int] | None = None  # when counting began, and at what number
        self._handle: Any = None
        self._notebook = _in_notebook()

    def __call__(self, stage: str, done: int, total: int) -> None:
        now = time.monotonic()
        if not total:
            self._show(0.0, "loading kernels; the first run of a kind compiles them" if stage == "compile" else stage)
            return
        if self._first is None:
            self._first = now, done
        if done < total and now - self._shown < _PAUSE:
            return
        self._shown = now
        seconds = now - self._first[0]
        rate = (done - self._first[1]) / seconds if seconds > 0.05 else 0.0
        text = f"{100 * done / total:.0f} %, {done} of {total} {self._unit}"
        if rate:
            left = f"{(total - done) / rate:.0f} s left" if done < total else f"in {seconds:.1f} s"
            text += f", {rate:.3g} {self._unit}/s, {left}"
        self._show(done / total, text)
        if done >= total and not self._notebook:
            print(file=sys.stderr)

    def _show(self, part: float, text: str) -> None:
        if not self._notebook:
            print(f"\r{text:<76}", end="", file=sys.stderr, flush=True)
            return
        from IPython.display import HTML, display

        shown = HTML(f"<progress value='{part:.4f}' max='1'></progress> {markup.escape(text)}")
        if self._handle is None:
            self._handle = display(shown, display_id=True)
        else:
            self._handle.update(shown)


def _in_notebook() -> bool:
    """Whether a kernel of Jupyter runs this."""
    ipython = sys.modules.get("IPython")
    shell = ipython.get_ipython() if ipython is not None else None
    return shell is not None and hasattr(shell, "kernel")


_HTML_DPI = 100


@paper()
def plot(
    shown: Result | Frames | FramesFile | Scene | AnalyticResult | Fit,
    kind: Literal["depth", "intensity", "histogram", "truth"] | None = None,
    *,
    method: Any = "centroid",
    frame: int = 0,
    device: Any = None,
    width: float = PAGE,
) -> Figure:
    """A figure of a result, of frames or of a scene; notebooks show it, `savefig` writes it.

    Args:
        shown: A result: `kind` is "depth" (default), "intensity", "histogram" or "truth". Frames: one of them, from a
            file with its depth. An analytic result: its maps and a frame. A fit: its counts
            and residuals. A scene: true depth and reflectance, by ray casting.
        kind: Of a result's figure.
        method: Estimator of a result's depth.
        frame: Number of the frame.
        device: Warp device.
        width: Of the figure [inch]: 7.2 for a journal's page, 3.5 for its column.

    Raises:
        ArgumentError: Another kind, a frame that is not there, or a width outside [2.5, 50].
        MeshError: A target of the scene cannot be read.
    """
    if isinstance(shown, Result):
        if kind not in (None, *KINDS):
            raise ArgumentError(f"kind = {kind!r} is not one of {', '.join(map(repr, KINDS))}")
        return result_figure(shown, kind or "depth", method=method, device=device, width=width)
    if kind is not None:
        raise ArgumentError(f"kind = {kind!r} needs a result, not a {type(shown).__name__}")
    if isinstance(shown, AnalyticResult):
        return analytic_figure(shown, width)
    if isinstance(shown, Fit):
        return fit_figure(shown, width)
    if isinstance(shown, FramesFile):
        return stored_frame_figure(shown, frame, width)
    if isinstance(shown, Frames):
        return frame_figure(shown, frame, width=width)
    return _scene_figure(shown, device, width)


def html(shown: Result | Frames | Scene | AnalyticResult | Proposal) -> str:
    """A picture, but not of a proposal, and a table of numbers as HTML, for `_repr_html_`."""
    rows = next(of(shown) for kind, of in _ROWS.items() if isinstance(shown, kind))
    cells = "".join(
        f"<tr><th style='text-align:left'>{markup.escape(name)}</th>"
        f"<td style='text-align:left'>{markup.escape(value)}</td></tr>"
        for name, value in rows.items()
    )
    if isinstance(shown, Proposal):
        return f"<div><b>{markup.escape(repr(shown))}</b><table>{cells}</table></div>"
    try:
        picture = f"<img src='data:image/png;base64,{_png(plot(shown))}' style='max-width:100%'>"
    except SpadwarpError as error:  # a mesh that is not there, no device: the numbers are still of use
        picture = f"<p>{markup.escape(str(error))}</p>"
    name = markup.escape(repr(shown))
    return f"<div><b>{name}</b>{picture}<table>{cells}</table></div>"


def _png(figure: Figure) -> str:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=_HTML_DPI)
    return base64.b64encode(buffer.getvalue()).decode("ascii")


# Figures


def _scene_figure(scene: Scene, device: Any, width: float) -> Figure:
    truth = truth_maps(scene, device=device)
    panels = Panels(truth.depth.shape, 2, width=width)
    panels.show_depth(truth.depth, "Truth", shown_limits(truth.depth))
    panels.show(truth.reflectance, "Reflectance", "Lambertian reflectance", INTENSITY_MAP, (0.0, 1.0))
    panels.caption(repr(scene))
    return panels.figure


# Numbers


def _result_rows(result: Result) -> dict[str, str]:
    numbers = result.summary()
    gate, depth, energy = numbers["gate"], numbers["truth"]["depth_m"], numbers["energy_balance"]
    fractions = ", ".join(
        f"{name.replace('_', '-')} {part:.3g}" for name, part in numbers["collected_fraction"].items()
    )
    return {
        "photons": f"{spaced(result.photons)}, seed {result.seed}" + (", interrupted" if result.partial else ""),
        "image": f"{numbers['image']['width']} x {numbers['image']['height']} pixels",
        "gate": f"{gate['bins']} bins of {gate['bin_width_ps']:.5g} ps from {gate['start_ns']:.5g} ns",
        "truth": "no target" if depth is None else f"{depth[0]:.4g} to {depth[1]:.4g} m",
        "collected": f"{fractions} of the emitted light",
        "detections": f"{numbers['detections_per_pulse']:.4g} a pulse, all pixels",
        "energy balance": "exact" if energy["exact"] else f"off by {energy['difference']} units",
    }


def _frames_rows(frames: Frames) -> dict[str, str]:
    counts = np.asarray(frames.intensity)
    return {
        "frames": f"{frames.frames} of {spaced(frames.pulses)} pulses" + (", added up" if frames.summed else ""),
        "counts": f"{float(counts.mean()):.4g} a pixel, at most {int(counts.max())}",
        "gate": f"{frames.expected.shape[-1]} bins of {1e12 * frames.bin_width:.5g} ps from "
        f"{1e9 * frames.gate_start:.5g} ns",
        "pulse period": "time does not wrap" if frames.period is None else with_prefix(frames.period, "s"),
        "response": f"{1e12 * frames.irf.fwhm:.4g} ps FWHM",
        "seed": str(frames.seed),
        **{f"note {number}": note for number, note in enumerate(frames.notes, 1)},
    }


def _scene_rows(scene: Scene) -> dict[str, str]:
    laser, camera, gate = scene.laser, scene.camera, scene.gate
    rows = {
        "water": f"extinction {scene.medium.extinction:.4g} 1/m, attenuation length "
        f"{scene.medium.attenuation_length:.4g} m, {scene.medium.phase_function.replace('_', ' ')}",
        "laser": f"{with_prefix(laser.pulse_energy, 'J')} at {with_prefix(laser.repetition_rate, 'Hz')}, "
        f"{laser.wavelength_nm:g} nm, {laser.pulse_fwhm_ps:g} ps",
        "camera": f"{camera.width} x {camera.height} pixels, {math.degrees(camera.horizontal_fov):.3g}° across, "
        f"aperture {2e3 * camera.aperture_radius:.3g} mm",
        "detector": f"efficiency {100 * scene.detector.pde:.3g} %, jitter {scene.detector.jitter_fwhm_ps:g} ps, "
        f"{scene.detector.dark_count_rate:g} dark counts per second",
        "gate": f"{gate.bins} bins of {gate.bin_width_ps:g} ps from {gate.start_ns:g} ns",
    }
    try:
        numbers = summary(scene, build_mesh(scene))
    except SpadwarpError:
        return rows
    if numbers["target_range"] is not None:
        rows["target"] = (
            f"{numbers['target_range'][0]:.4g} to {numbers['target_range'][1]:.4g} m, optical depth "
            f"{numbers['optical_depth']:.3g}, {numbers['signal_per_pulse']:.3g} unscattered detections a "
            "pulse and pixel"
        )
    return rows


def _analytic_rows(result: AnalyticResult) -> dict[str, str]:
    estimated = result.fisher > 0
    if not estimated.any():
        return {"pixels": "none has an estimate"}
    chosen = result.scene.analytic
    return {
        "pixels": f"{np.count_nonzero(estimated)} of {estimated.size} have an estimate",
        "signal": f"{float(np.median(result.signal[estimated])):.4g} detections a pulse and pixel, median",
        "bound": f"{1e3 * float(np.median(result.sigma_depth[estimated])):.4g} mm of depth, median",
        "outliers": f"{100 * float(np.mean(result.outlier_probability[estimated])):.3g} %, mean",
        "model": f"form {chosen.form}, backscatter {chosen.backscatter}, {chosen.count_law}",
    }


def _proposal_rows(found: Proposal) -> dict[str, str]:
    rows = {name: f"{value:.6g}" for name, value in found.values.items()}
    rows |= {name: with_prefix(value, "m") for name, value in found.terms.items()}
    rows["reached"] = f"{'yes' if found.reached else 'no'}: asked for {with_prefix(found.depth_error, 'm')}"
    rows |= {"limit": found.limit, "what would help": found.advice}
    if math.isfinite(found.largest_range):
        rows["largest range"] = f"{found.largest_range:.3g} m; {found.range_limit}"
    return rows


_ROWS: dict[Any, Callable[[Any], dict[str, str]]] = {
    Result: _result_rows,
    Frames: _frames_rows,
    Scene: _scene_rows,
    AnalyticResult: _analytic_rows,
    Proposal: _proposal_rows,
}
