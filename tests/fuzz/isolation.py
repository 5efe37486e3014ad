"""Runs a function in a child process with limits of time and memory, and says how it ended."""

import contextlib
import faulthandler
import os
import pickle
import resource
import select
import signal
import tempfile
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

SECONDS = 60  # of the processor; kernels may have to be compiled
PATIENCE = 240.0  # seconds, beside others
BYTES = int(os.environ.get("FUZZ_GIB", "2")) << 30  # torch with CUDA maps much


@dataclass(frozen=True)
class Outcome:
    """How a call ended: "done" with what it returned, or "traceback", "crash", "hang" with a name; seconds it took."""

    kind: str
    value: Any
    text: str  # of the exception, or what the child wrote to stderr as it crashed
    seconds: float


def run_isolated(call: Callable[[], Any], *, patience: float = PATIENCE, memory: int = BYTES) -> Outcome:
    """What `call()` returns, from a forked child that may take `memory` bytes more than its parent has now."""
    began = time.monotonic()
    source, sink = os.pipe()
    with tempfile.TemporaryFile() as log:
        child = os.fork()
        if child == 0:
            os.close(source)
            _live(call, sink, log.fileno(), memory)
        os.close(sink)
        answer = _read(source, began + patience)
        taken = time.monotonic() - began
        if answer is None:
            os.kill(child, signal.SIGKILL)
        _, status = os.waitpid(child, 0)
        log.seek(0)
        stderr = log.read().split(b"\nExtension modules")[0]
        # Of a crash the innermost frames come first; of all else the last words tell most.
        fault = stderr.find(b"Fatal Python error")
        text = (stderr[fault:][:4000] if fault >= 0 else stderr[-4000:]).decode(errors="replace")
    if answer is None:
        return Outcome("hang", None, text, taken)
    if os.WIFSIGNALED(status) and os.WTERMSIG(status) == signal.SIGXCPU:
        return Outcome("hang", "of the processor", text, taken)
    if os.WIFSIGNALED(status):
        return Outcome("crash", signal.Signals(os.WTERMSIG(status)).name, text, taken)
    if not answer:
        return Outcome("crash", f"exit {os.WEXITSTATUS(status)}", text, taken)
    return Outcome(*pickle.loads(answer), taken)


def _read(source: int, deadline: float) -> bytes | None:
    """All that comes until the pipe closes; None if it does not in time."""
    found = b""
    with open(source, "rb", buffering=0) as pipe:
        while select.select([pipe], [], [], max(deadline - time.monotonic(), 0.0))[0]:
            if not (part := pipe.read(1 << 16)):
                return found
            found += part
    return None


def _live(call: Callable[[], Any], sink: int, log: int, memory: int) -> None:
    """The child: never returns."""
    os.setsid()
    os.dup2(log, 2)
    faulthandler.enable()
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + memory, used + memory))
    resource.setrlimit(resource.RLIMIT_CPU, (SECONDS, SECONDS + 9))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    try:
        answer = ("done", call(), "")
    except BaseException as error:
        answer = ("traceback", type(error).__name__, traceback.format_exc()[-4000:])
    with contextlib.suppress(BaseException):
        os.write(sink, pickle.dumps(answer))
    os._exit(0)
