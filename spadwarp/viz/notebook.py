"""Notebooks: a picture with numbers by `html`, how far a call is by `progress_bar`."""

from __future__ import annotations

import base64
import html as markup
import io
import math
import sys
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from spadwarp.analytic import AnalyticResult, Proposal
from spadwarp.checks import summary
from spadwarp.frames import Frames
from spadwarp.mesh import build_mesh
from spadwarp.result import Result
from spadwarp.scene import Scene
from spadwarp.values import SpadwarpError, with_prefix
from spadwarp.viz.result import plot
from spadwarp.viz.style import spaced

__all__ = ["html", "progress_bar"]

_PAUSE = 0.2  # between two reports [s]


def progress_bar(unit: str = "photons") -> Callable[[str, int, int], None]:
    """A bar for the argument `progress` of `spadwarp.simulate` and others: one call, one bar.

    In a notebook it is drawn below the cell, elsewhere it is a line of text on standard error.

        spadwarp.simulate(scene, photons=2e6, progress=spadwarp.viz.progress_bar())

    Args:
        unit: What is counted, such as "photons", "frames" or "steps".
    """
    show, in_notebook = _display() if _in_notebook() else _print, _in_notebook()
    begun: list[tuple[float, int]] = []  # when counting began, and at what number
    shown = 0.0

    def report(stage: str, done: int, total: int) -> None:
        nonlocal shown
        now = time.monotonic()
        if not total:
            show(0.0, "loading kernels; the first run of a kind compiles them" if stage == "compile" else stage)
            return
        if not begun:
            begun.append((now, done))
        if done < total and now - shown < _PAUSE:
            return
        shown = now
        seconds = now - begun[0][0]
        text = f"{100 * done / total:.0f} %, {done} of {total} {unit}"
        if seconds > 0.05 and done > begun[0][1]:
            rate = (done - begun[0][1]) / seconds
            left = f"{(total - done) / rate:.0f} s left" if done < total else f"in {seconds:.1f} s"
            text += f", {rate:.3g} {unit}/s, {left}"
        show(done / total, text)
        if done >= total and not in_notebook:
            print(file=sys.stderr)

    return report


def _in_notebook() -> bool:
    """Whether a kernel of Jupyter runs this."""
    ipython = sys.modules.get("IPython")
    return hasattr(ipython.get_ipython(), "kernel") if ipython is not None else False


def _print(part: float, text: str) -> None:
    print(f"\r{text:<76}", end="", file=sys.stderr, flush=True)


def _display() -> Callable[[float, str], None]:
    """Shows a bar below the cell, at first a new one."""
    from IPython.display import HTML, display

    handle: Any = None

    def show(part: float, text: str) -> None:
        nonlocal handle
        bar = HTML(f"<progress value='{part:.4f}' max='1'></progress> {markup.escape(text)}")
        if handle is None:
            handle = display(bar, display_id=True)
        else:
            handle.update(bar)

    return show


def html(shown: Result | Frames | Scene | AnalyticResult | Proposal) -> str:
    """A picture, but not of a proposal, and a table of numbers as HTML, for `_repr_html_`."""
    rows = next(of(shown) for kind, of in _ROWS.items() if isinstance(shown, kind))
    style = "style='text-align:left'"
    cells = "".join(
        f"<tr><th {style}>{markup.escape(name)}</th><td {style}>{markup.escape(value)}</td></tr>"
        for name, value in rows.items()
    )
    picture = ""
    try:
        if not isinstance(shown, Proposal):
            buffer = io.BytesIO()
            plot(shown).savefig(buffer, format="png", dpi=100)
            data = base64.b64encode(buffer.getvalue()).decode("ascii")
            picture = f"<img src='data:image/png;base64,{data}' style='max-width:100%'>"
    except SpadwarpError as error:  # a mesh that is not there, no device: the numbers are still of use
        picture = f"<p>{markup.escape(str(error))}</p>"
    return f"<div><b>{markup.escape(repr(shown))}</b>{picture}<table>{cells}</table></div>"


# Numbers


def _result_rows(result: Result) -> dict[str, str]:
    numbers = result.summary()
    depth, energy = numbers["truth"]["depth_m"], numbers["energy_balance"]
    parts = ", ".join(f"{name.replace('_', '-')} {part:.3g}" for name, part in numbers["collected_fraction"].items())
    return {
        "photons": f"{spaced(result.photons)}, seed {result.seed}" + (", interrupted" if result.partial else ""),
        "image": f"{numbers['image']['width']} x {numbers['image']['height']} pixels",
        "gate": _gate_text(**numbers["gate"]),
        "truth": "no target" if depth is None else f"{depth[0]:.4g} to {depth[1]:.4g} m",
        "collected": f"{parts} of the emitted light",
        "detections": f"{numbers['detections_per_pulse']:.4g} a pulse, all pixels",
        "energy balance": "exact" if energy["exact"] else f"off by {energy['difference']} units",
    }


def _gate_text(bins: int, bin_width_ps: float, start_ns: float, **_: Any) -> str:
    return f"{bins} bins of {bin_width_ps:.5g} ps from {start_ns:.5g} ns"


def _frames_rows(frames: Frames) -> dict[str, str]:
    counts = np.asarray(frames.intensity)
    return {
        "frames": f"{frames.frames} of {spaced(frames.pulses)} pulses" + (", added up" if frames.summed else ""),
        "counts": f"{float(counts.mean()):.4g} a pixel, at most {int(counts.max())}",
        "gate": _gate_text(frames.expected.shape[-1], 1e12 * frames.bin_width, 1e9 * frames.gate_start),
        "pulse period": "time does not wrap" if frames.period is None else with_prefix(frames.period, "s"),
        "response": f"{1e12 * frames.irf.fwhm:.4g} ps FWHM",
        "seed": str(frames.seed),
        **{f"note {number}": note for number, note in enumerate(frames.notes, 1)},
    }


def _scene_rows(scene: Scene) -> dict[str, str]:
    water, laser, camera, gate = scene.medium, scene.laser, scene.camera, scene.gate
    rows = {
        "water": f"extinction {water.extinction:.4g} 1/m, attenuation length {water.attenuation_length:.4g} m, "
        f"{water.phase_function.replace('_', ' ')}",
        "laser": f"{with_prefix(laser.pulse_energy, 'J')} at {with_prefix(laser.repetition_rate, 'Hz')}, "
        f"{laser.wavelength_nm:g} nm, {laser.pulse_fwhm_ps:g} ps",
        "camera": f"{camera.width} x {camera.height} pixels, {math.degrees(camera.horizontal_fov):.3g}° across, "
        f"aperture {2e3 * camera.aperture_radius:.3g} mm",
        "detector": f"efficiency {100 * scene.detector.pde:.3g} %, jitter {scene.detector.jitter_fwhm_ps:g} ps, "
        f"{scene.detector.dark_count_rate:g} dark counts per second",
        "gate": _gate_text(gate.bins, gate.bin_width_ps, gate.start_ns),
    }
    try:
        numbers = summary(scene, build_mesh(scene))
    except SpadwarpError:
        return rows
    if numbers["target_range"] is not None:
        near, far = numbers["target_range"]
        rows["target"] = (
            f"{near:.4g} to {far:.4g} m, optical depth {numbers['optical_depth']:.3g}, "
            f"{numbers['signal_per_pulse']:.3g} unscattered detections a pulse and pixel"
        )
    return rows


def _analytic_rows(result: AnalyticResult) -> dict[str, str]:
    estimated, chosen = result.fisher > 0, result.scene.analytic
    if not estimated.any():
        return {"pixels": "none has an estimate"}
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
