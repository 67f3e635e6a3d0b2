"""A page in headless Chromium that a test clicks, types and looks at.

The test speaks Chromium's DevTools protocol through two pipes, so no port is open and
no further library is needed.
"""

import base64
import contextlib
import fcntl
import json
import os
import select
import shutil
import subprocess
import tempfile
import time
from pathlib import Path

_NAMES = ("chromium", "chromium-browser", "google-chrome")
_FLAGS = (
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--hide-scrollbars",
    "--host-resolver-rules=MAP * ~NOTFOUND",  # nor does the browser ask anybody
)
_PATIENCE = 60.0  # [s]
_SETTLED = (  # the page's script has ended, well or with a message
    "document.readyState === 'complete' && (!document.querySelector('#failure') ||"
    " document.documentElement.dataset.ready || !failure.hidden)"
)


def find_chromium():
    """Path of a Chromium, or None; the variable SLAMGYM_CHROMIUM goes before."""
    named = os.environ.get("SLAMGYM_CHROMIUM")
    return named or next(filter(None, map(shutil.which, _NAMES)), None)


class BrowserError(Exception):
    """The browser refused, or a script of the test failed."""


class Page:
    """One tab.

    Attributes
    ----------
    messages : list of str
        What its console said, and the errors that no script caught.
    requests : list of str
        The addresses it asked for.
    """

    def __init__(self, sending, receiving):
        self._sending, self._receiving = sending, receiving
        self._buffer, self._number, self._session = b"", 0, None
        self.messages, self.requests = [], []
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        attached = self.call("Target.attachToTarget", targetId=target, flatten=True)
        self._session = attached["sessionId"]
        for domain in ("Page", "Runtime", "Network", "Log"):
            self.call(f"{domain}.enable")

    def open(self, path, *, size=(1280, 900), dark=False, touch=False):
        """Open a file in a window of so many pixels."""
        self.look(size, dark=dark, touch=touch)
        self.call("Page.navigate", url="about:blank")
        self.messages.clear()
        self.requests.clear()
        address = Path(path).as_uri()
        self.call("Page.navigate", url=address)
        self.wait_for(f"location.href === {address!r} && {_SETTLED}")
        self.requests.remove(address)

    def look(self, size, *, dark=False, touch=False):
        """Set what the reader's screen is like."""
        width, height = size
        self.call(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=1,
            mobile=touch,
        )
        self.call("Emulation.setTouchEmulationEnabled", enabled=touch)
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        self.call("Emulation.setEmulatedMedia", features=[scheme])

    def evaluate(self, script):
        """Value of an expression of JavaScript."""
        found = self.call("Runtime.evaluate", expression=script, returnByValue=True)
        if "exceptionDetails" in found:
            raise BrowserError(json.dumps(found["exceptionDetails"]))
        return found["result"].get("value")

    def wait_for(self, condition):
        """Wait until an expression is true."""
        end = time.monotonic() + _PATIENCE
        while not self.evaluate(condition):
            if time.monotonic() > end:
                raise BrowserError(f"still not {condition}")
            time.sleep(0.02)

    def text(self, selector):
        """What an element says, as it is shown."""
        return self.evaluate(f"document.querySelector({selector!r}).innerText")

    def box(self, selector):
        """Left, top, width and height of an element in the window, scrolled to."""
        script = (
            "(e => {e.scrollIntoView({block: 'center', behavior: 'instant'});"
            "const {left, top, width, height} = e.getBoundingClientRect();"
            "return [left, top, width, height]})"
            f"(document.querySelector({selector!r}))"
        )
        return self.evaluate(script)

    def point(self, x, y, kind="mouseMoved", **more):
        """Move the mouse, or press or release its button."""
        held = {"button": "left"} if more else {}
        if kind != "mouseMoved":
            held = {"button": "left", "clickCount": 1}
        self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, **held, **more)

    def click(self, x, y):
        """Click a place in the window."""
        for kind in ("mouseMoved", "mousePressed", "mouseReleased"):
            self.point(x, y, kind)

    def click_on(self, selector):
        """Click the middle of an element."""
        left, top, width, height = self.box(selector)
        self.click(left + width / 2, top + height / 2)

    def tap(self, x, y):
        """Touch a place in the window."""
        places = [{"x": x, "y": y}]
        self.call("Input.dispatchTouchEvent", type="touchStart", touchPoints=places)
        self.call("Input.dispatchTouchEvent", type="touchEnd", touchPoints=[])

    def press(self, key, code=0, text=None):
        """Press a key by its name, such as "ArrowRight"."""
        more = {} if text is None else {"text": text}
        for kind in ("keyDown", "keyUp"):
            self.call(
                "Input.dispatchKeyEvent",
                type=kind,
                key=key,
                windowsVirtualKeyCode=code,
                **(more if kind == "keyDown" else {}),
            )

    def screenshot(self, path, *, whole=True):
        """Save what the page looks like, below the window too."""
        taken = self.call("Page.captureScreenshot", captureBeyondViewport=whole)
        Path(path).write_bytes(base64.b64decode(taken["data"]))

    def call(self, method, **params):
        """Call a method of the protocol, and return its result."""
        self._number += 1
        message = {"id": self._number, "method": method, "params": params}
        if self._session:
            message["sessionId"] = self._session
        os.write(self._sending, json.dumps(message).encode() + b"\0")
        while (answer := self._next()).get("id") != self._number:
            self._note(answer)
        if "error" in answer:
            raise BrowserError(f"{method}: {answer['error']}")
        return answer["result"]

    def _note(self, event):
        params = event.get("params", {})
        if event["method"] == "Runtime.consoleAPICalled":
            self.messages.append(json.dumps(params["args"]))
        elif event["method"] == "Runtime.exceptionThrown":
            self.messages.append(json.dumps(params["exceptionDetails"]))
        elif event["method"] == "Log.entryAdded":
            self.messages.append(params["entry"]["text"])
        elif event["method"] == "Network.requestWillBeSent":
            self.requests.append(params["request"]["url"])

    def _next(self):
        while b"\0" not in self._buffer:
            if not select.select([self._receiving], [], [], _PATIENCE)[0]:
                raise BrowserError("the browser does not answer")
            got = os.read(self._receiving, 1 << 20)
            if not got:
                raise BrowserError("the browser has ended")
            self._buffer += got
        message, _, self._buffer = self._buffer.partition(b"\0")
        return json.loads(message)


def _pipe():
    """Return a pipe whose descriptors are above those that Chromium uses."""
    ends = os.pipe()
    moved = tuple(fcntl.fcntl(end, fcntl.F_DUPFD_CLOEXEC, 10) for end in ends)
    for end in ends:
        os.close(end)
    return moved


@contextlib.contextmanager
def open_browser():
    """Start Chromium for the block; its only page is the value."""
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        command = [find_chromium(), *_FLAGS, f"--user-data-dir={profile}"]
        command += ["--remote-debugging-pipe", "about:blank"]
        to_browser, from_browser = _pipe(), _pipe()
        # Chromium reads descriptor 3 and writes descriptor 4.
        script = f'exec "$@" 3<&{to_browser[0]} 4>&{from_browser[1]}'
        browser = subprocess.Popen(
            ["/bin/bash", "-c", script, "bash", *command],
            pass_fds=(to_browser[0], from_browser[1]),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        os.close(to_browser[0])
        os.close(from_browser[1])
        try:
            yield Page(to_browser[1], from_browser[0])
        finally:
            browser.terminate()
            browser.wait(30)
            os.close(to_browser[1])
            os.close(from_browser[0])
