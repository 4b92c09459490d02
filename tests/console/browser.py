"""Chromium, driven by its own protocol: real clicks, touches and keys, and no package beside the console's own."""

import base64
import itertools
import json
import os
import re
import shutil
import subprocess
import tempfile
import time
from contextlib import contextmanager

import pytest

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
SIZES = [(390, 844), (768, 1024), (1366, 768), (1920, 1080)]
NEEDED = [
    pytest.mark.skipif(CHROMIUM is None, reason="Chromium is not installed: apt-get install chromium"),
    pytest.mark.skipif(os.environ.get("CI") == "true", reason="browsers are for machines of people"),
]
_KEYS = {
    "Enter": 13,
    "Escape": 27,
    "End": 35,
    "Home": 36,
    "ArrowLeft": 37,
    "ArrowRight": 39,
    "Delete": 46,
    "+": 187,
    "Tab": 9,
    ".": 190,
    " ": 32,
}
# where an element is, once it is in view and nothing lies over it
_PLACE = """((of) => {
  const one = typeof of === "string" ? document.querySelector(of) : of;
  if (!one || one.disabled) return null;
  let box = one.getBoundingClientRect();
  const head = document.querySelector("header");
  const below = head && !head.contains(one) ? head.getBoundingClientRect().bottom : 0;
  if (box.top < below || box.bottom > innerHeight) one.scrollIntoView({ block: "center" });
  box = one.getBoundingClientRect();
  const x = box.left + box.width / 2, y = box.top + box.height / 2, top = document.elementFromPoint(x, y);
  return box.width && top && (one === top || one.contains(top)) ? [x, y] : null;
})"""


class Page:
    """One tab."""

    def __init__(self, browser, session):
        self._browser, self._session = browser, session
        self.wrong = []  # errors of the page
        for domain in ("Page", "Runtime", "Log"):
            self.send(f"{domain}.enable")

    def send(self, method, **words):
        return self._browser.send(method, self._session, **words)

    def evaluate(self, script):
        """The value of a script that names what the page lends (`window.ambidConsole`)."""
        script = f"with (window.ambidConsole ?? {{}}) {{ {script} }}"
        answer = self.send("Runtime.evaluate", expression=script, awaitPromise=True, returnByValue=True)
        assert "exceptionDetails" not in answer, answer["exceptionDetails"]["exception"]["description"]
        return answer["result"].get("value")

    def until(self, script, seconds=30.0):
        """Wait until an expression holds; return its value."""
        end = time.monotonic() + seconds
        while (value := self.evaluate(script)) in (None, False, ""):
            assert time.monotonic() < end, f"{script}: {self.evaluate('document.body.innerText')[-1500:]}"
            time.sleep(0.02)
        return value

    def tabs(self):
        """The pages that are open."""
        return [t for t in self._browser.send("Target.getTargets")["targetInfos"] if t["type"] == "page"]

    def wait(self, holds, seconds=10.0):
        """Wait until something that is no expression of the page holds."""
        end = time.monotonic() + seconds
        while not holds():
            assert time.monotonic() < end
            time.sleep(0.02)

    def goto(self, link):
        self.send("Page.navigate", url=link)
        self.until("document.readyState === 'complete' && typeof refresh === 'function' && !!state.folder")

    def reload(self):
        self.evaluate("window.before = true")
        self.send("Page.reload")
        self.until("!window.before && typeof refresh === 'function' && !!state.folder")

    def resize(self, width, height, *, touch=False):
        self.send("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=touch)
        self.send("Emulation.setTouchEmulationEnabled", enabled=touch)
        self.until(f"innerWidth === {width}")

    def dark(self, *, on):
        scheme = {"name": "prefers-color-scheme", "value": "dark" if on else "light"}
        self.send("Emulation.setEmulatedMedia", features=[scheme])

    def place(self, of, seconds=10.0):
        """Where something can be clicked: nothing may lie over it."""
        of = of if of.startswith("(") else json.dumps(of)
        return self.until(f"{_PLACE}({of})", seconds)

    def click(self, of, *, times=1, tap=False):
        x, y = self.place(of)
        if tap:
            self.send("Input.dispatchTouchEvent", type="touchStart", touchPoints=[{"x": x, "y": y}])
            self.send("Input.dispatchTouchEvent", type="touchEnd", touchPoints=[])
            return
        for k in range(1, times + 1):
            for kind in ("mousePressed", "mouseReleased"):
                self.send("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=k)

    def drag(self, of, begin, end):
        """Drag over an element, from and to a distance from its left edge, px."""
        x, y = self.evaluate(
            f"(() => {{ const b = document.querySelector({json.dumps(of)}).getBoundingClientRect(); "
            "return [b.left, b.top + 20]; })()"
        )
        for kind, at in (("mouseMoved", begin), ("mousePressed", begin), ("mouseMoved", (begin + end) / 2),
                         ("mouseMoved", end), ("mouseReleased", end)):  # fmt: skip
            self.send("Input.dispatchMouseEvent", type=kind, x=x + at, y=y, button="left", clickCount=1)

    def hover(self, of, dx, dy):
        x, y = self.evaluate(
            f"(() => {{ const b = document.querySelector({json.dumps(of)}).getBoundingClientRect(); "
            "return [b.left, b.top]; })()"
        )
        self.send("Input.dispatchMouseEvent", type="mouseMoved", x=x + dx, y=y + dy)

    def key(self, name, *, ctrl=False):
        more = {"text": "\r"} if name == "Enter" else {}
        for kind in ("keyDown", "keyUp"):
            self.send(
                "Input.dispatchKeyEvent", type=kind, key=name, code=name, modifiers=2 if ctrl else 0,
                windowsVirtualKeyCode=_KEYS[name], **(more if kind == "keyDown" else {}),
            )  # fmt: skip

    def put(self, of, value):
        """Give a field a value, or a list the choice of that name."""
        self.until(
            f"""((one, value) => {{
              if (!one) return false;
              if (one.tagName === "SELECT") value = [...one.options].find((o) => o.text === value)?.value;
              if (value === undefined) return false;
              one.value = value;
              one.dispatchEvent(new Event("input", {{ bubbles: true }}));
              one.dispatchEvent(new Event("change", {{ bubbles: true }}));
              return true;
            }})(document.querySelector({json.dumps(of)}), {json.dumps(value)})"""
        )

    def text(self, of):
        return self.evaluate(f"document.querySelector({json.dumps(of)})?.innerText ?? ''")

    def count(self, of):
        return self.evaluate(f"document.querySelectorAll({json.dumps(of)}).length")

    def with_text(self, of, text, seconds=30.0):
        """An expression for the first element that shows a text, once there is one."""
        every = f"[...document.querySelectorAll({json.dumps(of)})]"
        one = f"({every}.find((e) => e.textContent.includes({json.dumps(text)})))"
        self.until(f"!!{one}", seconds)
        return one

    def wide(self):
        """By how much the page is wider than its window, px."""
        return self.evaluate("document.documentElement.scrollWidth - document.documentElement.clientWidth")

    def picture(self, path):
        path.write_bytes(base64.b64decode(self.send("Page.captureScreenshot", format="png")["data"]))


class Browser:
    """Chromium without a window."""

    def __init__(self, line):
        self._line, self._numbers, self._pages = line, itertools.count(1), {}

    def open(self, link=None, size=(1366, 768)):
        """A tab of its own, with cookies shared."""
        target = self.send("Target.createTarget", url="about:blank")["targetId"]
        session = self.send("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        page = self._pages[session] = Page(self, session)
        page.target = target
        page.resize(*size)
        if link:
            page.goto(link)
        return page

    def close(self, page):
        self.send("Target.closeTarget", targetId=page.target)

    def send(self, method, session=None, **words):
        number = next(self._numbers)
        more = {} if session is None else {"sessionId": session}
        self._line.send(json.dumps({"id": number, "method": method, "params": words, **more}))
        while True:
            answer = json.loads(self._line.recv(timeout=60.0))
            if answer.get("id") == number:
                assert "error" not in answer, (method, answer["error"])
                return answer["result"]
            self._hear(answer)

    def _hear(self, event):
        page, what = self._pages.get(event.get("sessionId")), event.get("params", {})
        if page is None:
            return
        if event["method"] == "Runtime.exceptionThrown":
            page.wrong.append(what["exceptionDetails"].get("exception", {}).get("description", "?"))
        elif event["method"] == "Log.entryAdded" and what["entry"]["level"] == "error":
            page.wrong.append(f"{what['entry']['text']} {what['entry'].get('url', '')}")


@contextmanager
def chromium():
    """Start Chromium, and end it."""
    from websockets.sync.client import connect

    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        process = subprocess.Popen(
            [CHROMIUM, "--headless=new", "--no-sandbox", "--remote-debugging-port=0", f"--user-data-dir={profile}",
             "--disable-gpu", "--disable-dev-shm-usage", "--no-first-run", "about:blank"],
            stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
        try:
            address = next(
                x[1] for line in process.stderr if (x := re.search(r"DevTools listening on (ws://\S+)", line))
            )
            with connect(address, compression=None, max_size=None) as line:
                yield Browser(line)
        finally:
            process.kill()
            process.wait()
            process.stderr.close()
