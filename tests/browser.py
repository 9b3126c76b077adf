"""A browser without a window, driven by Chromium's DevTools protocol."""

import base64
import json
import os
import shutil
import signal
import subprocess
import time
from contextlib import contextmanager
from pathlib import Path

from websockets.sync.client import connect

NAMES = "chromium-headless-shell", "chromium", "chromium-browser", "google-chrome"
OPTIONS = (
    "--headless", "--no-sandbox", "--disable-dev-shm-usage", "--remote-debugging-port=0",
    "--enable-unsafe-swiftshader", "--no-first-run", "--disable-background-networking",
    "--single-process",  # starts on a busy machine as well
)  # fmt: skip
PATIENCE = 60.0


def find():
    """Return where the browser is, or None."""
    return next(filter(None, map(shutil.which, NAMES)), None)


class Tab:
    """A page in the browser, with all that it asked for and complained about."""

    def __init__(self, connection, session, target):
        self._connection, self._session, self.target = connection, session, target
        self._number = 0
        self.events = []

    def call(self, method, **parameters):
        """Give a command and return what it returns."""
        self._number += 1
        message = {"id": self._number, "method": method, "params": parameters}
        self._connection.send(json.dumps(message | {"sessionId": self._session}))
        while True:
            said = json.loads(self._connection.recv(PATIENCE))
            if "method" in said:
                self.events.append(said)
            elif said.get("id") == self._number:
                assert "error" not in said, said
                return said["result"]

    def run(self, expression):
        """Return the value of an expression of JavaScript, or of what it promises."""
        said = self.call(
            "Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True
        )
        assert "exceptionDetails" not in said, said
        return said["result"].get("value")

    def wait(self, expression, patience=PATIENCE):
        """Return the value of an expression once it is true."""
        end = time.monotonic() + patience
        while not (value := self.run(expression)):
            assert time.monotonic() < end, f"{expression} stays {value}"
            time.sleep(0.02)
        return value

    def open(self, url):
        self.events.clear()
        self.call("Page.navigate", url=url)

    def size(self, width, height, scheme="dark", **more):
        """Set the size of the page and whether its surroundings are dark or light."""
        screen = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
        self.call("Emulation.setDeviceMetricsOverride", **screen | more)
        feature = {"name": "prefers-color-scheme", "value": scheme}
        self.call("Emulation.setEmulatedMedia", features=[feature])

    def mouse(self, kind, x, y, **more):
        """Dispatch an event of the mouse: moved, pressed, released or wheel."""
        kind = f"mouse{kind.capitalize()}"
        self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, pointerType="mouse", **more)

    def picture(self):
        """Return the page as a PNG."""
        return base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])

    @property
    def complaints(self):
        """Errors of the browser, what the page wrote as one or as a warning, and exceptions."""
        self.run("0")  # reads what is there
        return [
            event["params"]
            for event in self.events
            if event["method"] == "Runtime.exceptionThrown"
            or (event["method"] == "Runtime.consoleAPICalled"
                and event["params"]["type"] in ("error", "warning"))
            or (event["method"] == "Log.entryAdded"
                and event["params"]["entry"]["level"] == "error")
        ]  # fmt: skip

    @property
    def requests(self):
        """Addresses that the page asked for."""
        self.run("0")
        return [
            event["params"].get("url") or event["params"]["request"]["url"]
            for event in self.events
            if event["method"] in ("Network.requestWillBeSent", "Network.webSocketCreated")
        ]


@contextmanager
def browsing(folder: Path):
    """Start a browser, which keeps its files in a folder; give a function that opens tabs."""
    process = subprocess.Popen(
        [find(), *OPTIONS, f"--user-data-dir={folder}", "about:blank"],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,  # what is started may be a script that starts the browser
    )
    try:
        told, end = folder / "DevToolsActivePort", time.monotonic() + PATIENCE
        while not (told.exists() and len(lines := told.read_text().splitlines()) == 2):
            assert process.poll() is None
            assert time.monotonic() < end, "the browser does not start"
            time.sleep(0.02)
        address = f"ws://127.0.0.1:{lines[0]}{lines[1]}"
        with connect(address, max_size=None, compression=None) as connection:
            browser = Tab(connection, None, None)

            def call(method, **parameters):
                browser._number += 1
                message = {"id": browser._number, "method": method, "params": parameters}
                connection.send(json.dumps(message))
                while (said := json.loads(connection.recv(PATIENCE))).get("id") != message["id"]:
                    pass
                return said["result"]

            def new_tab():
                target = call("Target.createTarget", url="about:blank")["targetId"]
                attached = call("Target.attachToTarget", targetId=target, flatten=True)
                tab = Tab(connection, attached["sessionId"], target)
                for domain in ("Page", "Runtime", "Network", "Log"):
                    tab.call(f"{domain}.enable")
                tab.size(1280, 720)
                return tab

            yield new_tab
    finally:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
