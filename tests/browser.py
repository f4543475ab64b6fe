"""A headless Chromium, steered by messages through pipes (its remote debugging protocol): no package is needed."""

from __future__ import annotations

import itertools
import json
import os
import select
import shutil
import subprocess
from pathlib import Path
from typing import Any

PATIENCE = 300  #: for an answer [s]
CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), "")


class Browser:
    """One page of a browser, whose profile is in a folder of its own. ``errors`` are those of the console."""

    def __init__(self, profile: Path) -> None:
        ours, its, self._numbers, self._rest = os.pipe(), os.pipe(), itertools.count(1), b""
        line = [CHROMIUM, "--headless=new", "--no-sandbox", "--disable-gpu", "--remote-debugging-pipe"]
        start = f'exec "$@" 3<&{ours[0]} 4>&{its[1]}'  # it reads 3 and writes 4; sh has no numbers above 9
        command = ["bash", "-c", start, "bash", *line, f"--user-data-dir={profile}", "about:blank"]
        ends = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        self._process = subprocess.Popen(command, pass_fds=(ours[0], its[1]), **ends)
        os.close(ours[0])
        os.close(its[1])
        self._to, self._from, self._session, self.errors = ours[1], its[0], {}, []
        target = self("Target.createTarget", url="about:blank")["targetId"]
        self._session = {"sessionId": self("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]}
        for domain in ("Page", "Runtime", "Log"):
            self(f"{domain}.enable")

    def __call__(self, method: str, **parameters: Any) -> dict[str, Any]:
        """The answer to a message; events that come before it are looked through for errors."""
        number = next(self._numbers)
        message = {"id": number, "method": method, "params": parameters, **self._session}
        os.write(self._to, json.dumps(message).encode() + b"\0")
        while True:
            answer = self._next()
            if answer.get("id") == number:
                if "error" in answer:
                    raise RuntimeError(f"{method}: {answer['error']}")
                return answer["result"]

    def _next(self) -> dict[str, Any]:
        while b"\0" not in self._rest:
            ready, *_ = select.select([self._from], [], [], PATIENCE)
            more = os.read(self._from, 1 << 20) if ready else b""
            if not more:
                raise RuntimeError("the browser has ended" if ready else f"the browser is silent for {PATIENCE} s")
            self._rest += more
        line, _, self._rest = self._rest.partition(b"\0")
        event = json.loads(line)
        what = event.get("params", {})
        if event.get("method") == "Runtime.exceptionThrown":
            self.errors.append(what["exceptionDetails"]["text"])
        if event.get("method") == "Log.entryAdded" and what["entry"]["level"] == "error":
            self.errors.append(f"{what['entry']['text']} {what['entry'].get('url', '')}")
        return event

    def open(self, url: str, width: int, height: int = 900) -> None:
        """Load a page in a window of this width [pixels], and wait until its formulas are drawn."""
        size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": width < 600}
        self("Emulation.setDeviceMetricsOverride", **size)
        self("Page.navigate", url=url)
        self.value("""new Promise(done => { const look = () => document.readyState === 'complete' ? done(true)
            : setTimeout(look, 20); look(); })""")
        self.value("window.MathJax && MathJax.startup ? MathJax.startup.promise.then(() => true) : true")

    def value(self, script: str) -> Any:
        """What a script, or the promise that it gives, comes to."""
        answer = self("Runtime.evaluate", expression=script, awaitPromise=True, returnByValue=True)
        if "exceptionDetails" in answer:
            raise RuntimeError(f"{script}: {answer['exceptionDetails']}")
        return answer["result"].get("value")

    def close(self) -> None:
        self("Browser.close")
        self._process.wait()
        os.close(self._to)
        os.close(self._from)
