"""The `spadwarp` command, also as `python -m spadwarp`."""

import atexit
import gc
import os
import sys
from contextlib import suppress
from typing import NoReturn

from spadwarp.values import address_space, in_words, need_memory


def main() -> None:
    """Loads the commands and runs one. What goes wrong while they are loaded ends with a sentence too."""
    try:
        _run()
    except SystemExit as stop:
        code = stop.code
    # Python takes most of a second to take itself and its libraries apart; the system frees all of it at once.
    if isinstance(code, str):
        print(code, file=sys.stderr)
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError, ValueError, AttributeError):  # closed, or there is none
            stream.flush()
    atexit._run_exitfuncs()
    os._exit(code if isinstance(code, int) else bool(code))


def _run() -> NoReturn:
    if address_space() is not None:
        # OpenBLAS reserves memory for a thread a core, and waits for ever for what the limit keeps from it.
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    else:
        gc.set_threshold(20_000)  # loading modules makes many objects that stay: a tenth of a second less
    try:
        need_memory(0.5, "spadwarp")
        from spadwarp.cli import app

        sys.exit(app(prog_name="spadwarp"))
    except KeyboardInterrupt:
        print("error: interrupted", file=sys.stderr)
        sys.exit(130)
    except (MemoryError, ImportError, OSError) as error:
        sys.exit(f"error: {in_words(error)}")


if __name__ == "__main__":
    main()
