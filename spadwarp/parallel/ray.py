"""A crew of Ray workers: each an actor that does one thing at a time; those that die are replaced."""

from __future__ import annotations

import contextlib
import logging
import math
import os
import signal
import socket
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any, Literal, TypeVar

from spadwarp.device import core_count, physical_memory, pick_device, processor_name
from spadwarp.errors import ConfigError, DeviceError
from spadwarp.parallel import Ray, Worker

Job = TypeVar("Job")
Value = TypeVar("Value")
Note = Callable[[str], None]

# A job that loses its worker this often is not run again: it is likely what kills them.
LIVES = 4

# Seconds after which a crew without any worker is worth a word.
_PATIENCE = 30.0

_MIB = 1 << 20


class _Actor:
    """The process of a worker. Two threads of Ray's call it, so that `stop` is heard while `run` runs."""

    def __init__(self, cuda: bool, threads: int) -> None:
        self._cuda, self._threads = cuda, threads

    def join(self, prepare: Callable[[Worker], None] | None) -> dict[str, Any]:
        device, name = "cpu", processor_name()
        if self._cuda:
            # Ray shows a process no GPU but its own.
            cuda = pick_device("cuda:0")
            device, name = cuda.alias, processor_name(cuda)
        self._worker = Worker(device, None if self._cuda else self._threads)
        if prepare is not None:
            prepare(self._worker)
        return {"host": socket.gethostname(), "pid": os.getpid(), "device": device, "device_name": name}

    def run(self, work: Callable[..., Any], arguments: tuple[Any, ...]) -> Any:
        return work(*arguments, self._worker)

    def stop(self) -> None:
        self._worker.stopped.set()


@dataclass(eq=False)
class Member:
    """One worker as the crew sees it; `about` has its host, pid and device once it has joined."""

    actor: Any
    about: dict[str, Any] | None = None


@dataclass(frozen=True)
class Event:
    """What became of a member: it joined, or returned a value, or was lost with what it was doing."""

    kind: Literal["joined", "returned", "lost"]
    member: Member
    value: Any = None


class Crew:
    """Workers for the length of a `with` block.

    Args:
        engine: Which cluster, how many.
        device: "cpu" or "cuda"; None: GPUs if the cluster has any.
        prepare: What a worker does first, replaced ones too: a function of a module, or a `functools.partial` of one.
        value_bytes: Size of the largest value that a worker returns, for the room that Ray reserves.
        note: Told how many workers there are, and which were lost.

    Raises:
        ConfigError, DeviceError: Ray is not installed, cannot be reached, or has no such devices.
    """

    def __init__(
        self,
        engine: Ray,
        device: str | None = None,
        *,
        prepare: Callable[[Worker], None] | None = None,
        value_bytes: int = 0,
        note: Note | None = None,
    ) -> None:
        if device not in (None, "cpu", "cuda", "cuda:all"):
            raise ConfigError(f"device = {device!r} does not go with Ray, which gives each worker its GPU: cpu or cuda")
        if engine.workers is not None and engine.workers < 1:
            raise ConfigError(f"workers = {engine.workers} is outside [1, inf)")
        self._engine, self._device, self._prepare = engine, device, prepare
        self._value_bytes, self._note = value_bytes, note or (lambda text: None)
        self._pending: dict[Any, tuple[Literal["joined", "returned"], Member]] = {}
        self.members: list[Member] = []
        self._losses = 0  # since something was returned
        self._patience = math.inf

    def __enter__(self) -> Crew:
        try:
            import ray
        except ImportError as error:
            raise ConfigError("engine = Ray needs the package ray: pip install 'spadwarp[ray]'") from error
        self._ray = ray
        self._started = not ray.is_initialized()
        # Ray tells of a worker's death on stdout, which is for answers, and knows no option against it.
        self._print = getattr(ray._private.worker, "print_to_stdstream", None)
        ray._private.worker.print_to_stdstream = lambda *_, **__: None
        try:
            if self._started:
                _start(ray, self._engine, self._value_bytes)
            self._options, count = self._plan()
            for _ in range(count):
                self._hire()
            self._patience = time.monotonic() + _PATIENCE
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        for member in self.members:
            with contextlib.suppress(Exception):
                self._ray.kill(member.actor)
        if self._started:
            self._ray.shutdown()
        if self._print is not None:
            self._ray._private.worker.print_to_stdstream = self._print

    def _plan(self) -> tuple[dict[str, Any], int]:
        """Options of an actor, and how many there shall be."""
        nodes = [node["Resources"] for node in self._ray.nodes() if node["Alive"]]
        gpus = int(sum(node.get("GPU", 0) for node in nodes))
        self.cuda = gpus > 0 if self._device is None else self._device != "cpu"
        if self.cuda and not gpus and self._engine.workers is None:
            raise DeviceError("the Ray cluster has no GPU; for one that will grow say how many workers there shall be")
        if self.cuda:
            return {"num_gpus": 1, "num_cpus": 1}, self._engine.workers or gpus
        cores = [node["CPU"] for node in nodes if node.get("CPU", 0) >= 1]
        count = self._engine.workers or len(cores)
        if not cores:
            raise DeviceError("the Ray cluster has no CPU cores to give away")
        # As many cores for each as there can be if the workers are spread evenly.
        share = next(k for k in range(int(max(cores)), 0, -1) if k == 1 or sum(n // k for n in cores) >= count)
        return {"num_cpus": int(share)}, count

    def _resources(self) -> str:
        there = self._ray.cluster_resources()
        return ", ".join(f"{there.get(name, 0):g} {name}" for name in ("CPU", "GPU"))

    def _hire(self) -> None:
        ray = self._ray
        actor = (
            ray.remote(_Actor)
            .options(max_concurrency=2, max_restarts=0, scheduling_strategy="SPREAD", **self._options)
            .remote(self.cuda, self._options["num_cpus"])
        )
        member = Member(actor)
        self.members.append(member)
        self._pending[actor.join.remote(self._prepare)] = "joined", member

    @property
    def idle(self) -> list[Member]:
        """Members that have joined and have nothing to do."""
        busy = {id(member) for _, member in self._pending.values()}
        return [member for member in self.members if id(member) not in busy]

    @property
    def working(self) -> bool:
        """Whether something that was sent has not come back yet."""
        return any(kind == "returned" for kind, _ in self._pending.values())

    def send(self, member: Member, work: Callable[..., Any], *arguments: Any) -> None:
        """Lets an idle member run `work(*arguments, worker)`."""
        self._pending[member.actor.run.remote(work, arguments)] = "returned", member

    def wait(self, timeout: float) -> list[Event]:
        """What has happened, waiting for `timeout` seconds at most. Raises what a worker raised."""
        if self._patience < time.monotonic() and all(member.about is None for member in self.members):
            self._note(f"no worker has joined yet; the cluster has {self._resources()}")
            self._patience = math.inf
        done, _ = self._ray.wait(list(self._pending), num_returns=1, timeout=timeout)
        return [self._event(reference) for reference in done]

    def _event(self, reference: Any) -> Event:
        errors = self._ray.exceptions
        kind, member = self._pending.pop(reference)
        try:
            value = self._ray.get(reference)
        except errors.RayTaskError as error:
            raise error.cause if isinstance(error.cause, Exception) else error from None
        except errors.RayError as error:
            self.members.remove(member)
            with contextlib.suppress(Exception):
                self._ray.kill(member.actor)
            self._losses += 1
            if self._losses > LIVES * (len(self.members) + 1):
                raise DeviceError(
                    f"Ray lost {self._losses} workers one after the other: {_first_line(error)}"
                ) from error
            self._note(f"lost the worker {_place(member)}; another takes its place")
            self._hire()
            return Event("lost", member)
        if kind == "joined":
            member.about = value
            self._note(f"worker {_place(member)}")
        else:
            self._losses = 0
        return Event(kind, member, value)

    def stop(self) -> None:
        """Sets `Worker.stopped` of every member that has joined."""
        for member in self.members:
            if member.about is not None:
                member.actor.stop.remote()


def run_on_ray(
    work: Callable[[Job, Worker], Value],
    jobs: Iterable[Job],
    *,
    engine: Ray,
    device: str | None,
    stopped: threading.Event,
    note: Note | None,
) -> Iterator[tuple[Job, Value]]:
    """`run_jobs` over a crew. A job whose worker was lost is run again."""
    queue, again = iter(jobs), list[tuple[Job, int]]()
    running: dict[Member, tuple[Job, int]] = {}
    told = False
    with Crew(engine, device, note=note) as crew:
        while True:
            for member in crew.idle if not stopped.is_set() else ():
                try:
                    job, lives = again.pop() if again else (next(queue), LIVES)
                except StopIteration:
                    break
                running[member] = job, lives
                crew.send(member, work, job)
            if stopped.is_set() and not told:
                crew.stop()
                told = True
            if not running and (stopped.is_set() or crew.idle):
                return
            for event in crew.wait(0.2):
                if event.member not in running:  # it has joined, or was lost before
                    continue
                job, lives = running.pop(event.member)
                if event.kind == "returned":
                    yield job, event.value
                elif lives > 1:
                    again.append((job, lives - 1))
                else:
                    raise DeviceError(f"a job took {LIVES} workers with it and is given up")


def _start(ray: Any, engine: Ray, value_bytes: int) -> None:
    """Connects to a cluster, or starts Ray on this machine, without a word of its own."""
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # nothing is sent anywhere
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")  # else a warning in every worker
    os.environ.setdefault("RAY_IGNORE_UNHANDLED_ERRORS", "1")  # those that matter are raised by `Crew.wait`
    address = engine.address or os.environ.get("RAY_ADDRESS")
    options: dict[str, Any] = {"address": address}
    if address is None:
        # Room for a value of each worker, and for what is being written; a third of the memory is Ray's own default.
        room = max(256 * _MIB, int(1.25 * value_bytes * ((engine.workers or 8) + 2)))
        room = min(room, (physical_memory() or 3 * room) // 3)
        options = {
            "address": "local",
            "num_cpus": max(core_count(), engine.workers or 1),
            "include_dashboard": False,
            "object_store_memory": room,
        }
    main = threading.current_thread() is threading.main_thread()
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        ray.init(**options, logging_level=logging.ERROR, log_to_driver=False)
    except (ConnectionError, RuntimeError, ValueError, OSError) as error:
        place = f"at {address}" if address else "on this machine"
        raise DeviceError(f"Ray cannot be reached {place}: {_first_line(error)}") from error
    finally:
        # Ray's own would end the program at SIGTERM.
        for number, handler in handlers.items() if main else ():
            signal.signal(number, handler)


def _place(member: Member) -> str:
    about = member.about
    if about is None:
        return "that was about to join"
    return f"{about['host']} {about['device']} ({about['device_name']}), process {about['pid']}"


def _first_line(error: BaseException) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0]
