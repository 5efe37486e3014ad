"""Maximum likelihood of counts: water, surfaces, background and depth from one exposure."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from spadwarp.errors import ArgumentError, ConfigError
from spadwarp.inverse.coarse import blocks_of, coarse_step, in_cells
from spadwarp.inverse.depth_slope import Local, locally_solved
from spadwarp.inverse.equations import Law
from spadwarp.inverse.estimates import Fit, Iteration
from spadwarp.inverse.exposure import Exposure, read_exposure
from spadwarp.inverse.rendering import Half, Renderer
from spadwarp.inverse.report import estimates_of
from spadwarp.inverse.solving import Solution, solve
from spadwarp.inverse.start import lidar_start
from spadwarp.inverse.unknowns import BACKGROUND, DEPTH, Unknown, read_unknowns, start_value
from spadwarp.inverse.weighing import solved
from spadwarp.limits import SEED, check_integer, check_real
from spadwarp.scene import SceneLike, as_scene
from spadwarp.transport import truth_maps

if TYPE_CHECKING:
    from spadwarp.scene import Detector

__all__ = ["BATCHES", "PHOTONS", "SIMULATION", "Fitter", "checked_prior", "detector_law", "fit"]

Floats = NDArray[np.float64]
Progress = Callable[[str, int, int], None]

PHOTONS = {"cpu": 20_000_000, "cuda": 400_000_000}
_COARSE, _FINE = 16, 8  # renderings at most
_FEWEST, _FEWER, _FEW = 128, 32, 16  # divide the photons: of the first coarse rendering, the last, the first fine one
BATCHES = 4  # of photons in each half
_SETTLED = 0.3  # of the largest coarse step: from there Fisher scoring converges, and few photons say no more
_CONVERGED = 1.0  # gain of the log-likelihood for each unknown: half of it is expected from the counts' own noise
_PATIENCE = 3  # fine renderings, after which the depth's slope is looked at
_LEFT = 0.01  # gain for each unknown that a further step would bring: a seventh of a standard error
SIMULATION = 0.1  # of the variance by the counts
_STEP = {"log": 1.1, "depth": 0.05, "anisotropy": 0.05}


def fit(
    counts: Any,
    scene: SceneLike,
    *,
    unknown: str | Sequence[str],
    start: Mapping[str, float] | None = None,
    prior: Mapping[str, tuple[float, float]] | None = None,
    pulses: int | None = None,
    photons: int | None = None,
    seed: int = 0,
    device: str | None = None,
    progress: Progress | None = None,
    **facts: Any,
) -> Fit:
    """Values of unknowns of a scene that make counts most likely, with covariance and 95 % intervals.

    The model is the whole chain: transport, instrument response, dark counts and ambient light, pile-up or dead time.
    Each iteration renders the scene anew with photons that no other has used, histograms and derivatives. Far from the
    solution pixels are added up and an exponential model is fitted; then Fisher scoring on all pixels and bins, until
    the log-likelihood has no more to gain than the noise of the counts. Noise of the simulation is in the covariance.

    Args:
        counts: Frames (`detect`, or their file), measured histograms (`spadwarp.frames.read_histograms`, or a file), or
            integers `[H, W, T]` on the scene's gate.
        scene: What is known, and where to start.
        unknown: Names, such as "medium.absorption,medium.scattering,targets[0].reflectance,depth:pixel"; see
            `spadwarp.inverse.read_unknowns`.
        start: Values to start from, by name, depth as a shift from the scene's [m]; by default absorption and
            scattering from the backscatter (`spadwarp.inverse.lidar_start`), the others of the scene.
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
    return fitter.fit(start=start, progress=progress)


def detector_law(detector: Detector, window: Any) -> Law:
    """How a detector counts in the model. Raises `ConfigError` for what it leaves out."""
    if detector.afterpulsing_probability > 0:
        raise ConfigError(
            f"detector.afterpulsing_probability = {detector.afterpulsing_probability}: a fit does not model it"
        )
    if detector.max_count > 0:
        raise ConfigError(f"detector.max_count = {detector.max_count}: a fit does not model full counters")
    free = detector.mode == "free_running"
    return Law(not free, detector.dead_time_ns * 1e-9 / window.period if free else 0.0, window.recorded)


@dataclass
class _State:
    """Values of the unknowns; those of pixels `[pixel]`, depth as a shift."""

    values: dict[str, Any]
    iterations: list[Iteration]

    def scales(self, unknowns: Sequence[Unknown], pixels: int) -> Floats:
        """d(value)/d(what is searched), `[pixel, unknown]`."""
        scales = np.ones((pixels, len(unknowns)))
        for column, one in enumerate(unknowns):
            if one.is_positive:
                scales[:, column] = self.values[one.name]
        return scales

    def shared(self) -> dict[str, float]:
        """One number for each name: that of a map is its mean."""
        return {name: float(np.nanmean(value)) for name, value in self.values.items()}

    def move(self, one: Unknown, step: Any) -> None:
        """Takes a step on the scale that is searched."""
        largest = _STEP[_kind(one)]
        step = np.clip(np.nan_to_num(step), -largest, largest)
        value = self.values[one.name]
        value = value * np.exp(step) if one.is_positive else value + step
        if one.name.endswith("reflectance"):
            value = np.minimum(value, 1.0)
        if one.name == "medium.anisotropy":
            value = np.clip(value, -0.99, 0.99)
        self.values[one.name] = value if one.per_pixel else float(value)


def _kind(one: Unknown) -> str:
    """The scale on which an unknown is searched."""
    return "log" if one.is_positive else "depth" if one.name == DEPTH else "anisotropy"


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
        prior: Mapping[str, tuple[float, float]] | None = None,
        photons: int | None = None,
        seed: int = 0,
        device: str | None = None,
    ) -> None:
        from spadwarp.device import pick_device

        self.scene = as_scene(scene)
        self.unknowns = read_unknowns(self.scene, unknown)
        self.exposure, self.device = exposure, device
        kind = "cuda" if pick_device(device).is_cuda else "cpu"
        self.photons = PHOTONS[kind] if photons is None else check_integer("photons", photons, "[1000, 1e12]")
        seed = check_integer("seed", seed, SEED)
        self.render = Renderer(self.scene, self.unknowns, exposure, device=device, seed=seed)
        self.prior = checked_prior(prior or {}, self.unknowns)
        self.law = detector_law(self.scene.detector, self.render.window)
        self._image = (self.scene.camera.height, self.scene.camera.width)

    # One fit

    def fit(
        self, *, start: Mapping[str, float] | None = None, near: bool = False, progress: Progress | None = None
    ) -> Fit:
        """Fits the exposure from `start`, as `spadwarp.fit` does; `near`: it is within some standard errors already."""
        began = time.perf_counter()
        first = self.render.photons
        state = self._start(start)
        begin = state.shared()
        report = (lambda text: None) if progress is None else lambda text: progress(f"fit: {text}", 0, 0)
        trials = self.exposure.left() if self.law.first_photon else self._all_pulses()
        if not near:
            self._approach(state, trials, report)
        halves, local, converged = self._refine(state, trials, report)
        return estimates_of(
            scene=self.scene,
            unknowns=self.unknowns,
            values=state.values,
            start=begin,
            solution=local.solution,
            scales=state.scales(self.unknowns, len(trials)),
            iterations=state.iterations,
            converged=converged,
            prior=self.prior,
            exposure=self.exposure,
            expected=self.law.mean(0.5 * (halves[0].rates + halves[1].rates), trials),
            truth=truth_maps(self.scene, device=self.device),
            edges=self.render.window.start + self.render.window.edges[: self.law.recorded + 1],
            photons=self.render.photons - first,
            seconds=time.perf_counter() - began,
            warnings=[*self.render.warnings(), *local.warnings(self.scene)],
        )

    def _all_pulses(self) -> NDArray[np.float32]:
        assert self.exposure.counts is not None
        return np.full(self.exposure.counts.shape, self.exposure.pulses, np.float32)

    def _start(self, start: Mapping[str, float] | None) -> _State:
        given = {} if start is None else dict(start)
        names = {one.name for one in self.unknowns}
        for name in given:
            if name not in names:
                raise ArgumentError(f"start: {name} is not an unknown; these are {', '.join(sorted(names))}")
        water = {"medium.absorption", "medium.scattering"} & names - set(given)
        if water:
            lidar = lidar_start(self.scene, self.exposure, device=self.device)
            given = {**{name: value for name, value in lidar.items() if name in water}, **given}
        values: dict[str, Any] = {}
        for one in self.unknowns:
            value = check_real(f"start of {one.name}", given.get(one.name, start_value(self.scene, one)))
            if one.is_positive and value <= 0.0:
                value = 1.0 if one.name == BACKGROUND else 0.01
            values[one.name] = np.full(self._image[0] * self._image[1], value) if one.per_pixel else value
        return _State(values, [])

    # Iterations

    def _approach(self, state: _State, trials: NDArray[np.float32], report: Callable[[str], None]) -> None:
        """Coarse steps of the shared unknowns, with few photons at first, until Fisher scoring can do the rest."""
        shared = [i for i, one in enumerate(self.unknowns) if not one.per_pixel]
        if not shared:
            return
        blocks, photons = blocks_of(self._image), self.photons // _FEWEST
        largest = np.array([0.7 if self.unknowns[i].is_positive else 0.02 for i in shared])
        assert self.exposure.counts is not None
        for _ in range(_COARSE):
            photons = max(photons, 1000)
            (half,) = self.render(state.values, photons=photons, halves=1)
            scales = state.scales(self.unknowns, 1)[0]
            cells = in_cells(self.law, half, trials, self.exposure.counts, scales, blocks)
            cells.slopes = cells.slopes[:, shared]
            pull, information = self._prior_at(state, shared)
            step, error = coarse_step(cells, largest, pull, information)
            gain = 0.5 * float(np.sum((step / np.maximum(error, 1e-12)) ** 2))
            state.iterations.append(Iteration(values=state.shared(), gain=gain, photons=photons, coarse=True))
            for i, one in zip(shared, step, strict=True):
                state.move(self.unknowns[i], one)
            report(", ".join(f"{name} {value:.4g}" for name, value in state.shared().items()))
            if (np.abs(step) < np.maximum(2.0 * error, _SETTLED * largest)).all():
                return
            photons = min(2 * photons, self.photons // _FEWER)

    def _refine(
        self, state: _State, trials: NDArray[np.float32], report: Callable[[str], None]
    ) -> tuple[list[Half], Local, bool]:
        """Fisher scoring with fresh photons: few at first, as many as the noise of the simulation asks for at last."""
        shared = [i for i, one in enumerate(self.unknowns) if not one.per_pixel]
        photons, level, bent = max(self.photons // _FEW, 8000), None, False
        for number in range(_FINE):
            halves = self.render(state.values, photons=photons // (2 * BATCHES), batches=BATCHES)
            look = bent or number >= _PATIENCE
            level, local = self._solved(state, halves, trials, shared, level, look, photons // (2 * BATCHES))
            bent = bent or local.ratio != 1.0
            solution, converged, left = local.solution, self._converged(local), self._left(local)
            state.iterations.append(Iteration(values=state.shared(), gain=solution.gain, photons=photons, coarse=False))
            self._step(state, solution)
            report(", ".join(f"{name} {value:.5g}" for name, value in state.shared().items()))
            needed = int(photons * max(solution.simulation_share / (0.8 * SIMULATION), 1.0))
            more = min(needed, self.photons, needed if left <= _CONVERGED * max(len(shared), 1) else 4 * photons)
            noisy = solution.simulation_share > SIMULATION and more > 1.2 * photons
            if converged and not noisy:
                break
            photons = max(photons, more)
        return halves, local, converged

    def _solved(
        self,
        state: _State,
        halves: list[Half],
        trials: NDArray[np.float32],
        shared: Sequence[int],
        level: int | None,
        look: bool,
        photons: int,
    ) -> tuple[int, Local]:
        """The level of cells and the step from a rendering.

        Where the fit has converged, and with `look`, the depth's slope is traced anew around the present depth with so
        many `photons`.
        """
        scales, prior = state.scales(self.unknowns, len(trials)), self._prior_at(state, shared)
        given: dict[str, Any] = {"law": self.law, "halves": halves, "trials": trials}
        counted = {"counts": self.exposure.counts, "pulses": self.exposure.pulses}
        level, equations, solution = solved(
            self.unknowns, scales, level=level, image=self._image, prior=prior, **given, **counted
        )
        wide = Local(solution, 1.0)
        if not (look or self._converged(wide)):
            return level, wide
        is_own = np.array([one.per_pixel for one in self.unknowns])
        return level, locally_solved(
            equations,
            solution,
            lambda found: solve(found, is_own, prior=prior[1], pull=prior[0]),
            render=self.render,
            values=state.values,
            scales=scales,
            photons=photons,
            **given,
        )

    def _converged(self, local: Local) -> bool:
        """Whether the step gains less than the noise of the counts, or leaves next to nothing."""
        size = max(sum(not one.per_pixel for one in self.unknowns), 1)
        return local.solution.gain <= _CONVERGED * size or self._left(local) <= _LEFT * size

    def _left(self, local: Local) -> float:
        """What the log-likelihood can still gain after the step.

        Newton's error is the square of the step; of the depth also what the slope changes within its error.
        """
        solution = local.solution
        shared = [one for one in self.unknowns if not one.per_pixel]
        if len(shared) < len(self.unknowns):
            return solution.gain
        straight = {"log": 0.5, "depth": self.render.depth_step, "anisotropy": 0.025}
        parts = [step / straight[_kind(one)] for one, step in zip(shared, solution.shared, strict=True)]
        parts.append(local.bend)
        return solution.gain * min(float(np.max(np.square(parts))), 1.0)

    def _step(self, state: _State, solution: Solution) -> None:
        shared, own = iter(solution.shared), iter(solution.own.T)
        for one in self.unknowns:
            state.move(one, next(own) if one.per_pixel else next(shared))

    def _prior_at(self, state: _State, shared: Sequence[int]) -> tuple[Floats, Floats]:
        """Score and information of the priors on the searched scale, `[S]` both."""
        pull, information = np.zeros(len(shared)), np.zeros(len(shared))
        for row, i in enumerate(shared):
            one = self.unknowns[i]
            if one.name in self.prior:
                mean, deviation = self.prior[one.name]
                value = state.values[one.name]
                scale = value if one.is_positive else 1.0
                information[row] = (scale / deviation) ** 2
                pull[row] = (mean - value) * scale / deviation**2
        return pull, information


def checked_prior(
    prior: Mapping[str, tuple[float, float]], unknowns: Sequence[Unknown]
) -> dict[str, tuple[float, float]]:
    """Mean and standard deviation by name. Raises `ArgumentError`."""
    names = [one.name for one in unknowns if not one.per_pixel]
    found = {}
    for name, pair in prior.items():
        if name not in names:
            raise ArgumentError(f"prior: {name} is not an unknown of the whole exposure; these are {', '.join(names)}")
        if not (isinstance(pair, tuple | list) and len(pair) == 2):
            raise ArgumentError(f"prior of {name} = {pair!r} is not (mean, standard deviation)")
        mean = check_real(f"prior of {name}: mean", pair[0])
        found[name] = (mean, check_real(f"prior of {name}: standard deviation", pair[1], "(0, inf)"))
    return found
