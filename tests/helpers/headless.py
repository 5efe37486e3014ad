"""A headless Chromium for tests, driven over its debugging pipe: nothing but the browser is needed."""

import json
import os
import shutil
import subprocess
import time

BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome", "chrome"))), None)


class Browser:
    """One page. Commands are those of the DevTools protocol, NUL-terminated JSON on two pipes."""

    def __init__(self, profile, *, size=(1400, 1100)):
        read_end, self._out = os.pipe()
        self._in, write_end = os.pipe()
        options = "--headless=new --no-sandbox --disable-gpu --enable-unsafe-swiftshader --hide-scrollbars"
        window = f"--window-size={size[0]},{size[1]} --remote-debugging-pipe --user-data-dir={profile}"
        self._process = subprocess.Popen(
            ["bash", "-c", f"exec {BROWSER} {options} {window} about:blank 3<&{read_end} 4>&{write_end} 2>/dev/null"],
            pass_fds=(read_end, write_end),
        )
        os.close(read_end)
        os.close(write_end)
        self._buffer, self._number, self._session = b"", 0, None
        target = self.command("Target.createTarget", url="about:blank")["targetId"]
        self._session = self.command("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]

    def command(self, method, **parameters):
        self._number += 1
        message = {"id": self._number, "method": method, "params": parameters}
        if self._session is not None:
            message["sessionId"] = self._session
        os.write(self._out, json.dumps(message).encode() + b"\0")
        while True:
            while b"\0" not in self._buffer:
                some = os.read(self._in, 1 << 20)
                if not some:
                    raise RuntimeError("the browser has gone")
                self._buffer += some
            one, _, self._buffer = self._buffer.partition(b"\0")
            answer = json.loads(one)
            if answer.get("id") == self._number:
                if "error" in answer:
                    raise RuntimeError(answer["error"]["message"])
                return answer["result"]

    def run(self, script):
        """The value of a JavaScript expression, promises awaited."""
        answer = self.command("Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True)
        if "exceptionDetails" in answer:
            raise RuntimeError(answer["exceptionDetails"]["exception"].get("description", "exception"))
        return answer["result"].get("value")

    def wait(self, script, seconds=60.0):
        """Until an expression is true."""
        end = time.monotonic() + seconds
        while not self.run(script):
            if time.monotonic() > end:
                raise TimeoutError(f"never true: {script}")
            time.sleep(0.05)

    def click(self, x, y):
        """Where the mouse goes first: a plot takes a click only where something hovers."""
        self.command("Input.dispatchMouseEvent", type="mouseMoved", x=x, y=y)
        time.sleep(0.3)
        for kind in ("mousePressed", "mouseReleased"):
            self.command("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1)

    def close(self):
        os.close(self._out)
        os.close(self._in)
        self._process.terminate()
        self._process.wait()
