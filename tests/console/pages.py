"""A console as its user starts it, and clients that speak HTTP and websockets with it by hand."""

import hashlib
import hmac
import http.client
import json
import os
import re
import subprocess
import sys
import time
from contextlib import contextmanager

from tests.job.benches import PROTOTYPE_FILE

PAGE = "page-1"
LIVE = {"job": "live", "port": "simulated", "seconds": 600.0, "amplitude": 1.4, "excitation": "multisine",
        "rig": "rig.toml", "pace": "real-time"}  # fmt: skip
"""What a run that moves the simulated bench is told."""


class Started:
    def __init__(self, process, link):
        self.process, self.link = process, link
        self.host, self.token = re.fullmatch(r"http://([^/]+)/\?token=(\S+)", link).groups()
        self.cookie = self.key = ""

    def open(self):
        answer = self.ask("GET", f"/?token={self.token}", cookie="")
        self.cookie = answer.headers["set-cookie"].partition(";")[0]
        self.key = answer.headers["location"].partition("#key=")[2]
        return self

    def proof(self, path):
        """What the page makes of its key for an address that a browser opens by itself."""
        return f"{path}?proof={hmac.new(self.key.encode(), path.encode(), hashlib.sha256).hexdigest()}"

    def ask(self, method, path, body=None, *, cookie=None, headers=(), host=None):
        line = http.client.HTTPConnection(self.host, timeout=20)
        line.putrequest(method, path, skip_host=True, skip_accept_encoding=True)
        line.putheader("Host", host or self.host)
        if cookie is None or cookie:
            line.putheader("Cookie", cookie or self.cookie)
        data = b"" if body is None else body if isinstance(body, bytes) else json.dumps(body).encode()
        own = {"X-Ambid": PAGE, "Content-Type": "application/json"} if method == "POST" else {}
        own |= {"X-Ambid-Key": self.key} if self.key else {}
        for name, value in {**own, **dict(headers)}.items():
            if value is not None:
                line.putheader(name, value)
        if data:
            line.putheader("Content-Length", str(len(data)))
        line.endheaders(data or None)
        answer = line.getresponse()
        answer.body = answer.read()
        line.close()
        return answer

    def json(self, method, path, body=None, **more):
        return json.loads(self.ask(method, path, body, **more).body)

    def state(self):
        return self.json("GET", "/api/state")

    def number(self, name):
        return next(f["number"] for f in self.state()["files"] if f["name"] == name)

    def say(self, run, word, *, page=PAGE, **more):
        """Order something, of the state that the run is in now."""
        body = {"word": word, "beat": run.status.get("beat"), **more}
        return self.json("POST", f"/api/runs/{run.id}/say", body, headers={"X-Ambid": page})

    def feed(self, name, *, page=PAGE, **more):
        from websockets.sync.client import connect

        headers, origin = {"Cookie": self.cookie, **more.pop("headers", {})}, more.pop("origin", f"http://{self.host}")
        where = f"ws://{self.host}{self.proof(f'/api/runs/{name}/feed')}&page={page}"
        return connect(where, additional_headers=headers, compression=None, origin=origin, **more)


@contextmanager
def console(folder, *words):
    process = subprocess.Popen(
        [sys.executable, "-m", "ambid", "console", str(folder), "--no-browser", *words],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=os.environ,
    )  # fmt: skip
    try:
        yield Started(process, re.search(r"http\S+", process.stdout.readline())[0])
    finally:
        process.kill()
        process.wait()
        process.stdout.close()
        process.stderr.close()


def frames_of(feed):
    """The JSON frames that a viewer gets until the end of a run."""
    from ambid.console.feed import json_frames

    return [m for data in feed for m in (json.loads(data) if isinstance(data, str) else json_frames(data))]


def told(frames, kind):
    return [m for m in frames if m["kind"] == kind]


def pid_of(run):
    return json.loads((run.place / "process.json").read_text(encoding="utf-8"))["pid"]


def over(run, seconds=20.0):
    """Whether the process of a run ends within some seconds."""
    end = time.monotonic() + seconds
    while run.alive and time.monotonic() < end:
        time.sleep(0.01)
    return not run.alive


def until(run, kind="end", seconds=120.0, of=None):
    """The JSON frames of a run up to one of a kind that says what `of` does, from its feed."""
    from ambid.console.feed import FeedReader, json_frames

    reader, found, end = FeedReader(run.place, parts=99), [], time.monotonic() + seconds
    wanted = (of or {}).items()
    while time.monotonic() < end and not any(wanted <= m.items() for m in told(found, kind)):
        found += json_frames(reader.read())
        time.sleep(0.02)
    return found


def prototype_rig(folder):
    (folder / "rig.toml").write_text(PROTOTYPE_FILE.read_text(encoding="utf-8"), encoding="utf-8")
