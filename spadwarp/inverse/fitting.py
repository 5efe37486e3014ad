"""Maximum likelihood of counts: water, surfaces, background and depth from one exposure; and Cramér–Rao bounds of all.

From a rough start an exponential model of blocks of pixels is fitted between two renderings: a histogram in water is
nearly an exponential of its unknowns, and steps of Newton's method overshoot or stall from starts that are wrong by
factors. Then Fisher scoring on all pixels and bins (docs/fitting.md).

Light lies in bins until the instrument response spreads it. Where most of a pixel's light lies in one or two bins, the
expected counts follow the depth only as light crosses the edges of these bins: hardly at all while it stays inside one,
fast while it crosses. The difference over about half of the response, which makes smooth weights, gives the mean slope
over several millimetres; the slope within the depth's error can be a part of it, or a multiple. Any weights give right
equations, but the step and the covariance need the slope where the depth is looked for.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spadwarp.arrays import Floats
from spadwarp.device import pick_device
from spadwarp.frames.spad import DRAWN_EFFECTS
from spadwarp.inverse.equations import Equations, Law, Moments, Solution, pseudo_inverse, solve, solve_pooled
from spadwarp.inverse.exposure import Exposure, lidar_initial_guess, read_exposure
from spadwarp.inverse.goodness import Goodness, Lost, goodness_of, significance
from spadwarp.inverse.rendering import Half, Renderer
from spadwarp.inverse.unknowns import BACKGROUND, DEPTH, Unknown, by_name, read_unknowns, scene_value, with_values
from spadwarp.scene import Detector, Scene, SceneLike, as_scene
from spadwarp.transport import Progress, truth_maps
from spadwarp.values import SEED, ArgumentError, ConfigError, check_integer, check_real, count, percent

__all__ = ["Bound", "Bounds", "Estimate", "EstimateMap", "Fit", "Fitter", "Iteration", "bounds", "fit"]

Rows = NDArray[np.float32]
Prior = Mapping[str, tuple[float, float]]

BATCHES = 4  # of photons in each half, and of a difference of depths
_SCORED = 2  # of them with slopes: their difference says how wrong the slopes are
SIMULATION = 0.1  # of the variance by the counts
_PHOTONS = {"cpu": 20_000_000, "cuda": 400_000_000}

# Iterations: how many, with how many photons, until when.
_COARSE, _FINE = 16, 8  # renderings at most
_FEWEST, _FEWER, _FEW = 128, 32, 16  # divide the photons: of the first coarse rendering, the last, the first fine one
_ACROSS = 4  # blocks along each side of the image in coarse steps; more of them are noisier
_SETTLED = 0.3  # of the largest coarse step: from there Fisher scoring converges, and few photons say no more
_CONVERGED = 0.25  # gain of the log-likelihood for each unknown: the slopes are noisy, so that long steps end wrong
_PATIENCE = 3  # fine renderings, after which the depth's slope is looked at

# The slope by the depth, over the interval that is stated for the depth.
_WIDE = 0.7  # of the renderer's step: an interval of this size has the slope that is known already
_CONSISTENT = 1.5  # ratio of the interval that was found to that of the difference
_LARGEST = 3.0  # ratio of one difference to that before
_TRIES = 6
_LEAST = 1e-5  # of the range of the last bin: positions are float32
_STRAIGHT = 0.75  # ratio of two slopes; below, a warning
_SURE = 3.0  # standard errors by which a slope has to differ from the wide one
_ONE_SIDED = 0.5  # ratio of the slopes of both sides: below, the flatter one decides

_NORMAL_95 = 1.959963984540054
_SEEN = 3.719  # standard deviations of light, which noise alone has in 1 of 10 000 cases
_CORRELATED, _UNSURE = 0.99, 0.5  # correlation, and standard error of a logarithm, from which a warning says so


# Estimates


@dataclass(frozen=True, kw_only=True)
class Estimate:
    """One value for the whole exposure."""

    name: str  # of the unknown; depth is that of the target in the pixel nearest to the middle of the image
    value: float  # the estimate, in SI units; NaN, as its errors, where nothing was seen that depends on it
    standard_error: float  # of counts and simulation together
    interval: tuple[float, float]  # 95 %; of positive values from the standard error of the logarithm
    simulation: float  # the part of the variance that is noise of the simulation
    initial_guess: float  # where the search began
    unit: str = ""  # "" for a plain number


@dataclass(frozen=True, eq=False, kw_only=True)
class EstimateMap:
    """A value for each pixel, float64 `[H, W]`; NaN where the counts say nothing of it."""

    name: str
    value: Floats
    standard_error: Floats
    unit: str = ""


@dataclass(frozen=True, kw_only=True)
class Iteration:
    """A rendering and the step from it: `gain` is the log-likelihood that the step promises."""

    values: Mapping[str, float]
    gain: float
    photons: int
    coarse: bool


@dataclass(frozen=True, eq=False, kw_only=True)
class Joint:
    """What a fit and bounds have in common: unknowns of the whole exposure with their covariance."""

    names: Sequence[str]  # of the estimates
    covariance: Floats  # of them on the scale that is searched, the logarithm for positive values
    warnings: Sequence[str]  # what may mislead, in words
    pulses: int  # in all
    photons: int  # traced by the whole fit

    @property
    def correlation(self) -> Floats:
        """Correlations in the order of `names`; 0 where a variance is 0."""
        scale = np.sqrt(np.maximum(np.diag(self.covariance), 0.0))
        scale = np.where(scale > 0, scale, np.inf)
        return self.covariance / np.outer(scale, scale)

    def to_dict(self) -> dict[str, Any]:
        """The numbers without maps, for JSON."""
        return {
            "names": list(self.names),
            "covariance": self.covariance.tolist(),
            "correlation": self.correlation.tolist(),
            "warnings": list(self.warnings),
            "pulses": self.pulses,
            "photons": self.photons,
        }

    def not_identifiable(self, is_positive: Sequence[bool]) -> list[str]:
        """Sentences on unknowns that the counts do not tell apart, or not at all."""
        sentences, correlation = [], self.correlation
        for i, name in enumerate(self.names):
            for j in range(i):
                if abs(correlation[i, j]) > _CORRELATED:
                    sentences.append(
                        f"{self.names[j]} and {name} are hardly told apart (correlation {correlation[i, j]:+.4f}): "
                        "hold one of them fixed, or give it a prior"
                    )
            if is_positive[i] and np.sqrt(self.covariance[i, i]) > _UNSURE:
                error = percent(self.covariance[i, i] ** 0.5)
                sentences.append(f"{name}: the counts say little of it (standard error {error} %)")
        return sentences


@dataclass(frozen=True, eq=False, kw_only=True)
class Fit(Joint):
    """A maximum-likelihood fit of counts."""

    scene: Scene  # with the estimates in place of the unknowns
    estimates: Mapping[str, Estimate]  # by name, what is one value for the whole exposure
    maps: Mapping[str, EstimateMap]  # by name, what is a value for each pixel
    iterations: Sequence[Iteration]  # in order
    converged: bool  # whether the last step promised less than the noise of the likelihood
    goodness: Goodness  # whether the fit describes the counts
    depth: Floats | None
    """Depth of the targets by the fit, float64 `[H, W]` [m], NaN without a target; None unless it was unknown."""
    counts: NDArray[np.integer] = field(repr=False)
    """What was fitted, `[H, W, T]`."""
    expected: NDArray[np.float32] = field(repr=False)  # its mean by a rendering at the estimates, float32
    edges: Floats = field(repr=False)  # of the bins in time of flight [s]
    seconds: float  # it took

    def __repr__(self) -> str:
        values = [f"{item.name} {item.value:.4g} ± {item.standard_error:.2g}" for item in self.estimates.values()]
        return f"Fit({', '.join([*values, *(f'{name} of each pixel' for name in self.maps)])})"

    def to_dict(self) -> dict[str, Any]:
        """The numbers without maps, for JSON."""
        return {
            "estimates": {name: vars(item) for name, item in self.estimates.items()},
            **super().to_dict(),
            "converged": self.converged,
            "goodness": self.goodness.to_dict(),
            "iterations": [{**vars(item), "values": dict(item.values)} for item in self.iterations],
            "counts": int(self.counts.sum()),
            "seconds": self.seconds,
        }

    def plot(self, **options: Any) -> Any:
        """A figure of counts, fit and residuals; see `spadwarp.viz.plot`."""
        import spadwarp

        return spadwarp.viz.plot(self, **options)


@dataclass(frozen=True, kw_only=True)
class Bound:
    """Bound of one unknown; of an unknown of each pixel, the median of the pixels that see a target."""

    name: str  # of the unknown
    value: float  # in the scene; depth counts from where the targets are
    standard_error: float  # least standard deviation of an unbiased estimate when all unknowns are unknown
    alone: float  # the same when all others are known
    relative: float  # `standard_error` over the value; NaN for depth
    per_pixel: bool  # whether each pixel has a value of its own. The median of the background is that of all pixels.
    unit: str  # of the value


@dataclass(frozen=True, eq=False, kw_only=True)
class Bounds(Joint):
    """Cramér–Rao bounds of unknowns together.

    Attributes:
        names, covariance: Of the unknowns of the whole exposure, `[S, S]`: the inverse of their Fisher information when
            those of the pixels are unknown too; on the scale of the logarithm for positive values.
        pulses, photons: Of the exposure; traced.
        warnings: What may mislead, in words.
    """

    bounds: Mapping[str, Bound]  # by name
    maps: Mapping[str, Floats]  # by name the bound of each pixel `[H, W]`, NaN where the counts say nothing of it
    alone_maps: Mapping[str, Floats]  # the same when all other unknowns are known
    counts: float  # expected in the exposure
    simulation: float
    """Variance that the noise of the simulation would add to a fit with these photons, over that of the counts; the
    bounds are right within about its half."""

    def to_dict(self) -> dict[str, Any]:
        """The numbers without maps, for JSON."""
        bounds = {name: vars(item) for name, item in self.bounds.items()}
        return {"bounds": bounds, **super().to_dict(), "counts": self.counts, "simulation": self.simulation}


# The fit


def fit(
    counts: Any,
    scene: SceneLike,
    *,
    unknown: str | Sequence[str],
    initial_guess: Mapping[str, float] | None = None,
    prior: Prior | None = None,
    pulses: int | None = None,
    photons: int | None = None,
    seed: int = 0,
    device: str | None = None,
    progress: Progress | None = None,
    **facts: Any,
) -> Fit:
    """Values of unknowns of a scene that make counts most likely, with covariance and 95 % intervals.

    The model is the whole chain: transport, instrument response, dark counts and ambient light, pile-up or dead time.
    Each iteration renders the scene anew with photons that no other has used, until the log-likelihood has no more to
    gain than the noise of the counts (docs/fitting.md). Noise of the simulation is in the covariance.

    Args:
        counts: Frames (`detect`, or their file), measured histograms (`spadwarp.frames.read_histograms`, or a file), or
            integers `[H, W, T]` on the scene's gate.
        scene: What is known, and where to start.
        unknown: Names, such as "medium.absorption,medium.scattering,targets[0].reflectance,depth:pixel"; see
            `spadwarp.inverse.read_unknowns`.
        initial_guess: Values to start from, by name, depth as a shift from the scene's [m]; by default absorption and
            scattering from the backscatter (`spadwarp.inverse.lidar_initial_guess`), the others of the scene.
        prior: By name what is known from elsewhere: mean and standard deviation.
        pulses: Of one frame of the counts; by default those that the frames name, else of the scene's detector.
        photons: Of an iteration at most; as many are taken as keep the simulation below a tenth of the variance. By
            default 2e7 on the CPU, 4e8 on a GPU.
        seed: 64 bits.
        device: As in `simulate`.
        progress: Called with ("fit: …", photons of the iterations done, 0).
        facts: Of measured files, as `read_histograms` takes them.

    Raises:
        ArgumentError: Unknowns, counts or numbers that do not fit.
        ConfigError: A scene or a detector that the model does not cover.
    """
    scene = as_scene(scene)
    exposure = read_exposure(counts, scene, pulses=pulses, **facts)
    fitter = Fitter(scene, unknown, exposure, prior=prior, photons=photons, seed=seed, device=device)
    return fitter.fit(initial_guess=initial_guess, progress=progress)


def _detector_law(detector: Detector, window: Any) -> Law:
    """How a detector counts in the model. Raises `ConfigError` for what it leaves out."""
    for name in DRAWN_EFFECTS:
        if (value := getattr(detector, name)) != 0:
            raise ConfigError(f"detector.{name} = {value}: a fit does not model it")
    free = detector.mode == "free_running"
    return Law(not free, detector.dead_time_ns * 1e-9 / window.period if free else 0.0, window.recorded)


@dataclass
class State:
    """Values of the unknowns; those of pixels `[pixel]`, depth as a shift."""

    values: dict[str, Any]
    iterations: list[Iteration]

    def scale(self, unknown: Unknown) -> Any:
        """d(value)/d(what is searched): the value where its logarithm is."""
        value = self.values[unknown.name]
        return np.where(value, value, 1.0) if unknown.is_positive else 1.0

    def scales(self, unknowns: Sequence[Unknown], pixels: int) -> Floats:
        """The same of several, `[pixel, unknown]`."""
        return np.stack([np.broadcast_to(self.scale(unknown), pixels) for unknown in unknowns], axis=1)

    def means(self) -> dict[str, float]:
        """One number for each name: that of a map is its mean."""
        return {name: float(np.nanmean(value)) for name, value in self.values.items()}

    def step(self, iteration: Iteration, steps: Mapping[str, Any]) -> str:
        """Takes a step on the scale that is searched, by name, at the end of an iteration; returns a report of it."""
        self.iterations.append(iteration)
        for name, step in steps.items():
            unknown, value = Unknown(name), self.values[name]
            step = np.clip(np.nan_to_num(step), -unknown.largest_step, unknown.largest_step)
            value = value * np.exp(step) if unknown.is_positive else value + step
            if name.endswith("reflectance"):
                value = np.minimum(value, 1.0)
            if name == "medium.anisotropy":
                value = np.clip(value, -0.99, 0.99)
            self.values[name] = value if np.ndim(value) else float(value)
        digits = 4 if iteration.coarse else 5
        return "fit: " + ", ".join(f"{name} {value:.{digits}g}" for name, value in self.means().items())


class Fitter:
    """A fit of one kind of exposure; the class behind `fit`, for many fits of the same scene.

    Args:
        scene, unknown, prior, photons, seed, device: As in `fit`.
        exposure: Counts with their time axis.
    """

    def __init__(
        self,
        scene: SceneLike,
        unknown: str | Sequence[str],
        exposure: Exposure,
        *,
        prior: Prior | None = None,
        photons: int | None = None,
        seed: int = 0,
        device: str | None = None,
    ) -> None:
        self.scene = as_scene(scene)
        self.unknowns = read_unknowns(self.scene, unknown)
        self.shared = [unknown for unknown in self.unknowns if not unknown.per_pixel]
        self.own = [unknown for unknown in self.unknowns if unknown.per_pixel]
        self.exposure, self.device = exposure, device
        kind = "cuda" if pick_device(device).is_cuda else "cpu"
        self.photons = _PHOTONS[kind] if photons is None else check_integer("photons", photons, "[1000, 1e12]")
        seed = check_integer("seed", seed, SEED)
        self.render = Renderer(self.scene, self.unknowns, exposure, device=device, seed=seed)
        self.prior = self._checked(by_name(self.scene, prior or {}))
        self.law = _detector_law(self.scene.detector, self.render.window)
        self.image = (self.scene.camera.height, self.scene.camera.width)

    def _checked(self, prior: Prior) -> dict[str, tuple[float, float]]:
        """Mean and standard deviation by name. Raises `ArgumentError`."""
        names, result = [unknown.name for unknown in self.shared], {}
        for name, pair in prior.items():
            if name not in names:
                known = ", ".join(names)
                raise ArgumentError(f"prior: {name} is not an unknown of the whole exposure; these are {known}")
            if not (isinstance(pair, tuple | list) and len(pair) == 2):
                raise ArgumentError(f"prior of {name} = {pair!r} is not (mean, standard deviation)")
            mean = check_real(f"prior of {name}: mean", pair[0], "[-1e12, 1e12]")
            if name == DEPTH:  # a shift is searched
                mean -= _middle_depth(truth_maps(self.scene, device=self.device).depth)
            result[name] = (mean, check_real(f"prior of {name}: standard deviation", pair[1], "[1e-12, 1e12]"))
        return result

    def fit(
        self, *, initial_guess: Mapping[str, float] | None = None, near: bool = False, progress: Progress | None = None
    ) -> Fit:
        """Fits the exposure as `spadwarp.fit` does; `near`: the guess is within some standard errors already."""
        began, first, exposure = time.perf_counter(), self.render.photons, self.exposure
        state = self._initial_state(by_name(self.scene, initial_guess or {}))
        begin, counts = state.means(), exposure.counts
        assert counts is not None
        if not counts.any():
            raise ArgumentError("counts: not one in any bin, so that nothing can be fitted")

        def report(text: str) -> None:
            if progress is not None:
                progress(text, 0, 0)

        trials = exposure.left() if self.law.first_photon else np.full(counts.shape, exposure.pulses, np.float32)
        if not near and self.shared:
            self._approach(state, trials, report)
        halves, solution, converged = self._refine(state, trials, report)
        batch = max(state.iterations[-1].photons // (2 * BATCHES), 1)
        rates, parts = self.render.light(state.values, photons=batch, batches=2 * BATCHES)
        batches = [self.law.mean(one, trials) for one in rates]
        expected: Rows = np.asarray(np.mean(batches, axis=0, dtype=np.float32))
        total = np.maximum(np.sum(parts, axis=0), 1e-30)
        parts = [expected * (part / total)[:, : self.law.recorded] for part in parts]
        pixels = (*self.image, self.law.recorded)
        agreement = goodness_of(
            counts.reshape(pixels),
            expected,
            self.law.variance(expected, trials),
            batches,
            trials,
            self._lost(state, halves, solution, trials),
            parts,
        )
        unseen = self._forget_unseen(expected, parts[0], solution)
        estimates, maps, depth = self._estimates(state, begin, solution)
        found = Fit(
            scene=with_values(self.scene, {k: v for k, v in state.means().items() if k not in unseen}),
            estimates=estimates,
            maps=maps,
            names=[unknown.name for unknown in self.shared],
            covariance=solution.covariance,
            iterations=tuple(state.iterations),
            converged=converged,
            goodness=agreement,
            warnings=(),
            depth=depth,
            counts=counts.reshape(pixels),
            expected=expected.reshape(pixels),
            edges=self.render.window.start + self.render.window.edges[: self.law.recorded + 1],
            pulses=exposure.pulses,
            photons=self.render.photons - first,
            seconds=time.perf_counter() - began,
        )
        silent = [f"{name}: {reason}, so that it has no value" for name, reason in unseen.items()]
        return replace(found, warnings=(*agreement.warnings(), *silent, *self._warnings(found, solution)))

    def _lost(self, state: State, halves: list[Half], solution: Solution, trials: Rows) -> Lost:
        """What the fitted unknowns take of the deviance: 2 J⁻¹ − V, with V the covariance, and the slopes."""
        scales = state.scales(self.unknowns, len(trials))[..., None]
        slopes = [
            self.law.slopes(half.batches[0], half.slopes[0].transpose(1, 0, 2), trials) * scales for half in halves
        ]
        shared, own = ([self.unknowns.index(unknown) for unknown in some] for some in (self.shared, self.own))
        return Lost(
            [side[:, shared].transpose(1, 0, 2) for side in slopes],
            [side[:, own].transpose(1, 0, 2) for side in slopes],
            2.0 * pseudo_inverse(solution.information) - solution.covariance,
            np.nan_to_num(2.0 * solution.pixel_bound - solution.pixel_covariance),
        )

    def _forget_unseen(self, expected: Rows, target: Rows, solution: Solution) -> dict[str, str]:
        """Makes NaN of the solution's variances where no light, counted or traced, depends on an unknown; returns those
        of the whole exposure, and why. `expected`, `target`: mean counts, and those by light of the targets."""
        counts, unseen = self.exposure.counts, dict[str, str]()
        assert counts is not None
        on_targets = [unknown.name == DEPTH or unknown.name.startswith("targets") for unknown in self.unknowns]
        if any(on_targets):
            # Without pixels of an own depth that too few photons show to be fitted: their light has no limit.
            usable = target.sum(axis=1) <= counts.sum()
            whole = significance(*(rows[usable].reshape(1, -1) for rows in (counts, expected, target)))[0]
            each = significance(counts, expected, target)
        for unknown, on_target in zip(self.unknowns, on_targets, strict=True):
            if unknown.per_pixel:
                column, seen = self.own.index(unknown), counts.any(axis=1)
                solution.pixels[~(seen & (each >= _SEEN) if on_target else seen), column] = np.nan
                continue
            row = self.shared.index(unknown)
            if not solution.covariance[row, row] > 0.0:
                unseen[unknown.name] = f"none of the light of {count(self.photons)} photons depends on it, take more"
            elif on_target and not whole >= _SEEN:
                unseen[unknown.name] = "no light of the targets was seen in the counts"
            if unknown.name in unseen:
                solution.covariance[row, :] = solution.covariance[:, row] = np.nan
        return unseen

    def _initial_state(self, guess: dict[str, float]) -> State:
        names = {unknown.name for unknown in self.unknowns}
        for name in guess:
            if name not in names:
                raise ArgumentError(f"initial_guess: {name} is not an unknown; these are {', '.join(sorted(names))}")
        if water := {"medium.absorption", "medium.scattering"} & names - set(guess):
            lidar = lidar_initial_guess(self.scene, self.exposure, device=self.device)
            guess = {**{name: value for name, value in lidar.items() if name in water}, **guess}
        values: dict[str, Any] = {}
        for unknown in self.unknowns:
            name = unknown.name
            within = "(0, inf)" if name in guess and unknown.is_positive else "(-inf, inf)"
            value = check_real(f"initial_guess of {name}", guess.get(name, scene_value(self.scene, unknown)), within)
            if unknown.is_positive and value <= 0.0:
                value = 1.0 if name == BACKGROUND else 0.01
            values[name] = np.full(self.image[0] * self.image[1], value) if unknown.per_pixel else value
        return State(values, [])

    # Iterations

    def _approach(self, state: State, trials: Rows, report: Callable[[str], None]) -> None:
        """Coarse steps of the shared unknowns, with few photons at first, until Fisher scoring can do the rest."""
        photons, columns = self.photons // _FEWEST, [self.unknowns.index(unknown) for unknown in self.shared]
        largest = np.array([0.7 if unknown.is_positive else 0.02 for unknown in self.shared])
        assert self.exposure.counts is not None
        for _ in range(_COARSE):
            photons = max(photons, 1000)
            (half,) = self.render(state.values, photons=photons, halves=1)
            scales, limits = state.scales(self.shared, 1)[0], self.render.limits[columns]
            half = half._replace(slopes=[half.slopes[0][columns]])
            blocks = _in_blocks(self.law, half, trials, self.exposure.counts, scales, limits, self.image)
            step, error = _coarse_step(*blocks, largest, self.prior_at(state))
            gain = 0.5 * float(np.sum((step / np.maximum(error, 1e-12)) ** 2))
            iteration = Iteration(values=state.means(), gain=gain, photons=photons, coarse=True)
            report(state.step(iteration, {one.name: part for one, part in zip(self.shared, step, strict=True)}))
            if (np.abs(step) < np.maximum(2.0 * error, _SETTLED * largest)).all():
                return
            photons = min(2 * photons, self.photons // _FEWER)

    def _refine(self, state: State, trials: Rows, report: Callable[[str], None]) -> tuple[list[Half], Solution, bool]:
        """Fisher scoring with fresh photons: few at first, as many as the noise of the simulation asks for at last."""
        photons, level, bent = max(self.photons // _FEW, 8000), None, False
        for number in range(_FINE):
            batch = photons // (2 * BATCHES)
            halves = self.render(state.values, photons=batch, batches=BATCHES, scored=_SCORED)
            level, equations, solution = self.solve(state, halves, trials, level)
            if bent or number >= _PATIENCE or self._converged(solution):
                solution = self._locally_solved(equations, solution, state, halves, trials, batch)
            bent = bent or solution.slope_ratio != 1.0
            converged = self._converged(solution)
            iteration = Iteration(values=state.means(), gain=solution.gain, photons=photons, coarse=False)
            steps = zip((*self.shared, *self.own), (*solution.shared, *solution.pixels.T), strict=True)
            report(state.step(iteration, {unknown.name: step for unknown, step in steps}))
            needed = int(photons * max(solution.simulation_share / (0.8 * SIMULATION), 1.0))
            more = min(needed, self.photons, 4 * photons)
            noisy = solution.simulation_share > SIMULATION and more > 1.2 * photons
            if converged and not noisy:
                break
            photons = max(photons, more)
        return halves, solution, converged

    def solve(
        self, state: State, halves: list[Half], trials: Rows | None, pooling_level: int | None
    ) -> tuple[int, Equations, Solution]:
        """The step from a rendering, see `solve_pooled`; without `trials` of a plan of the exposure."""
        moments = Moments(
            self.law, halves, self.render.limits, trials, self.exposure.counts, self.exposure.pulses, self.image
        )
        scales = state.scales(self.unknowns, self.image[0] * self.image[1])
        return solve_pooled(self.unknowns, moments, scales, self._solver(state), pooling_level)

    def _solver(self, state: State) -> Callable[[Equations], Solution]:
        is_per_pixel, prior = np.array([unknown.per_pixel for unknown in self.unknowns]), self.prior_at(state)
        return lambda equations: solve(equations, is_per_pixel, prior)

    def _converged(self, solution: Solution) -> bool:
        """Whether the step gains little; a noisy rendering asks for a step even from the solution."""
        return solution.gain <= (_CONVERGED + min(solution.simulation_share, 1.0)) * max(len(self.shared), 1)

    def prior_at(self, state: State) -> tuple[Floats, Floats]:
        """Score and information of the priors on the searched scale, `[S]` both."""
        pull, information = np.zeros(len(self.shared)), np.zeros(len(self.shared))
        for row, unknown in enumerate(self.shared):
            if unknown.name in self.prior:
                mean, deviation = self.prior[unknown.name]
                scale = float(state.scale(unknown))
                information[row] = (scale / deviation) ** 2
                pull[row] = (mean - state.values[unknown.name]) * scale / deviation**2
        return pull, information

    def _locally_solved(
        self, equations: Equations, solution: Solution, state: State, halves: list[Half], trials: Rows, photons: int
    ) -> Solution:
        """Solves again with the slope by the common depth over its 95 % interval, not over the wide difference.

        Where no shorter interval has a slope that belongs to it, the light can move inside a bin: the depth's variance
        then is that of two places anywhere in the same bin. `photons`: of a difference.
        """
        depth = [unknown.name for unknown in self.shared]
        if DEPTH not in depth:
            return solution
        row, column = depth.index(DEPTH), self.unknowns.index(self.shared[depth.index(DEPTH)])
        rates, scales = 0.5 * (halves[0].rates + halves[1].rates), state.scales(self.unknowns, len(trials))
        least = _LEAST * 0.5 * self.scene.medium.pulse_speed * self.scene.gate.stop

        def interval(solution: Solution) -> float:
            return max(_NORMAL_95 * math.sqrt(max(solution.covariance[row, row], 0.0)), least)

        def slopes(shift: float, step: float) -> Floats:
            each = max(photons // BATCHES, 1)
            result = np.empty((BATCHES, *scales.shape))
            batches = self.render.depth_slopes(state.values, shift=shift, step=step, photons=each, batches=BATCHES)
            for batch, rows in zip(result, batches, strict=True):
                counts = self.law.slopes(rates, rows[:, None], trials)
                batch[:] = np.matmul(equations.weights, counts.transpose(0, 2, 1))[..., 0] * scales
            return result * scales[:, column, None]

        def share(slope: Floats) -> Floats:
            shares: Floats = slope[..., column].sum(axis=-1) / wide
            return shares

        wide, step = equations.slope[:, column, column].sum(), interval(solution)
        if not step < _WIDE * self.render.depth_step:
            return solution
        for _ in range(_TRIES):
            batches = slopes(0.0, step)
            shares = share(batches)
            if abs(shares.mean() - 1.0) < _SURE * shares.std(ddof=1) / math.sqrt(BATCHES):
                return solution
            flat, steep = sorted((slopes(side * step / 2, step / 2).mean(axis=0) for side in (-1.0, 1.0)), key=share)
            slope = equations.slope.copy()
            slope[:, :, column] = flat if share(flat) < _ONE_SIDED * share(steep) else batches.mean(axis=0)
            ratio, needed = float(slope[:, column, column].sum() / wide), math.inf
            if ratio > 0.0:
                local = replace(self._solver(state)(replace(equations, slope=slope)), slope_ratio=ratio)
                needed = interval(local)
                if step / _CONSISTENT < needed < step * _CONSISTENT or needed == step == least:
                    return local
            step = min(needed, _LARGEST * step)
            if not step < _WIDE * self.render.depth_step:
                break
        covariance = solution.covariance.copy()
        covariance[row, row] += self._bin_depth**2 / 6.0
        return replace(solution, covariance=covariance, slope_ratio=0.0)

    @property
    def _bin_depth(self) -> float:
        """How much deeper a target is whose light comes a bin later [m]."""
        return 0.5 * self.scene.medium.pulse_speed * self.scene.gate.bin_width

    def _slope_warnings(self, ratio: float) -> list[str]:
        """Sentences on light that lies in few bins."""
        if _STRAIGHT < ratio < 1.0 / _STRAIGHT:
            return []
        bin_width, depth, error = self.scene.gate.bin_width_ps, 1e3 * self._bin_depth, ""
        if not ratio > 0.0:
            error = f", and its standard error is that of a place anywhere in a bin of {depth:.2g} mm"
        return [
            f"depth: before the instrument response, most light of a pixel lies in one or two bins of {bin_width:.4g} "
            f"ps; the counts follow the depth only as this light crosses the edges of bins{error}. The depth of "
            f"measured counts may be off by a part of {depth:.2g} mm: choose narrower bins"
        ]

    # The result

    def _estimates(
        self, state: State, begin: Mapping[str, float], solution: Solution
    ) -> tuple[dict[str, Estimate], dict[str, EstimateMap], Floats | None]:
        """Values with their errors, maps of those of the pixels, and the depth, from the equations' solution."""
        truth, values = truth_maps(self.scene, device=self.device), state.values
        estimates, maps, depth = {}, {}, None
        for row, unknown in enumerate(self.shared):
            offset = 0.0
            if unknown.name == DEPTH:
                offset, depth = _middle_depth(truth.depth), truth.depth + values[DEPTH]
            variance = solution.covariance[row, row]
            value, error = values[unknown.name] + offset, math.sqrt(max(variance, 0.0))
            if math.isnan(variance):  # nothing was seen
                value = error = math.nan
                if unknown.name == DEPTH:
                    depth = np.full_like(truth.depth, np.nan, np.float64)
            if unknown.is_positive:  # the error is of the logarithm
                factor = math.exp(min(_NORMAL_95 * error, 700.0))
                interval, error = (value / factor, value * factor), error * value
            else:
                interval = (value - _NORMAL_95 * error, value + _NORMAL_95 * error)
            estimates[unknown.name] = Estimate(
                name=unknown.name,
                value=value,
                standard_error=error,
                interval=interval,
                simulation=solution.simulation[row, row] / variance if variance > 0 else math.nan,
                initial_guess=begin[unknown.name] + offset,
                unit=unknown.unit,
            )
        for column, unknown in enumerate(self.own):
            errors = np.sqrt(np.maximum(solution.pixel_covariance[:, column, column], 0.0)) * state.scale(unknown)
            errors = errors + 0.0 * solution.pixels[:, column]  # NaN where there is no value
            value = (values[unknown.name] + 0.0 * solution.pixels[:, column]).reshape(self.image)
            if unknown.name == DEPTH:
                value = depth = value + truth.depth
            errors = errors.reshape(self.image)
            maps[unknown.name] = EstimateMap(name=unknown.name, value=value, standard_error=errors, unit=unknown.unit)
        return estimates, maps, depth

    def simulation_warning(self, share: float, what: str = "") -> list[str]:
        """The sentence on too much noise of the simulation."""
        text = f"the noise of the simulation is {percent(share)} % of that of the counts in the variances, above 10 %"
        needed = f"{self.render.photons * share / SIMULATION:.1e} photons would do"
        return [f"{text}{what}; {needed}"] if share > SIMULATION else []

    def _warnings(self, found: Fit, solution: Solution) -> list[str]:
        sentences = [*self.render.warnings(), *self._slope_warnings(solution.slope_ratio), *self.exposure.warnings()]
        if not found.converged:
            sentences.append("not converged: the last step still promised more likelihood than the noise of the counts")
        sentences += self.simulation_warning(solution.simulation_share, ", which the standard errors contain")
        if any(name not in self.prior for name in found.names):
            sentences += found.not_identifiable([unknown.is_positive for unknown in self.shared])
        return sentences


# Bounds, which are those of a fit


def bounds(
    scene: SceneLike,
    *,
    unknown: str | Sequence[str],
    pulses: int | None = None,
    prior: Prior | None = None,
    photons: int | None = None,
    seed: int = 0,
    device: str | None = None,
) -> Bounds:
    """Cramér–Rao bounds of unknowns of a scene from one exposure, all of them together.

    F = Σ dm dmᵀ / var over pixels and bins, m the mean counts with instrument response, noise and pile-up or dead time.
    Products are of two independent halves of the photons: the noise of the simulation does not count as information.
    The photons are doubled until it is below a tenth of the counts' variance, or there are no more.

    Args:
        scene: With values for everything.
        unknown: Names, as `spadwarp.inverse.read_unknowns` takes them: "absorption,scattering,depth:pixel".
        pulses: Of the exposure; by default the scene's `detector.pulses_per_frame`.
        prior: By name what is known from elsewhere: mean (not used) and standard deviation.
        photons: To trace at most; by default 2e7 on the CPU, 4e8 on a GPU.
        seed: 64 bits.
        device: As in `simulate`.

    Raises:
        ArgumentError: Unknowns or numbers that do not fit.
        ConfigError: A scene or a detector that the model does not cover.
    """
    scene = as_scene(scene)
    pulses = scene.detector.pulses_per_frame if pulses is None else check_integer("pulses", pulses, "[1, 1e15]")
    plan = Exposure(counts=None, pulses=pulses, window=(scene.gate.start, scene.gate.bins))
    fitter = Fitter(scene, unknown, plan, prior=prior, photons=photons, seed=seed, device=device)
    render, law, most = fitter.render, fitter.law, fitter.photons
    state = State({item.name: scene_value(scene, item) for item in fitter.unknowns}, [])
    number, level = max(most // 8, 8000), None
    while True:
        halves = render(state.values, photons=max(number // (2 * BATCHES), 1), batches=BATCHES)
        level, equations, solution = fitter.solve(state, halves, None, level)
        share = solution.simulation_share
        if share <= SIMULATION or 2 * number > most:
            break
        number = min(most, int(number * max(2.0, min(share / (0.8 * SIMULATION), 16.0))))
    assert render.truth is not None
    seen = np.isfinite(render.truth.depth)  # others have light that water has scattered: a bound that nobody asks for
    covariance = pseudo_inverse(solution.information)
    information = np.einsum("pii->pi", equations.slope)
    rows: dict[str, Bound] = {}
    maps, alone_maps = {}, {}
    for i, item in enumerate(fitter.unknowns):
        scale, value = float(state.scale(item)), float(state.values[item.name])
        if item.per_pixel:
            column = fitter.own.index(item)
            with np.errstate(divide="ignore", invalid="ignore"):
                together = np.sqrt(solution.pixel_bound[:, column, column]) * scale
                alone_map = scale / np.sqrt(np.where(information[:, i] > 0, information[:, i], np.nan))
            maps[item.name], alone_maps[item.name] = together.reshape(seen.shape), alone_map.reshape(seen.shape)
            counted = slice(None) if item.name == BACKGROUND or not seen.any() else seen.reshape(-1)
            error, alone = (float(np.nanmedian(part[counted])) for part in (together, alone_map))
        else:
            row, total = fitter.shared.index(item), float(information[:, i].sum())
            error = math.sqrt(max(float(covariance[row, row]), 0.0)) * scale
            alone = scale / math.sqrt(total) if total > 0 else math.inf
        rows[item.name] = Bound(
            name=item.name,
            value=value,
            standard_error=error,
            alone=alone,
            relative=error / value if item.name != DEPTH and value else math.nan,
            per_pixel=item.per_pixel,
            unit=item.unit,
        )
    found = Bounds(
        bounds=rows,
        names=[item.name for item in fitter.shared],
        covariance=covariance,
        maps=maps,
        alone_maps=alone_maps,
        counts=float(law.mean(halves[0].rates, law.planned(halves[0].rates, pulses)).sum()),
        pulses=pulses,
        photons=render.photons,
        simulation=share,
        warnings=(),
    )
    in_logarithm = [state.values[name] > 0 and name != DEPTH for name in found.names]
    warnings = render.warnings() + found.not_identifiable(in_logarithm)
    return replace(found, warnings=(*warnings, *fitter.simulation_warning(share)))


# Coarse steps


def _in_blocks(
    law: Law, half: Half, trials: Rows, counts: NDArray[Any], scales: Floats, limits: Rows, image: tuple[int, int]
) -> tuple[Floats, Floats, Floats]:
    """Counts, their mean `[block, bin]` and its relative derivatives `[unknown, block, bin]` in blocks of pixels.

    `scales` `[unknown]`: units of the unknowns; `limits`: of the derivatives by the unknowns of the scene.
    """
    rows, columns = (np.arange(size) * min(_ACROSS, size) // size for size in image)
    blocks = (rows[:, None] * (columns[-1] + 1) + columns).reshape(-1)
    shape = (int(blocks.max()) + 1, law.recorded)
    observed, mean = np.zeros(shape), np.zeros(shape)
    slopes = np.zeros((len(scales), *shape))
    for block in range(shape[0]):
        chosen = np.flatnonzero(blocks == block)
        by_unknowns = np.ascontiguousarray(half.slopes[0][:, chosen].transpose(1, 0, 2))
        observed[block] = counts[chosen].sum(axis=0)
        mean[block] = law.mean(half.rates[chosen], trials[chosen]).sum(axis=0)
        slopes[:, block] = law.slopes(half.rates[chosen], by_unknowns, trials[chosen]).sum(axis=0) * scales[:, None]
    mean += 1e-3  # of a count: a block that no photon has reached can still have one
    bounds = (limits * scales)[:, None, None]
    return observed, mean, np.clip(slopes / mean, -bounds, bounds)


def _coarse_step(
    counts: Floats, mean: Floats, slopes: Floats, largest: Floats, prior: tuple[Floats, Floats]
) -> tuple[Floats, Floats]:
    """Step within ± `largest` `[unknown]` that maximises an exponential model's likelihood, and its standard errors:
    means times exp(Σ relative derivative · step). `prior`: score and information from elsewhere."""
    from scipy.optimize import minimize

    pull, known = prior
    slopes = slopes.reshape(largest.size, -1).T
    mean, counts = mean.reshape(-1), counts.reshape(-1)
    linear, total = counts @ slopes + pull, max(counts.sum(), 1.0)

    def loss(step: Floats) -> tuple[float, Floats]:
        expected = mean * np.exp(np.minimum(slopes @ step, 60.0))
        value = expected.sum() - linear @ step + 0.5 * (known * step * step).sum()
        return value / total, (expected @ slopes - linear + known * step) / total

    bounds = [(-size, size) for size in largest]
    best = minimize(loss, np.zeros(largest.size), jac=True, method="L-BFGS-B", bounds=bounds, options={"ftol": 1e-12})
    expected = mean * np.exp(np.minimum(slopes @ best.x, 60.0))
    information = (slopes * expected[:, None]).T @ slopes + np.diag(known)
    variance = np.diag(np.linalg.pinv(information))
    return best.x, np.sqrt(np.maximum(variance, 0.0))


def _middle_depth(depth: NDArray[np.floating]) -> float:
    """Depth in the pixel nearest to the middle of the image that sees a target [m]; 0 without any."""
    there = np.argwhere(np.isfinite(depth))
    away = ((there - 0.5 * (np.array(depth.shape) - 1)) ** 2).sum(axis=1)
    return float(depth[tuple(there[away.argmin()])]) if len(there) else 0.0
