"""The server of a console: pages, the list of files and runs, feeds. It acquires and computes nothing.

Starlette and uvicorn (extra ``[console]``). Everything comes through `ambid.console.guard`.
"""

from __future__ import annotations

import asyncio
import errno
import json
import math
import re
import socket
import time
from collections import Counter
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import asdict
from importlib.resources import files
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import uvicorn
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.requests import ClientDisconnect, Request
from starlette.responses import Response
from starlette.routing import Route, WebSocketRoute
from starlette.websockets import WebSocket, WebSocketDisconnect, WebSocketState
from uvicorn.protocols.http.h11_impl import H11Protocol

from ambid.console.authority import busy
from ambid.console.envelope import WINDOWS
from ambid.console.feed import FeedReader, json_frames
from ambid.console.folder import Folder
from ambid.console.guard import Guard
from ambid.console.orders import ANSWER_S, acknowledge, acknowledged
from ambid.console.runs import MOVING, Run, Runs
from ambid.errors import AmbidError
from ambid.settings.caller import setting

_LOOKS = ("preview", "look", "history", "result", "fleet")  # jobs that change nothing

_POLL_S = 0.02  # between two looks at a feed
_ANSWER_POLL_S = 0.005  # between two looks for an answer
_STATUS_S = 0.1  # between two looks of a viewer at lease and status
_BEGINS_S = 60.0  # in which a run whose process is not there yet may still begin
_SIGN_S = 0.4  # between two signs of life of a page that are kept
_SILENT_S = 1.5  # without a sign of life: the process of a run is frozen
_VIEWERS = 16  # feeds that are watched at once
_BACKLOG = 1 << 20  # bytes a viewer may be behind before it is given the numbers without the signals
_PATIENCE_S = 20.0  # with a viewer that takes nothing
_RUNS = 40  # that are listed, the newest, beside those that go on
_KEYS = 200  # events that are acknowledged at once
_START_S = 5.0  # how long one waits to be carried out
_CONNECTIONS = 48  # before those that ask nothing give way
_HEAD_S = 15.0  # in which a connection has to say what it asks
_REPORT_BYTES = 1 << 26
_SERIAL = re.compile(r"(/dev/(tty|cu|serial/by-(id|path)/)[\w.:+-]+|COM[0-9]{1,3})", re.ASCII)
_STATIC = {"uPlot.iife.min.js": "data", "uPlot.min.css": "data"} | {
    f.name: "console/static" for f in files("ambid").joinpath("console/static").iterdir() if not f.name.endswith("html")
}
_TYPES = {"js": "text/javascript", "css": "text/css"}
_WORDS = {"live": ("track", "hold", "accept", "revert"), "commission": ("go", "no")}  # beside "stop", of any
# of each job: files that it reads, by their kinds; other fields with their types; the ending of what it makes
_FIELDS: Mapping[str, tuple[Mapping[str, str], Mapping[str, Any], str]] = {
    "preview": ({"record": "record"}, {"rate_hz": float, "gaps": str}, ""),
    "look": (
        {"record": "record", "rig": "rig"},
        {"rate_hz": float, "gaps": str, "from_s": float, "to_s": float, "from_hz": float, "to_hz": float,
         "weights": str, "channel": str, "across": str, "up": str}, "",
    ),
    "history": ({"ledger": "ledger"}, {"bearing": str}, ""),
    "result": ({"estimate": "result"}, {}, ""),
    "fleet": ({"ledger": "ledger"}, {}, ""),
    "rig": ({}, {"text": str}, ".toml"),
    "identify": ({"record": "record", "rig": "rig"}, {}, ".json"),
    "margins": ({"record": "record", "rig": "rig", "estimate": "result"}, {}, ".json"),
    "design": ({"rig": "rig", "estimate": "result"}, {}, ".json"),
    "export": ({"record": "record"}, {"from_s": float, "to_s": float}, ".h5"),
    "live": (
        {"rig": "rig", "estimate": "result", "arm": "rig"},
        {"port": str, "seconds": float, "excitation": str, "amplitude": float, "pace": str}, ".h5",
    ),
    "commission": (
        {"rig": "rig"}, {"port": str, "seconds": float, "track_seconds": float, "pace": str, "redesign": bool}, "/",
    ),
}  # fmt: skip
_FILES = ("record", "ledger", "rig", "estimate", "arm")
_CHOICES = {
    "pace": ("real-time", "fastest"),
    "excitation": ("multisine", "schroeder", "prbs", "steps"),
    "gaps": ("error", "interpolate", "cut"),
    "weights": tuple(WINDOWS),
}
_NEEDED = {"preview": ("record",), "look": ("record",), "history": ("ledger",), "result": ("estimate",),
           "fleet": ("ledger",),
           "identify": ("record", "rig"),
           "margins": ("rig",), "design": ("rig", "estimate"), "live": ("rig", "port"),
           "commission": ("rig", "port"), "rig": ("text",), "export": ("record", "from_s", "to_s")}  # fmt: skip


class Console:
    """What the pages of one folder ask for."""

    def __init__(self, folder: Path, *, read_only: bool = False) -> None:
        self.files, self.runs, self._read_only = Folder(folder), Runs(folder), read_only
        self._beside = TemporaryDirectory(prefix="ambid-console-", ignore_cleanup_errors=True)
        self._looks = Runs(folder, Path(self._beside.name))  # previews: nothing of them stays
        self._viewers = 0
        self._watching = Counter[tuple[str, str]]()  # feeds that a page watches, by run and page
        self._over: dict[str, dict[str, Any]] = {}  # runs that are over, as they are shown

    def close(self) -> None:
        """Remove what is kept beside the folder."""
        self._beside.cleanup()

    def routes(self) -> list[Any]:
        """Return what can be asked for."""
        return [
            Route("/", self._page),
            Route("/static/{name}", self._static),
            Route("/api/state", self._state),
            Route("/api/rigs/{number:int}", self._rig_text),
            *(Route(f"/api/{of}", self._start, methods=["POST"]) for of in ("runs", "previews")),
            *(Route(f"/api/{of}/{{name}}/say", self._say, methods=["POST"]) for of in ("runs", "previews")),
            Route("/api/stop", self._stop, methods=["POST"]),
            Route("/api/drive", self._drive, methods=["POST"]),
            Route("/reports/{number:int}", self._report),
            WebSocketRoute("/api/runs/{name}/feed", self._feed),
        ]

    async def _page(self, _: Request) -> Response:
        return Response(_resource("console/static", "console.html"), media_type="text/html")

    async def _static(self, request: Request) -> Response:
        name = request.path_params["name"]
        if name not in _STATIC:
            return Response(status_code=404)
        return Response(_resource(_STATIC[name], name), media_type=_TYPES[name.rpartition(".")[2]])

    async def _state(self, request: Request) -> Response:
        entries = await run_in_threadpool(self.files.entries)
        page = _page_of(request)
        runs = await run_in_threadpool(
            lambda: [self._about(r, page) for k, r in enumerate(self.runs.all()) if k < _RUNS or r.alive]
        )
        return _reply(
            {
                "folder": self.files.path.name, "files": [asdict(e) for e in entries], "runs": runs,
                "left_out": self.files.left_out, "read_only": self._read_only, "looks": _LOOKS, "now": time.time(),
            }
        )  # fmt: skip

    def _about(self, run: Run, page: str) -> dict[str, Any]:
        """Return what is shown of a run; one that is over is looked at once."""
        moves = (self._over[run.id] if run.id in self._over else _about(run))["spec"]["job"] in MOVING
        noted = {"acknowledged": acknowledged(run.place)} if moves else {}
        if run.id in self._over:
            return {**self._over[run.id], **noted}
        if run.alive:
            return {**_about(run), "alive": True, "end": "", **(_holder(run, page) if moves else {}), **noted}
        end = _end(run)
        how, why = (str(end.get(k, ""))[:400] for k in ("how", "why")) if end else ("broke off", "")
        found = {**_about(run), "alive": False, "end": how[:20], "why": why}
        if end or time.time() - found["began"] > _BEGINS_S:
            self._over[run.id] = found
        return {**found, **noted}

    async def _rig_text(self, request: Request) -> Response:
        number = request.path_params["number"]
        return await _answer(lambda: {"text": self.files.read(number, "rig", 1 << 20).decode("utf-8")})

    async def _report(self, request: Request) -> Response:
        number = request.path_params["number"]
        try:
            page = await run_in_threadpool(lambda: self.files.read(number, "report", _REPORT_BYTES))
        except (AmbidError, OSError) as refusal:
            return _reply({"error": str(refusal)}, 404)
        return Response(page, media_type="text/html")

    async def _start(self, request: Request) -> Response:
        asked = await _json(request)
        given = asked.pop("now", None)  # by the page's clock, which follows this one

        def start() -> Mapping[str, Any]:
            spec = self._spec(asked)
            if spec["job"] in MOVING and _finite(given) and time.time() - given > _START_S:
                raise AmbidError("the start waited too long, and nothing was done. Look at the bench, and start again")
            if spec["job"] in _LOOKS:
                return {"id": self._looks.start(spec).id}
            if request.url.path != "/api/runs":
                raise AmbidError(f"{spec['job']} changes the folder. Reload the page")
            page, by = (_page_of(request), _name_of(request)) if spec["job"] in MOVING else ("", "")
            return {"id": self.runs.start(spec, page=page, by=by).id}

        return await _answer(start)

    async def _say(self, request: Request) -> Response:
        """Order something, and answer what became of it."""
        asked, started = await _json(request), time.monotonic()
        if asked.get("word") == "acknowledge":
            return await _answer(lambda: self._acknowledge(request, asked.get("keys")))

        def say() -> tuple[Run, str]:
            runs = self.runs if request.url.path.startswith("/api/runs/") else self._looks
            run, word = runs.one(request.path_params["name"]), str(asked.get("word"))[:20]
            more: dict[str, Any] = {}
            if word != "stop":  # everybody may stop a machine
                self._check_word(run, word, asked)
                run.lease.take(_page_of(request), _name_of(request))
                more = {k: asked[k] for k in ("beat", "number", "goal") if _finite(asked.get(k))}
                more["until"] = started + ANSWER_S
            return run, run.say(word, by=_name_of(request), **more)

        try:
            run, name = await run_in_threadpool(say)
        except (AmbidError, OSError, UnicodeError) as refusal:
            return _reply({"error": _words(refusal)}, 400)
        answer = await _answered(run, name, stop=asked.get("word") == "stop")
        if answer is None and asked.get("word") != "stop":
            return _reply({"error": "not delivered: the run does not answer. It refuses the order if it wakes"}, 504)
        if answer is not None and not answer.get("done"):
            return _reply({"error": str(answer.get("why", ""))}, 409)
        return _reply({"delivered": answer is not None})

    def _acknowledge(self, request: Request, keys: object) -> Mapping[str, Any]:
        """Log that a page has taken note of events: everybody may, and also once the run is over."""
        run = self.runs.one(request.path_params["name"])
        if not isinstance(keys, list) or not all(isinstance(k, str) for k in keys) or not 0 < len(keys) <= _KEYS:
            raise AmbidError(f"acknowledge needs 1 to {_KEYS} events. Reload the page")
        acknowledge(run.place, keys, _name_of(request))
        return {"delivered": True}

    async def _stop(self, request: Request) -> Response:
        """Stop whatever moves, and answer whether it was told: nothing is waited for before the order is out, but a run
        that is about to begin.
        """
        end = time.monotonic() + ANSWER_S
        try:
            while not (moving := self.runs.moving()) and busy(self.files.path):
                if time.monotonic() > end:
                    return _reply(
                        {"error": "a run has the bench and cannot be reached: it begins, or is another user's"}, 503
                    )
                await asyncio.sleep(_POLL_S)
        except (AmbidError, OSError) as failure:
            return _reply({"error": _words(failure)}, 500)
        orders, failures = [], list[str]()
        for run in moving:  # one that cannot be told keeps none from being told
            try:
                orders.append((run, run.say("stop", by=_name_of(request))))
            except (AmbidError, OSError) as failure:
                failures.append(_words(failure))
        answers = await asyncio.gather(*(_answered(run, name, stop=True) for run, name in orders))
        if failures:
            return _reply({"error": "; ".join(failures)}, 500)
        return _reply({"runs": [r.id for r in moving], "delivered": all(a is not None for a in answers)})

    def _check_word(self, run: Run, word: str, asked: Mapping[str, Any]) -> None:
        """Refuse what is said to a run that it does not mean anything to."""
        job, of = str(run.spec.get("job"))[:20], [job for job, words in _WORDS.items() if word in words]
        if not of:
            raise AmbidError(f"the word {word!r} is unknown; known: stop, {', '.join(sum(_WORDS.values(), ()))}")
        if job not in of:
            raise AmbidError(f"{word} is for a run of {of[0]}; this one is of {job}. Choose another run")
        if not run.alive:
            raise AmbidError(f"{word} does nothing: the run is over")
        if _silent(run):
            raise AmbidError(f"{word} does nothing: the run is silent. Stop, or use the emergency stop")
        if job == "live" and not run.follows:
            raise AmbidError(f"{word} does nothing: the run tracks nothing now. Wait until tracking has begun")
        if not _finite(asked.get("beat")):
            raise AmbidError(f"{word} does not say which state of the run it was given in. Reload the page")

    async def _drive(self, request: Request) -> Response:
        """Take over the right to order a run."""
        asked = await _json(request)

        def drive() -> Mapping[str, Any]:
            run = self.runs.one(str(asked.get("run")))
            run.lease.take(_page_of(request), _name_of(request), over=True)
            return _holder(run, _page_of(request))

        return await _answer(drive)

    def _spec(self, asked: Mapping[str, Any]) -> dict[str, Any]:
        """Return what a run is told, from what a page asks for: files by number, nothing that is not known."""
        job = asked.get("job")
        if not isinstance(job, str) or job not in _FIELDS:
            raise AmbidError(f"the job {str(job)[:20]!r} is unknown; known: {', '.join(_FIELDS)}")
        kinds, others, ending = _FIELDS[job]
        spec: dict[str, Any] = {"job": job}
        for name, value in asked.items():
            if name in ("job", "out") or value is None or value == "":
                continue
            if name in kinds:
                spec[name] = str(self.files.path_of(value, kinds[name]).relative_to(self.files.path))
            elif name in others:
                spec[name] = self._port(value) if name == "port" else _typed(name, value, others[name])
            else:
                raise AmbidError(f"{job} takes no {str(name)[:20]!r}. Reload the page")
        missing = [name for name in _NEEDED.get(job, ()) if name not in spec]
        if missing:
            raise AmbidError(f"{job} needs {missing[0]}. Choose one")
        if ending:
            once = ending != ".json"  # a result takes the next name that is free
            name = self.files.new(asked.get("out", ""), "" if ending == "/" else ending, once=once).name
            spec["out"] = name.removesuffix(".json")
        return spec

    def _port(self, value: object) -> str:
        """Return a port: no page names another file than a record of the folder."""
        name = str(value)
        records = {e.name for e in self.files.entries() if e.kind == "record"} if name.startswith("replay:") else set()
        if name.startswith("replay:") and name[7:] in records:
            return f"replay:{self.files.path / name[7:]}"
        if name in ("simulated", "emulated") or _SERIAL.fullmatch(name):
            return name
        raise AmbidError(
            f"the port {name[:60]!r} is none: simulated, emulated, replay:NAME with a record of the folder, or a "
            "serial port such as /dev/ttyACM0. Correct it"
        )

    async def _feed(self, socket: WebSocket) -> None:
        try:
            name = socket.path_params["name"]
            run = (self._looks if self._looks.has(name) else self.runs).one(name)
        except AmbidError:
            await socket.close(1008)
            return
        if self._viewers >= _VIEWERS:
            await socket.close(1013)
            return
        self._viewers += 1
        listening, page = None, _plain(socket.query_params.get("page", ""))
        watched = (run.id, page)
        self._watching[watched] += 1
        try:
            await socket.accept()
            listening = asyncio.create_task(_until_gone(socket, run, page))
            await self._send(socket, run, page, listening)
        except (WebSocketDisconnect, TimeoutError, RuntimeError):
            pass  # it is gone, or takes nothing
        finally:
            self._viewers -= 1
            self._watching[watched] -= 1
            if not self._watching[watched]:  # a page that is gone orders nothing any more
                del self._watching[watched]
                await run_in_threadpool(run.lease.drop, page)
            if listening is not None:
                listening.cancel()
            if socket.application_state == WebSocketState.CONNECTED:
                with suppress(RuntimeError, TimeoutError):
                    await asyncio.wait_for(socket.close(), 1.0)

    async def _send(self, socket: WebSocket, run: Run, page: str, listening: asyncio.Task[None]) -> None:
        """Pass a feed on until its end; a viewer that is slow misses signals, not what was told. Who may order, and the
        end where the disk took none, come from beside the feed.
        """
        reader, looked, alive, holder = FeedReader(run.place), 0.0, True, None
        begun = ended = False
        moves = run.spec.get("job") in MOVING
        while not listening.done():
            data = reader.read()
            if data:
                begun, told = True, json_frames(data)
                ended = ended or any(m.get("kind") == "end" for m in told)
                if reader.behind <= _BACKLOG:
                    await _patiently(socket.send_bytes(data))
                elif told:
                    await _patiently(socket.send_text(json.dumps(told)))
            elif not alive:
                break
            if (now := time.perf_counter()) - looked > _STATUS_S:
                looked, alive, before = now, run.alive, holder
                holder = _holder(run, page) if moves and begun else None
                if holder is not None and holder != before:
                    await _patiently(socket.send_text(json.dumps([{"kind": "lease", **holder}])))
            if not data:
                await asyncio.sleep(_POLL_S)
        end = run.status.get("end")
        if not ended and isinstance(end, dict) and not listening.done():
            await _patiently(socket.send_text(json.dumps([{**end, "kind": "end"}])))


async def _patiently(sending: Any) -> None:
    await asyncio.wait_for(sending, _PATIENCE_S)


async def _until_gone(socket: WebSocket, run: Run, page: str) -> None:
    """Wait until a viewer goes; whatever it says is a sign of its life."""
    last = 0.0
    while (await socket.receive())["type"] != "websocket.disconnect":
        if (now := time.monotonic()) - last > _SIGN_S:
            last = now
            await run_in_threadpool(run.lease.beat, page)


async def _answered(run: Run, name: str, *, stop: bool) -> Mapping[str, Any] | None:
    """Wait for the answer of a run to an order, of a `stop` also by another way; None where none comes."""
    end = time.monotonic() + ANSWER_S + 0.1
    while (answer := run.answer(name)) is None and time.monotonic() < end:
        if stop and run.status.get("stopping") is True and not _silent(run):
            return {"done": True}
        await asyncio.sleep(_ANSWER_POLL_S)
    return answer


def _silent(run: Run) -> bool:
    at = run.status.get("at")
    return not isinstance(at, float) or time.monotonic() - at > _SILENT_S


def _holder(run: Run, page: str) -> dict[str, Any]:
    """Return who may order a run: nobody, this page, or another by its name."""
    has = run.lease.holder
    return {"holder": str(has.get("name", ""))[:80], "you": bool(has) and has.get("page") == page}


def _end(run: Run) -> Mapping[str, Any]:
    """Return how a run ended, from its feed or, where the disk took none, from beside it."""
    ends = [m for m in json_frames(FeedReader(run.place, parts=1).read(1 << 24)) if m.get("kind") == "end"]
    beside = run.status.get("end")
    return ends[-1] if ends else beside if isinstance(beside, dict) else {}


def _about(run: Run) -> dict[str, Any]:
    said = {k: run.spec.get(k) for k in ("job", "out", "seconds", "port", *_FILES)}
    off = run.status.get("off") is True  # whether its device has confirmed that its output is off
    shown = {k: v[:200] if isinstance(v, str) else v for k, v in said.items() if isinstance(v, str) or _finite(v)}
    return {"id": run.id, "spec": {"job": "", **shown}, "began": int(run.id.partition("-")[0]), "off": off}


def _finite(value: object) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)


def _typed(name: str, value: Any, kind: Any) -> Any:
    """Return a value of the type that a field has."""
    if kind is float:
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not abs(value) < 1e9:
            raise AmbidError(f"{name} is {str(value)[:20]!r}; it must be a number. Correct it")
        return float(value)
    if name in _CHOICES and value not in _CHOICES[name]:
        raise AmbidError(f"{name} is {str(value)[:20]!r}; known: {', '.join(_CHOICES[name])}. Choose one")
    if not isinstance(value, kind) or (kind is str and len(value) > 50_000):
        raise AmbidError(f"{name} is {str(value)[:20]!r}; it must be {'a text' if kind is str else 'true or false'}")
    return value


def _plain(name: str) -> str:
    return "".join(c for c in name[:32] if c.isascii() and (c.isalnum() or c == "-"))


def _page_of(request: Request) -> str:
    """Return which page asks: a number that it drew when it was loaded."""
    return _plain(request.headers.get("x-ambid", ""))


def _name_of(request: Request) -> str:
    """Return what a page is called where another reads of it."""
    return f"page {_page_of(request)[:6]} of the console at {request.url.netloc[:60]}"


async def _json(request: Request) -> dict[str, Any]:
    try:
        found = json.loads(await request.body())
    except (ValueError, RecursionError, ClientDisconnect):
        return {}
    return found if isinstance(found, dict) else {}


async def _answer(make: Callable[[], Mapping[str, Any]]) -> Response:
    try:
        return _reply(await run_in_threadpool(make))
    except (AmbidError, OSError, UnicodeError) as refusal:
        return _reply({"error": _words(refusal)}, 400)


def _words(failure: Exception) -> str:
    """Return what went wrong; what the system says of a disk, in words."""
    if not isinstance(failure, OSError):
        return str(failure)
    full = failure.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
    why = "the disk is full. Make room" if full else f"{failure.strerror or failure}. Look at who may write to it"
    return f"nothing was done: the folder of the runs cannot be written: {why}"


def _reply(content: Mapping[str, Any], status: int = 200) -> Response:
    """Answer in JSON of ASCII, as a file's name may be no text."""
    return Response(json.dumps(content, allow_nan=False), status, media_type="application/json")


def _resource(place: str, name: str) -> bytes:
    return files("ambid").joinpath(*place.split("/"), name).read_bytes()


class _Line(H11Protocol):
    """A connection: one that asks nothing is cut off after a while, or at once where others need its place."""

    def connection_made(self, transport: Any) -> None:
        super().connection_made(transport)
        self.since = self.loop.time()
        idle = [c for c in self.connections if isinstance(c, _Line) and c is not self and not c.asks]
        if len(self.connections) > _CONNECTIONS and idle:
            min(idle, key=lambda c: c.since).cut()
        self._look()

    @property
    def asks(self) -> bool:
        """Whether an answer is under way."""
        return self.cycle is not None and not self.cycle.response_complete

    def cut(self) -> None:
        """End it."""
        self.connections.discard(self)
        self.transport.abort()

    def _look(self) -> None:
        now = self.loop.time()
        if self.transport.is_closing() or self.transport.get_protocol() is not self:  # gone, or a websocket
            return
        self.since = now if self.asks else self.since
        if now - self.since > _HEAD_S:
            self.cut()
        else:
            self.loop.call_later(1.0, self._look)


def serve(
    folder: str | Path, *, port: int = 0, read_only: bool = False, on_ready: Callable[[str], object] = print
) -> None:
    """Serve the console of a folder to this machine until Ctrl-C. `port`: 0: any that is free; `on_ready`: given the
    link, which opens the page once.
    """
    place, address = Path(folder).resolve(), "127.0.0.1"
    if not place.is_dir():
        raise AmbidError(f"{folder} is no folder; a console shows one. Name it")
    try:
        listening = socket.create_server((address, port))
    except (OSError, OverflowError) as failure:
        why = getattr(failure, "strerror", None) or failure
        raise AmbidError(f"{setting('port', port)} cannot be had: {why}. Choose another one") from None
    number = listening.getsockname()[1]
    console = Console(place, read_only=read_only)
    guard = Guard(
        Starlette(routes=console.routes()), hosts={f"{n}:{number}" for n in (address, "localhost")}, read_only=read_only
    )
    config = uvicorn.Config(
        guard, http=_Line, ws="websockets-sansio", ws_max_size=4096, ws_max_queue=4, log_level="critical",
        access_log=False, limit_concurrency=64, timeout_keep_alive=15, timeout_graceful_shutdown=1,
        h11_max_incomplete_event_size=16_384, server_header=False, lifespan="off", proxy_headers=False,
    )  # fmt: skip
    try:
        on_ready(f"http://{address}:{number}/?token={guard.token}")
        uvicorn.Server(config).run(sockets=[listening])
    except KeyboardInterrupt:
        pass
    finally:
        listening.close()
        console.close()
