"""Commands that plan: `check`, `plan`, `sweep`, `water`."""

from __future__ import annotations

import dataclasses
import math
import operator
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

import spadwarp
from spadwarp.cli import options as opt
from spadwarp.cli.app import complain, note, running, say, wrong
from spadwarp.cli.options import command
from spadwarp.cli.outputs import answer, check_outputs, progress, readable, rows, short, show_table, write_json, written
from spadwarp.values import count, with_prefix

if TYPE_CHECKING:
    from spadwarp import Scene
    from spadwarp.analytic import BudgetRow, PlanRow, Proposal
    from spadwarp.water import ParticleOptics


@command()
def check(
    scene: Path, *, mesh: Path | None = None, picture: Path | None = None, overrides: list[str] | None = None
) -> None:
    """Validate a scene without running it; warn with numbers.

    Exit code 0 with or without warnings, 2 for a scene that is not valid.

    Args:
        picture: Draw the water cut open, with laser, camera and targets.

    \b
    Examples:
      spadwarp check configs/scenes/harbour_5m.toml --set medium.extinction=2.5
      spadwarp check sediment_4m --picture water.png
    """
    read = opt.read_scene(scene, overrides, mesh=mesh)
    check_outputs(files={"--picture": picture}, inputs=(scene, *read.files))
    triangles = spadwarp.mesh.build_mesh(read)
    messages = spadwarp.check(read, triangles)
    numbers = {"faces": 0 if triangles is None else triangles.face_count, **spadwarp.checks.summary(read, triangles)}
    say(readable(numbers) + "\n")
    for message in messages:
        (typer.echo if message.level == "warning" else say)(str(message))  # a warning also with --quiet
    if not any(message.level == "warning" for message in messages):
        say(f"{scene}: valid, no warnings")
    if picture is not None:
        spadwarp.viz.draw_water(read, picture, triangles)
        say(f"written: {picture}")
    write_json({"scene": scene, **numbers, "messages": [dataclasses.asdict(message) for message in messages]})


def _warnings(scene: Scene, but: str = "") -> list[str]:
    """What `check` warns of, but for what a plan proposes or traces otherwise, and for fields that begin so."""
    found = (message for message in spadwarp.check(scene) if message.level == "warning")
    own = ("transport", *filter(None, [but]))
    return [str(one) for one in found if not one.field.startswith(own) and "outside the gate" not in one.text]


_Range = Annotated[tuple[float, float], opt.from_to("m")]


@command(prints_result=True)
def plan(
    scene: Path,
    *,
    depth_error: opt.DepthError = 0.01,
    time: opt.Seconds = 1.0,
    range_: _Range | None = None,
    margin: opt.Length = 0.25,
    method: opt.Method = "likelihood",
    full_power: bool = False,
    eye_distance: opt.Length | None = None,
    eye_exposure: opt.Seconds = 100.0,
    photons: opt.Photons | None = None,
    seed: int = 0,
    no_range: bool = False,
    channel: opt.Channel = "I",
    write: Path | None = None,
    mesh: Path | None = None,
    overrides: list[str] | None = None,
    device: str | None = None,
) -> None:
    """Gate, pulses and laser power for a depth error, and what limits it.

    A short Monte Carlo run of a window of the image measures the light. The Cramér–Rao bound falls with the pulses;
    forward scattering leaves an error that does not. The limit for the eye is a guide, after IEC 60825-1:2014.

    Args:
        depth_error (LENGTH): Depth error asked for, such as "1cm" [m].
        time (TIME): Longest time for a depth frame [s].
        range_ (FROM:TO): Where the target may be, such as 80cm:1.2m [m]; a plane at TO then stands for it. By default
            the scene's targets.
        margin (LENGTH): Water in the gate before and behind it [m].
        method: Estimator whose error counts.
        full_power: Take the largest pulse energy within the limits.
        eye_distance (LENGTH): Also keep the pulse energy safe for an eye at this distance from the laser [m].
        eye_exposure (TIME): How long the eye looks into the beam [s].
        photons (N|auto): Photons of the Monte Carlo run. By default auto: as many as judge, or 60 s of tracing.
        no_range: Do not look for the largest range.
        write: Scene file to write with the proposed values.

    \b
    Examples:
      spadwarp plan configs/scenes/staircase_5m.toml --depth-error 1cm --write planned.toml
      spadwarp plan configs/scenes/harbour_5m.toml --range 2:3 --time 100ms --eye-distance 1m
    """
    read = opt.read_scene(scene, overrides, mesh=mesh)
    check_outputs(files={"--write": write}, inputs=(scene, *read.files))
    for text in _warnings(read, but="targets" if range_ else ""):
        complain(text)
    found = spadwarp.plan(
        read,
        depth_error=depth_error,
        time=time,
        ranges=range_,
        margin=margin,
        method=method,
        full_power=full_power,
        eye_distance=eye_distance,
        eye_exposure=eye_exposure,
        photons="auto" if photons is None else photons,
        seed=seed,
        largest_range=not no_range,
        channel=channel,
        device=device,
        progress=progress(),
    )
    files = [] if write is None else [write]
    for file in files:
        made = f"# Proposed by `spadwarp plan {scene.name} --depth-error {depth_error:g}`: {_verdict(found)}\n\n"
        spadwarp.io.write_text(made + found.scene.to_toml(folder=file.parent), file)
    say(_verdict(found))
    hidden = ["pilot", "terms", "advice", "limit", "largest_range", "range_limit", "pulses_range", "unjudged_ranges"]
    hidden += ["photons_needed", "seconds_needed"]
    hidden += [] if found.judged else ["pulses", "pulses_for", "frame_time", "reached", "pile_up_energy"]
    told = {name: value for name, value in found.to_dict().items() if value == value and value != ""}
    values = {name: value for name, value in told.items() if name not in hidden}
    values["eye"] = {name: value for name, value in values["eye"].items() if value == value}
    if not found.judged:
        del values["values"]["detector.pulses_per_frame"]
    say(readable(values))
    if found.range_limit:
        farthest = f"{found.largest_range:.3g} m; " if found.largest_range == found.largest_range else ""
        shorter = found.reached and not found.unjudged_ranges and found.largest_range < found.target_range[0]
        full = (
            "; nearer than the target: a plane that fills the view scatters more light into a pixel" if shorter else ""
        )
        say(f"largest range, for a plane square to the optical axis: {farthest}{found.range_limit}{full}")
    if found.judged:
        say(rows(_terms(found)))
        say(f"What would help: {found.advice}.")
    for file in files:
        say(f"written: {file}")
    write_json({"scene": scene, **found.to_dict(), "files": files})


def _verdict(found: Proposal) -> str:
    """One sentence; where the pixels that were measured see several surfaces, a second."""
    asked, total = with_prefix(found.depth_error, "m"), with_prefix(found.terms["total"], "m")
    if not found.judged:
        traced = found.pilot.photons
        return f"A depth error of {asked}: not enough photons to judge, {traced:.1e} were traced; {found.more_photons}."
    least, most = found.pulses_range
    between = f" ({count(least)} to {count(most)})" if most > 1.3 * least else ""
    pulses = f"{count(found.pulses)} pulses{between}, {with_prefix(found.frame_time, 's')}"
    if found.pulses_for == "false peaks":
        pulses += ", for fewer than 1 % false peaks"
    if found.reached:
        text = f"is reached with {pulses} ({total})"
    elif found.pulses_for in ("depth error", "false peaks"):
        text = f"takes {pulses}, more than {with_prefix(found.time, 's')}"
    else:
        few = found.pulses_for == "out of reach"
        text = f"is out of reach: {'2^31 pulses are too few' if few else f'{total} with {pulses}'}"
    sentence = f"A depth error of {asked} {text}; limit: {found.limit}."
    if len(found.pilot.surfaces) > 1:
        depths = ", ".join(f"{depth:.3g}" for depth in found.pilot.surfaces)
        sentence += f" Edges near the axis, between depths of {depths} m: a frame's median may be less or more."
    return sentence


def _terms(found: Proposal) -> dict[str, str]:
    """The parts of the depth error at the proposed pulses."""
    pilot = found.pilot
    floors = ", ".join(f"{name} {1000 * value:.3g}" for name, value in pilot.floor.items() if name != found.method)
    alone = pilot.unscattered_floor[found.method]
    unscattered = f"unscattered light alone: {1000 * alone:.3g}" if alone < math.inf else "all light is scattered"
    about = {
        "shot noise": "falls with the root of the pulses",
        "background": "backscatter, dark counts, ambient light; falls likewise",
        "Cramér–Rao bound": "both together: the least error of an unbiased estimator",
        "estimator": f"noise of {found.method} beyond the bound",
        "forward scattering": f"{found.method}; does not fall with the pulses; {floors}; from {count(pilot.photons)} "
        f"traced photons; {unscattered}",
        "pile-up": "change of the median depth",
        "total": "root of the sum of squares, near the axis; `spadwarp detect` reports the median of the whole frame",
    }
    title = f"depth error, {count(found.pulses)} pulses"
    return {title: "mm"} | {name: f"{short(1000 * value):<6}  {about[name]}" for name, value in found.terms.items()}


@command(prints_result=True)
def sweep(
    scene: Path,
    *,
    vary: list[str] | None = None,
    medium: list[str] | None = None,
    reflectance: float | None = None,
    of: Literal["budget", "plan"] | None = None,
    depth_error: opt.DepthError = 0.01,
    time: opt.Seconds = 1.0,
    method: opt.Method = "likelihood",
    photons: int | None = None,
    seed: int = 0,
    no_range: bool = False,
    out: Path | None = None,
    overrides: list[str] | None = None,
    device: str | None = None,
) -> None:
    """Photon budget over range and water, or the plan of an experiment over any fields of the scene.

    A budget is analytic, of unscattered light, per pulse and pixel. Where a return misses the scene's gate, gates as
    long follow the returns, marked *. A plan is that of `spadwarp plan` for each combination of values: pulses for the
    depth error, the bound with the pulses of the scene's own depth frame, the largest range, what limits the error.

    Args:
        vary (FIELD=VALUES): Field, and FROM:TO:N (with :log a geometric progression) or A,B,C, with units or words; may
            be repeated. By default "range" of a surface on the optical axis, 1 to 50 m. A plan also takes
            camera.analyser=none,co,cross (to the laser's polarisation), and none for the preset of a port.
        medium: With range: a named water; may be repeated. By default the scene's.
        reflectance: With range: of the surface; by default that of the first target.
        of: By default a budget; a plan where several fields vary, or with an option of plans.
        depth_error (LENGTH): Of a plan, asked for [m].
        time (TIME): Of a plan, the longest for a depth frame [s].
        method: Of a plan, the estimator whose error counts.
        photons: Of a plan, for each combination. By default as many as judge, or 60 s.
        no_range: Of a plan: do not look for the largest range.
        out (DIR): Directory for sweep.png and sweep.csv; with a budget over range, budget.png and budget.csv.

    \b
    Examples:
      spadwarp sweep configs/scenes/harbour_5m.toml --vary range=1:10:10 --medium petzold-nuc-2240 --medium uwoc-clear
      spadwarp sweep staircase_5m --set medium.chlorophyll=0.5 --set laser.polarisation=linear --no-range \\
          --vary laser.wavelength_nm=480,532 --vary camera.analyser=none,cross --out sweep/
    """
    read, texts = opt.read_scene(scene, overrides), vary or ["range="]
    of_plans = "--depth-error", "--time", "--method", "--photons", "--seed", "--no-range"
    asked = any(option in running.given for option in of_plans)
    of = of or ("plan" if asked or len(texts) > 1 or texts[0].strip().startswith("camera.analyser") else "budget")
    of_range = of == "budget" and len(texts) == 1 and texts[0].partition("=")[0].strip() == "range"
    if not of_range:
        opt.refuse("is for a budget over range: --vary range=FROM:TO:N", "--medium", "--reflectance")
    if of == "budget":
        opt.refuse("is for --of plan", *of_plans)
    stem = "budget" if of_range else "sweep"
    check_outputs(out, (f"{stem}.png", f"{stem}.csv"), inputs=(scene, *read.files))
    summary: dict[str, Any] = {}
    found: Any
    lines: Any
    draw: Any
    if of_range:
        values = spadwarp.analytic.parse_vary(texts[0])[1] if vary else None
        opt.warn_of(read)
        lines = found = spadwarp.budget(read, values, medium or None, reflectance=reflectance, device=device)
        keys, draw = [{"water": row.medium} for row in found], spadwarp.viz.draw_budget
    else:
        _, chosen = spadwarp.analytic.combinations(read, texts, planned=of == "plan")
        # A check takes a while: of each value one scene, not of all combinations, and of ranges one in all.
        once = [one for values, one, _ in chosen if sum(map(operator.ne, values, chosen[0][0])) <= 1]
        once = [one for k, one in enumerate(once) if one not in once[:k]]
        for text in dict.fromkeys(text for changed in once for text in _warnings(changed)):
            complain(text)
        planned: dict[str, Any] = {"depth_error": depth_error, "time": time, "method": method, "seed": seed}
        show = None if of == "budget" else lambda name, done, all: note(f"{name} ({done + 1} of {all})")
        planned |= {"photons": photons or "auto", "largest_range": not no_range, "progress": show}
        found = spadwarp.sweep(read, vary=texts, of=of, device=device, **planned)
        lines, draw = found.rows, spadwarp.viz.draw_sweep
        keys = [dict(zip(found.fields, value, strict=True)) for value in found.values]
        summary = {"fields": found.fields, "values": found.values, "of": of}
    plain = [dataclasses.asdict(row) for row in lines]
    files = []
    if out is not None:
        draw(found, out / f"{stem}.png")
        table = plain if of_range else [{**key, **row} for key, row in zip(keys, plain, strict=True)]
        files = [out / f"{stem}.png", spadwarp.io.write_csv(table, out / f"{stem}.csv")]
    cells: Callable[[Any], dict[str, Any]] = _budget_cells
    if of == "budget":
        say(
            "of unscattered light alone, by the analytic model; `spadwarp plan` has the pulses of all light: 1.3 times "
            "as much at an optical depth of 0.2 in usual water, 3.6 times at 1"
        )
    else:
        cells = partial(_plan_cells, pulses=read.pulses_per_depth_frame)
        say(f"of all light, by `spadwarp plan`; {found.title}")
    table = [{**key, **cells(row)} for key, row in zip(keys, lines, strict=True)]
    show_table(table, keys=len(keys[0]) + (of == "budget"))
    if of == "plan" and found.unequal_energies:
        say(found.unequal_energies)
    if of == "budget" and any(row.gate_moved for row in lines):
        say(
            f"* not the scene's gate, {read.gate.start_ns:.4g}-{read.gate.stop * 1e9:.4g} ns, which misses the return "
            "of one of the ranges, but one as long around the return"
        )
    written(files)
    write_json({**summary, "rows": plain, "notes": spadwarp.analytic.model_notes(read), "files": files})


def _budget_cells(row: BudgetRow) -> dict[str, Any]:
    share = row.outlier_probability

    def sigma(value: float) -> str:
        """In brackets where it is not reached."""
        reached = share <= spadwarp.analytic.OUTLIERS or math.isnan(value)
        return short(value) if reached else f"({short(value)})"

    def pulses(value: float) -> str:
        """To three digits: 5 300, 1.2e+07."""
        return count(float(f"{value:.3g}")) if 100.0 <= value < 1e7 else short(value)

    return {
        "range [m]": f"{row.range:.4g}",
        "optical depth": row.optical_depth,
        "gate [ns]": f"{1e9 * row.gate_start:.4g}-{1e9 * row.gate_stop:.4g}{'*' if row.gate_moved else ' '}",
        "pulses": pulses(row.pulses),
        "signal": row.signal,
        "background": row.background,
        "α": row.alpha,
        "signal/backscatter": row.signal_to_backscatter,
        "σ* [ps]": sigma(1e12 * row.sigma_time),
        "σ* [mm]": sigma(1e3 * row.sigma_depth),
        "outliers": "-" if math.isnan(share) else "< 0.001 %" if 0 < share < 1e-5 else f"{100 * share:.3g} %",
        "for 1 cm": "never" if math.isinf(row.pulses_for_1cm) else pulses(row.pulses_for_1cm),
    }


def _plan_cells(row: PlanRow, pulses: int) -> dict[str, Any]:
    def text(value: float) -> str:
        return "not judged" if math.isnan(value) else "out of reach" if math.isinf(value) else count(value)

    return {
        "pulses": text(row.pulses),
        "from": "-" if math.isnan(row.pulses) else text(row.pulses_least),
        "to": "-" if math.isnan(row.pulses) else text(row.pulses_most),
        "time": with_prefix(row.frame_time, "s") if math.isfinite(row.frame_time) else "-",
        "pulse energy": with_prefix(row.pulse_energy, "J"),
        f"bound [mm] of {count(pulses)} pulses": 1e3 * row.sigma_depth,
        "floor [mm]": 1e3 * row.floor,
        **({} if math.isnan(row.largest_range) else {"largest range [m]": row.largest_range}),
        "limit": row.limit,
    }


# Values of --particles, by theory.
_KOPELEVICH = ("small", "large")
_PARTICLES: dict[str, Callable[[str], float]] = dict.fromkeys(
    ("absorbing", "concentration", "deviation", "index", "large", "slope", "small"), opt.real_number
)
_PARTICLES |= dict.fromkeys(("smallest", "largest", "median", "diameter"), opt.from_unit("m"))
_Particles = Annotated[dict[str, float], opt.items(_PARTICLES)]
_OPTICS = ("absorption", "scattering", "extinction", "albedo", "mean_cosine", "backscatter_fraction")


@command(prints_result=True)
def water(
    wavelength_nm: Annotated[float, opt.from_unit("nm")],
    *,
    chlorophyll: float = 0.0,
    temperature: float = 20.0,
    salinity: float = 35.0,
    particles: _Particles | None = None,
    water: bool = True,
    out: Path | None = None,
    matrix: Path | None = None,
) -> None:
    """Optical properties of water at a wavelength; with particles also scattering and phase function from their sizes.

    A scene gets those of water by medium.chlorophyll, temperature and salinity, those of particles from the files.

    Args:
        wavelength_nm (NM): Vacuum wavelength, 400 to 700 [nm].
        chlorophyll (C): 0 (pure water) to 30 [mg/m3].
        temperature (T): 0 to 30 [degrees Celsius].
        salinity (S): 0 (fresh) to 40 [g/kg].
        particles (NAME=VALUE,...): After Kopelevich: small and large [ppm], mineral particles below 1 um and organic
            ones above. Or by Mie's theory (pip install 'spadwarp[mie]'): index over that of the water, such as 1.05;
            absorbing, its imaginary part, 0 to 0.01; concentration, their volume [ppm]; and slope (mostly near 4),
            smallest, largest of a power law of diameters; or median, deviation (geometric, above 1) of log-normal ones;
            or diameter, of all.
        water: With --particles: add the water's own optics.
        out: With --particles: the phase function as .csv, for medium.phase_table.
        matrix: By Mie's theory: the scattering matrix as .csv, for medium.matrix_table.

    \b
    Examples:
      spadwarp water 532 --chlorophyll 0.5 --temperature 10 --salinity 35
      spadwarp water 532 --particles small=0.05,large=0.2 --out coast.csv
      spadwarp water 532 --particles index=1.1,concentration=1,slope=4,smallest=0.1um,largest=50um
    """
    check_outputs(files={"--out": out, "--matrix": matrix})
    surroundings = {"temperature": temperature, "salinity": salinity}
    if particles is None:
        opt.refuse("needs --particles", "--out", "--matrix", "--water")
        pure = spadwarp.water.water_optics(wavelength_nm, chlorophyll=chlorophyll, **surroundings)
        facts = {"chlorophyll": chlorophyll, **surroundings, **dataclasses.asdict(pure)}
        answer({**facts, "extinction": pure.extinction})
        return
    opt.refuse("cannot be combined with --particles", "--chlorophyll")
    for option, field, file in (("--out", "phase_table", out), ("--matrix", "matrix_table", matrix)):
        if file is not None and file.suffix.lower() != ".csv":
            wrong(f"{file} does not end in .csv, as medium.{field} must", option)
    if matrix is not None and "index" not in particles:
        wrong("is by Mie's theory: Kopelevich's components have no matrix", "--matrix")
    parts, text = _particles(wavelength_nm, particles, surroundings)
    whole = spadwarp.water.mixture([parts], water=water, **surroundings)
    optics = {name: getattr(whole, name) for name in _OPTICS}
    say(readable({"particles": text, **optics, "attenuation_length": 1.0 / whole.extinction}))
    if out is not None:
        spadwarp.water.save_phase_table(whole, out)
        say(
            f"written: {out}; in the scene:\n[medium]\nabsorption = {whole.absorption:.6g}\nscattering = "
            f'{whole.scattering:.6g}\nphase_function = "tabulated"\nphase_table = "{out.as_posix()}"'
        )
    if matrix is not None:
        spadwarp.water.save_matrix_table(whole, matrix)
        say(
            f"written: {matrix}; in the scene, for polarised light:\n[medium]\n"
            f'scattering_matrix = "tabulated"\nmatrix_table = "{matrix.as_posix()}"'
        )
    write_json({"wavelength_nm": wavelength_nm, **optics, "water": water, "file": out, "matrix_file": matrix})


def _particles(
    wavelength_nm: float, values: dict[str, float], surroundings: dict[str, float]
) -> tuple[ParticleOptics, str]:
    """The particles of --particles, and what they are in words."""
    water, option = spadwarp.water, "--particles"
    others = [name for name in values if name not in _KOPELEVICH]
    if not others:
        small, large = (values.get(name, 0.0) for name in _KOPELEVICH)
        text = f"Kopelevich, {small:g} ppm below and {large:g} ppm above 1 um"
        return water.kopelevich_particles(wavelength_nm, small=small, large=large), text
    if "index" not in values or len(others) < len(values):
        wrong(f"give small and large, or index with concentration and sizes; {others[0]} belongs to index", option)
    if "concentration" not in values:
        wrong("concentration is missing", option)
    laws: dict[str, tuple[Any, tuple[str, ...]]] = {
        "slope": (water.power_law, ("smallest", "largest")),
        "median": (water.log_normal, ("deviation",)),
        "diameter": (water.single_size, ()),
    }
    chosen = [name for name in laws if name in values]
    if len(chosen) != 1:
        wrong("one law of sizes is needed: slope, median or diameter", option)
    make, names = laws[chosen[0]]
    if missing := [name for name in names if name not in values]:
        wrong(f"{chosen[0]} needs {' and '.join(names)}; {missing[0]} is missing", option)
    sizes = make(values[chosen[0]], **{name: values[name] for name in names})
    index, concentration = complex(values["index"], values.get("absorbing", 0.0)), values["concentration"]
    parts = water.mie_particles(sizes, wavelength_nm, index=index, concentration=concentration, **surroundings)
    return parts, f"Mie, {concentration:g} ppm of index {values['index']:g}, {sizes.text}"
