"""Photons on one device: launches into tallies of its own."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

import spadwarp_kernels as sk
from spadwarp.arrays import caller_tallies
from spadwarp.errors import DeviceError, SpadwarpError, kernel_errors
from spadwarp.result import COMPONENTS, SignedTallies, Tallies
from spadwarp.result.batch_moments import joined_moments, moments_of
from spadwarp.result.merging import OVERFLOW
from spadwarp.result.photon_ids import IdQueue, Range, Ranges, joined

__all__ = ["DeviceWorker", "device_errors"]


class DeviceWorker:
    """A device with a model and tallies of its own.

    Args:
        model: From `build_model`.
        spec: From `transport_spec`.
        seed: 64-bit.
        launch_size: Photons in one launch at most.
        threads: Launches at a time. On a CPU all of them add to one tally, with atomics of their own.
        batch_size: Photons of a batch, for the error of every bin; 0: no batches.
        tallies: The caller's own, to be filled.
        histogram: False: none is made, for records of photons without a camera.
        derivatives, channels: Names of those of the spec, which has one kind of them.
    """

    def __init__(
        self,
        model: sk.Model,
        spec: Any,
        *,
        seed: int,
        launch_size: int,
        threads: int = 1,
        batch_size: int = 0,
        tallies: Any = None,
        histogram: bool = True,
        derivatives: tuple[str, ...] = (),
        channels: tuple[str, ...] = (),
    ) -> None:
        camera, gate = model.camera, model.gate
        self._shape = (len(COMPONENTS), camera.height, camera.width, gate.bins)
        own = None if tallies is None else caller_tallies(tallies, shape=self._shape, device=model.device)
        self.model, self.threads, self.launch_size = model, threads, launch_size
        self._spec, self._seed, self._batch_size = spec, seed, batch_size
        with device_errors(model.device):
            signed = len(derivatives) + len(channels)
            self.data = sk.make_data(model, tally=None if batch_size else own, histogram=histogram, derivatives=signed)
            self._batches = sk.Batches(self.data.tally, len(COMPONENTS), total=own) if batch_size else None
            gradients = self._gradients = self.data.gradients
            self._gradient_batches = None
            if batch_size and gradients is not None:
                self._gradient_batches = sk.Batches(gradients, len(COMPONENTS), signed=True)
            # Compiles, or loads from Warp's cache, before the time of the launches is taken.
            most = min(launch_size, batch_size or launch_size)
            sk.load_transport_kernel(spec, model.device, model=model, photon_count=most)
        self._names, self._channels = derivatives, channels
        self._closed: tuple[dict[str, int], ...] | None = None  # ledger and counters of the batches
        self._moments: dict[str, int] = {}

    def launch(self, first: int, stop: int) -> None:
        """Traces the photons of one launch to their end."""
        self._wait(self._begin(first, stop))

    def _begin(self, first: int, stop: int) -> wp.Event | None:
        """Gives a launch to the device, for whose end `_wait` waits; on a CPU it has ended then."""
        device = self.model.device
        with device_errors(device):
            sk.launch_transport(
                self._spec, self.model, self.data, seed=self._seed, first_id=first, photon_count=stop - first
            )
            return device.stream.record_event() if device.is_cuda else None

    def _wait(self, end: wp.Event | None) -> None:
        if end is not None:
            with device_errors(self.model.device):
                wp.synchronize_event(end)

    def _launched(self, spans: Iterable[Range]) -> Iterator[Range]:
        """Traces a launch for each span and yields it when that has ended; a GPU has the next before."""
        ahead = 1 if self.model.device.is_cuda else 0
        running: list[tuple[Range, wp.Event | None]] = []
        for span in spans:
            running.append((span, self._begin(*span)))
            if len(running) > ahead:
                ended, end = running.pop(0)
                self._wait(end)
                yield ended
        for ended, end in running:
            self._wait(end)
            yield ended

    def trace(
        self, block: Range, *, stopped: threading.Event, report: Callable[[int], None] = lambda photons: None
    ) -> Ranges:
        """Traces photons; returns the ids that were done before `stopped` was set, with batches those of whole ones.

        Args:
            block: The ids; with batches whole batches.
            stopped: Once set, no further launch begins.
            report: Called with the photons of each launch, from the thread that ran it.
        """
        if self._batches is None:
            traced = self._trace(block, stopped, report)
            self._check_overflow()
            return traced
        done: list[Range] = []
        for first in range(*block, self._batch_size):
            batch = first, first + self._batch_size
            if self._trace(batch, stopped, report) != (batch,):
                self._empty([self.data.tally, self.data.ledger, self._gradients])
                break
            self._close_batch()
            done.append(batch)
        self._check_overflow()
        return joined(done)

    def _check_overflow(self) -> None:
        """After every block of photons, long before an integer could go round and look right again."""
        with device_errors(self.model.device):
            if self._batches is not None:
                batches = [self._batches, self._gradient_batches]
                overflowed = any(one.has_overflowed() for one in batches if one is not None)
            else:
                overflowed = sk.has_overflowed(self.data.tally)
                if self._gradients is not None:
                    overflowed = overflowed or sk.has_overflowed(self._gradients, signed=True)
        if overflowed:
            raise SpadwarpError(OVERFLOW)

    def _trace(self, ids: Range, stopped: threading.Event, report: Callable[[int], None]) -> Ranges:
        waiting, done, lock = IdQueue([ids]), list[Range](), threading.Lock()
        failures: list[BaseException] = []

        def spans() -> Iterator[Range]:
            while not (stopped.is_set() or failures):
                with lock:
                    span = waiting.take(self._size(waiting.left))
                if span is None:
                    return
                yield span

        def work() -> None:
            try:
                for span in self._launched(spans()):
                    with lock:
                        done.append(span)
                    report(span[1] - span[0])
            except BaseException as error:
                failures.append(error)

        helpers = [threading.Thread(target=work, daemon=True) for _ in range(self.threads - 1)]
        for thread in helpers:
            thread.start()
        work()
        for thread in helpers:
            thread.join()
        if failures:
            raise failures[0]
        return joined(done)

    def _size(self, left: int) -> int:
        """Photons of the next launch, fewer towards the end so that all threads end at about the same time."""
        share = left // (2 * self.threads) if self.threads > 1 else left
        return min(self.launch_size, max(share, self.launch_size // 16, 1))

    def _close_batch(self) -> None:
        """Adds a batch whose photons are all done to the totals."""
        assert self._batches is not None
        with device_errors(self.model.device):
            self._batches.close(self.data.tally, threads=self.threads)
            if self._gradients is not None and self._gradient_batches is not None:
                self._gradient_batches.close(self._gradients, threads=self.threads)
            moments = moments_of(COMPONENTS, self._batches.take_sums())
            counts = sk.read_ledger(self.data)
            self.data.ledger.zero_()
        self._add_counts(counts, moments)

    def _add_counts(self, counts: tuple[dict[str, int], ...], moments: dict[str, int]) -> None:
        """Of closed batches."""
        self._closed = counts if self._closed is None else tuple(map(_added, self._closed, counts))
        self._moments = joined_moments(self._moments, moments) if self._moments else moments

    def take_over(self, other: DeviceWorker) -> None:
        """Moves the tallies of another worker of the same run here; both must rest."""
        with device_errors(self.model.device):
            if self._batches is None:
                sk.add_tallies(self.data.tally, other.data.tally)
                sk.add_tallies(self.data.ledger, other.data.ledger)
                if self._gradients is not None and other._gradients is not None:
                    sk.add_tallies(self._gradients, other._gradients)
            elif other._closed is not None:
                pairs = ((self._batches, other._batches), (self._gradient_batches, other._gradient_batches))
                for mine, more in pairs:
                    if mine is not None and more is not None:
                        mine.add(more)
                self._add_counts(other._closed, other._moments)
        self._check_overflow()
        other.clear()

    def tallies(self) -> Tallies:
        """Those of all photons traced here, open batches aside; on the CPU in the memory of this worker."""
        with device_errors(self.model.device):
            if self._batches is None:
                total, second_moment = self.data.tally, None
            else:
                total = self._batches.total
                halves = self._batches.second_moment
                second_moment = np.stack([half.numpy().reshape(self._shape[1:]) for half in halves])
            ledger, counters = self._closed or sk.read_ledger(self.data)
            return Tallies(
                _on_host(total, self.model.device).reshape(self._shape),
                ledger,
                counters,
                second_moment,
                dict(self._moments),
                self._signed_tallies(self._names),
                self._signed_tallies(self._channels),
            )

    def _signed_tallies(self, names: tuple[str, ...]) -> SignedTallies | None:
        """The device has the derivatives or channels of a voxel side by side, the result an array for each."""
        if self._gradients is None or not names:
            return None
        batches, shape = self._gradient_batches, (*self._shape, len(names))
        total = self._gradients if batches is None else batches.total
        moments = None
        if batches is not None:
            moments = np.stack([np.moveaxis(half.numpy().reshape(shape[1:]), -1, 0) for half in batches.second_moment])
        units = self.derivative_units
        if names == self._channels:
            units = tuple(1.0 / float(self.model.derivatives.scale[p]) for p in range(len(names)))
        return SignedTallies(names, np.moveaxis(total.numpy().reshape(shape), -1, 0), units, moments)

    @property
    def derivative_units(self) -> tuple[float, ...]:
        """Of each derivative's tallies [fraction of an emitted photon per unit of the parameter]."""
        found, spec = self.model.derivatives, self._spec
        scales = [found.scale[p] for p in range(len(spec.derivatives))]
        for kind in range(len(spec.blocks)):
            scales += [found.blocks.scale[kind]] * found.blocks.count
        return tuple(1.0 / float(scale) for scale in scales)

    def clear(self) -> None:
        """Empties the tallies."""
        self._closed, self._moments = None, {}
        self._empty([self.data.tally, self.data.ledger, self._gradients])
        for batches in (self._batches, self._gradient_batches):
            if batches is not None:
                self._empty([batches.total, *batches.second_moment])

    def _empty(self, arrays: Sequence[wp.array | None]) -> None:
        for array in arrays:
            if array is not None:
                array.zero_()


def _on_host(array: wp.array, device: wp.Device) -> NDArray[np.int64]:
    """What an array holds; of a GPU in memory of NumPy, which asks Linux for pages of 2 MiB.

    97 MiB of an H200 are there in 31 ms, those of `array.numpy()` in 72 ms, most of it for new pages: in memory that
    was used before they are in 7 ms.
    """
    if not device.is_cuda:
        return np.asarray(array.numpy())
    held = np.empty(array.shape, np.int64)
    wp.copy(wp.array(held, dtype=wp.int64, device="cpu", copy=False), array)
    wp.synchronize_device(device)
    return held


def _added(a: Mapping[str, int], b: Mapping[str, int]) -> dict[str, int]:
    return {name: value + b[name] for name, value in a.items()}


@contextmanager
def device_errors(device: wp.Device) -> Iterator[None]:
    """Turns an error of Warp into a `DeviceError` that names the device, and what kernels refuse into an
    `ArgumentError`."""
    try:
        with kernel_errors():
            yield
    except RuntimeError as error:
        short = "allocate" in str(error) or "out of memory" in str(error)
        problem = "has too little memory left" if short else "failed"
        raise DeviceError(f"{device.alias} {problem}: {error}") from error
