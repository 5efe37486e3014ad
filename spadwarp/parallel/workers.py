"""Who runs the jobs: a device of this host, or workers of Ray, each an actor that does one thing at a time and is
replaced when it is lost; and the signals that interrupt them."""

from __future__ import annotations

import logging
import math
import os
import secrets
import signal
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, NamedTuple

from spadwarp.device import core_count, physical_memory, pick_device, processor_name
from spadwarp.values import ArgumentError, ConfigError, DeviceError, check_integer, shown

__all__ = ["Ray", "Worker", "interruptible"]


@dataclass(frozen=True)
class Ray:
    """Workers of Ray, each a process with one GPU or, on machines without GPUs, with a share of the cores."""

    address: str | None = None
    """Of a running cluster, "auto" or "host:port"; None takes the cluster that RAY_ADDRESS names or that this process
    is connected to, else starts Ray on this machine alone."""
    workers: int | None = None
    """How many; by default one for each GPU of the cluster, else one for each of its machines."""

    def __post_init__(self) -> None:
        if not isinstance(self.address, str | None):
            raise ArgumentError(f"address = {shown(self.address)} is not text such as 'auto' or 'host:6379'")
        if self.workers is not None:
            object.__setattr__(self, "workers", check_integer("workers", self.workers, "[1, 100000]"))


@dataclass(eq=False)
class Worker:
    """The process and device that run a job."""

    device: str  # "cpu" or "cuda:0", ...; what `device=` takes
    threads: int | None = None  # CPU threads that it may use; None: as many as there are cores
    stopped: threading.Event = field(default_factory=threading.Event)
    """Set when the run was interrupted. A job that has begun is waited for; a long one may end early."""
    state: dict[str, Any] = field(default_factory=dict)  # kept from one job to the next on this worker


class Event(NamedTuple):
    """Something that a worker did; see `RayWorkers.wait`."""

    kind: str
    worker: Any
    value: Any = None


# Ray

RETRIES = 3
"""How often a job whose worker was lost runs again; a job that loses more is likely what kills them."""

_PATIENCE = 30.0  # seconds without any worker after which a remark says so


class _Actor:
    """The process of a worker. Ray calls it from two threads, so that `stop` arrives while `run` is under way."""

    def __init__(self, cuda: bool, threads: int) -> None:
        self._cuda, self._threads = cuda, threads

    def join(self, prepare: Callable[[Worker], None] | None) -> dict[str, Any]:
        cuda = pick_device("cuda:0") if self._cuda else None  # Ray shows a process no GPU but its own
        device = "cpu" if cuda is None else cuda.alias
        self._worker = Worker(device, None if self._cuda else self._threads)
        if prepare is not None:
            prepare(self._worker)
        found = {"host": socket.gethostname(), "pid": os.getpid()}
        return {**found, "device": device, "device_name": processor_name(cuda)}

    def run(self, work: Callable[..., Any], arguments: tuple[Any, ...]) -> Any:
        return work(*arguments, self._worker)

    def stop(self) -> None:
        self._worker.stopped.set()


@dataclass(eq=False)
class RayWorker:
    """One worker; `metadata` has its host, pid and device once it has joined."""

    actor: Any
    metadata: dict[str, Any] | None = None


class RayWorkers:
    """Workers for the length of a `with` block.

    Args:
        engine: Which cluster, how many.
        device: "cpu" or "cuda"; None: GPUs if the cluster has any.
        prepare: What each worker runs first: a function of a module, or a `functools.partial` of one.
        value_bytes: Size of the largest value that a worker returns, for the memory that Ray reserves.
        note: Called with remarks: which workers have joined, which were lost.

    Raises:
        ConfigError, DeviceError: Ray cannot be reached, or has no such devices.
    """

    def __init__(
        self,
        engine: Ray,
        device: str | None = None,
        *,
        prepare: Callable[[Worker], None] | None = None,
        value_bytes: int = 0,
        note: Callable[[str], None] | None = None,
    ) -> None:
        if device not in (None, "cpu", "cuda", "cuda:all"):
            raise ConfigError(f"device = {device!r} cannot be combined with Ray, which gives each worker its GPU")
        self._engine, self._device, self._prepare = engine, device, prepare
        self._value_bytes, self._note = value_bytes, note or (lambda text: None)
        self._pending: dict[Any, tuple[Literal["joined", "returned"], RayWorker]] = {}
        self.workers: list[RayWorker] = []
        self.joined: list[dict[str, Any]] = []
        self._losses = 0  # since something was returned
        self._patience = math.inf

    def __enter__(self) -> RayWorkers:
        import ray

        self._ray = ray
        self._started = not ray.is_initialized()
        try:
            if self._started:
                _start(ray, self._engine, self._value_bytes)
            self._options, count = self._actors()
            for _ in range(count):
                self._start_worker()
            self._patience = time.monotonic() + _PATIENCE
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        for worker in self.workers:
            with suppress(Exception):
                self._ray.kill(worker.actor)
        if self._started:
            self._ray.shutdown()

    def _actors(self) -> tuple[dict[str, Any], int]:
        """Options of an actor, and the number of workers."""
        nodes = [node["Resources"] for node in self._ray.nodes() if node["Alive"]]
        gpus = int(sum(node.get("GPU", 0) for node in nodes))
        self.cuda = gpus > 0 if self._device is None else self._device != "cpu"
        if self.cuda and not gpus and self._engine.workers is None:
            raise DeviceError("the Ray cluster has no GPU; for one that will grow give the number of workers")
        if self.cuda:
            return {"num_gpus": 1, "num_cpus": 1}, self._engine.workers or gpus
        cores = [node["CPU"] for node in nodes if node.get("CPU", 0) >= 1]
        count = self._engine.workers or len(cores)
        if not cores:
            raise DeviceError("the Ray cluster has no free CPU cores")
        # As many cores for each as there can be if the workers are spread evenly.
        share = next(k for k in range(int(max(cores)), 0, -1) if k == 1 or sum(n // k for n in cores) >= count)
        return {"num_cpus": int(share)}, count

    def _start_worker(self) -> None:
        options = {"max_concurrency": 2, "max_restarts": 0, "scheduling_strategy": "SPREAD", **self._options}
        kind: Any = self._ray.remote(_Actor)
        actor = kind.options(**options).remote(self.cuda, self._options["num_cpus"])
        worker = RayWorker(actor)
        self.workers.append(worker)
        self._pending[actor.join.remote(self._prepare)] = "joined", worker

    @property
    def idle(self) -> list[RayWorker]:
        """Workers that have joined and have nothing to do."""
        busy = {id(worker) for _, worker in self._pending.values()}
        return [worker for worker in self.workers if id(worker) not in busy]

    def send(self, worker: RayWorker, work: Callable[..., Any], *arguments: Any) -> None:
        """Lets an idle worker run `work(*arguments, worker)`."""
        self._pending[worker.actor.run.remote(work, arguments)] = "returned", worker

    def wait(self, timeout: float) -> list[Event]:
        """Events, waiting for `timeout` seconds at most: a worker "joined", "returned" a value, or was "lost" with what
        it was doing. Raises what a worker raised."""
        if self._patience < time.monotonic() and all(worker.metadata is None for worker in self.workers):
            found = self._ray.cluster_resources()
            has = ", ".join(f"{found.get(name, 0):g} {name}" for name in ("CPU", "GPU"))
            self._note(f"no worker has joined yet; the cluster has {has}")
            self._patience = math.inf
        done, _ = self._ray.wait(list(self._pending), num_returns=1, timeout=timeout)
        return [self._event(reference) for reference in done]

    def _event(self, reference: Any) -> Event:
        errors = self._ray.exceptions
        kind, worker = self._pending.pop(reference)
        try:
            value = self._ray.get(reference)
        except errors.RayTaskError as error:
            raise error.cause if isinstance(error.cause, Exception) else error from None
        except errors.RayError as error:
            self._replace(worker, error)
            return Event("lost", worker)
        if kind == "joined":
            worker.metadata = value
            self.joined.append(value)
            self._note(f"worker {_description(worker)}")
        else:
            self._losses = 0
        return Event(kind, worker, value)

    def _replace(self, worker: RayWorker, error: Exception) -> None:
        self.workers.remove(worker)
        with suppress(Exception):
            self._ray.kill(worker.actor)
        self._losses += 1
        if self._losses > (RETRIES + 1) * (len(self.workers) + 1):
            raise DeviceError(f"Ray lost {self._losses} workers in a row: {_first_line(error)}") from error
        self._note(f"lost the worker {_description(worker)}; a new one is started")
        self._start_worker()

    def stop(self) -> None:
        """Sets `Worker.stopped` of every worker that has joined."""
        for worker in self.workers:
            if worker.metadata is not None:
                worker.actor.stop.remote()


def _start(ray: Any, engine: Ray, value_bytes: int) -> None:
    """Connects to a cluster, or starts Ray on this machine, without messages of its own."""
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # nothing is sent anywhere
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")  # else a warning in every worker
    os.environ.setdefault("RAY_IGNORE_UNHANDLED_ERRORS", "1")  # those that matter are raised by `RayWorkers.wait`
    address = engine.address or os.environ.get("RAY_ADDRESS")
    options: dict[str, Any] = {"address": address}
    if address is None:
        _require_token(ray)
        # For a value of each worker and what is being written; a third of the memory is Ray's own default.
        reserve = max(256 << 20, int(1.25 * value_bytes * ((engine.workers or 8) + 2)))
        reserve = min(reserve, (physical_memory() or 3 * reserve) // 3)
        options = {
            "address": "local",
            "num_cpus": max(core_count(), engine.workers or 1),
            "include_dashboard": False,
            "object_store_memory": reserve,
        }
    main = threading.current_thread() is threading.main_thread()
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        ray.init(**options, logging_level=logging.ERROR, log_to_driver=False)
    except (ConnectionError, RuntimeError, ValueError, OSError) as error:
        cluster = f"at {address}" if address else "on this machine"
        raise DeviceError(f"Ray cannot be reached {cluster}: {_first_line(error)}") from error
    finally:
        # Ray's own would end the program at SIGTERM.
        for number, handler in handlers.items() if main else ():
            signal.signal(number, handler)


def _require_token(ray: Any) -> None:
    """Lets nobody reach the Ray that is started here without a token: it listens on every interface of the machine.

    Ray asks for one by itself since 2.60. The user's own setting and token hold where there are any.
    """
    if tuple(map(int, ray.__version__.split(".")[:2])) < (2, 60):
        raise ConfigError(f"Ray is started on this machine with a token, which needs ray ≥ 2.60, not {ray.__version__}")
    own = "RAY_AUTH_TOKEN" in os.environ or "RAY_AUTH_TOKEN_PATH" in os.environ
    if not own and not Path("~/.ray/auth_token").expanduser().exists():
        os.environ["RAY_AUTH_TOKEN"] = secrets.token_hex(32)  # kept: Ray reads it once a process


def _description(worker: RayWorker) -> str:
    text = "that had not joined yet" if worker.metadata is None else "{host} {device} ({device_name}), process {pid}"
    return text.format_map(worker.metadata or {})


def _first_line(error: BaseException) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0]


# Signals

_handled = threading.Lock()


@contextmanager
def interruptible() -> Iterator[threading.Event]:
    """An event that Ctrl-C, or SIGTERM as job schedulers send it, sets; a second signal raises KeyboardInterrupt.

    Within another `interruptible`, and outside the main thread, which alone receives signals, nothing sets the event:
    the outer block decides.
    """
    interrupted = threading.Event()
    if threading.current_thread() is not threading.main_thread() or not _handled.acquire(blocking=False):
        yield interrupted
        return

    first = 0.0

    def handle(number: int, frame: object) -> None:
        nonlocal first
        # Some programs send one interrupt twice, to a process and to its group: a second one counts after 1 s.
        if interrupted.is_set() and time.monotonic() > first + 1.0:
            raise KeyboardInterrupt
        if not interrupted.is_set():
            first = time.monotonic()
        interrupted.set()

    before = {number: signal.signal(number, handle) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield interrupted
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        _handled.release()
