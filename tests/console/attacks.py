"""Requests by which somebody else than the person at the page might try to read or move something; each is refused."""

import json
import os
import socket
from contextlib import suppress
from urllib.parse import quote

from tests.console.pages import PAGE

SECRET = b"nobody is to read this"
_LIVE = {"job": "live", "rig": 1, "port": "simulated", "out": "x"}
_RIG = {"job": "rig", "text": 'schema = "ambid.rig/1"', "out": "new"}
# what can be asked for: method, path, body; {run} is a run of the folder, {rig} and {report} are numbers of files
_ASKED = [
    ("GET", "/api/state", None), ("GET", "/api/rigs/{rig}", None), ("GET", "/reports/{report}", None),
    ("GET", "/api/runs/{run}/feed", None), ("POST", "/api/runs", _RIG), ("POST", "/api/previews", _RIG),
    ("POST", "/api/stop", {}), ("POST", "/api/drive", {"run": "{run}"}),
    ("POST", "/api/runs/{run}/say", {"word": "stop"}), ("POST", "/api/previews/{run}/say", {"word": "stop"}),
]  # fmt: skip
# who asks: headers that replace ours (None: there is none; a list: each of them is sent)
_FORGED = {
    "no cookie": {"Cookie": None}, "a cookie that was guessed": {"Cookie": "{name}=" + "A" * 43},
    "a cookie cut short": {"Cookie": "{short}"}, "the cookie under another port's name": {"Cookie": "{name}1={value}"},
    "two cookies": {"Cookie": ["x=1", "{name}={value}"]}, "no key": {"X-Ambid-Key": None, "proof": None},
    "a key that was guessed": {"X-Ambid-Key": "A" * 43, "proof": "0" * 64},
    "an empty key": {"X-Ambid-Key": "", "proof": ""},
    "the cookie as key": {"X-Ambid-Key": "{value}", "proof": "{value}"},
    "a name that is bound to this address": {"Host": "evil.example"}, "a host without port": {"Host": "127.0.0.1"},
    "another port": {"Host": "127.0.0.1:1"}, "a host with a user": {"Host": "user@{host}"},
    "two hosts": {"Host": ["{host}", "evil.example"]},
    "a forwarded host": {"Host": "evil.example", "X-Forwarded-Host": "{host}"},
    "another page": {"Origin": "http://evil.example"}, "a sandboxed page": {"Origin": "null"},
    "a page on another port": {"Origin": "http://127.0.0.1:1"}, "our page by https": {"Origin": "https://{host}"},
    "two origins": {"Origin": ["http://{host}", "http://evil.example"]},
    "our origin twice": {"Origin": ["http://{host}", "http://{host}"]},
}  # fmt: skip
_NAMES = [
    "../outside/secret.toml", "..%2foutside%2fsecret.toml", "%2e%2e/outside/secret.toml", "....//outside/secret.toml",
    "linked.toml", "linked/secret.toml", "/etc/passwd", "%2fetc%2fpasswd", "..%5coutside%5csecret.toml", "rig.toml",
    "rig.toml%00.html", "0", "-1", "1e9", "99999999999999999999", "1;2", "%31%00",
]  # fmt: skip
_FOLDERS = ["/static/", "/reports/", "/api/rigs/", "/"]
_METHODS = ["PUT", "DELETE", "PATCH", "OPTIONS", "TRACE", "CONNECT", "PROPFIND", "get"]
_WISHES = [
    [], None, 5, "live", {"job": 5}, {"job": "exec"}, {"job": "__class__"}, {**_RIG, "job": ["rig"]},
    *({**_RIG, "out": out} for out in (
        "../planted", "/tmp/planted", ".hidden", "a/b", "a\\b", "a\x00b", "x" * 300, "", "rig")),
    {**_RIG, "folder": "/etc"}, {**_RIG, "text": "x" * 60_000}, {**_RIG, "text": ["x"]},
    *({"job": "identify", "record": number, "rig": 1, "out": "x"} for number in (
        "../../etc/passwd", True, 1.5, -1, 10**9, [1], {})),
    *({**_LIVE, "port": port} for port in (
        "replay:/etc/passwd", "replay:../outside/secret.toml", "replay:linked/secret.toml", "/dev/mem",
        "/dev/tty/../mem", "/dev/watchdog", "socket://evil.example:1", "rfc2217://evil.example:1", "hwgrep://x",
        " simulated", ["simulated"], "COM1; x", "/dev/ttyS0\x00x")),
    {**_LIVE, "excitation": "/etc/passwd"}, {**_LIVE, "pace": "../fast"}, {**_LIVE, "seconds": True},
    {**_LIVE, "seconds": "1"}, {**_LIVE, "arm": "../outside/secret.toml"}, {**_LIVE, "estimate": "/etc/passwd"},
    {"job": "history", "ledger": "../outside/works.db"}, {"job": "result", "estimate": "../outside/secret.json"},
    {"job": "export", "record": 1, "from_s": "0", "to_s": 1, "out": "x"},
    {"job": "design", "estimate": 1, "rig": 1, "method": "x"},
]  # fmt: skip
_ORDERS = [
    {"word": "go"}, {"word": "accept", "beat": 1}, {"word": "exec"}, {"word": ["stop"]}, {"word": "hold", "beat": None},
    {"word": "track", "beat": "1"}, {"word": "stop\nstop"}, {},
]  # fmt: skip
_SMUGGLED = [
    "{post}Content-Length: 5\r\nContent-Length: 6\r\n\r\nGET / ", "{post}Content-Length: -1\r\n\r\n",
    "{post}Content-Length: 99999999999999999999999999\r\n\r\n", "{post}Content-Length: 0x5\r\n\r\nhello",
    "{post}Transfer-Encoding: chunked, identity\r\n\r\n0\r\n\r\n", "{post}Transfer-Encoding: xchunked\r\n\r\n0\r\n\r\n",
    "{post}Transfer-Encoding: chunked\r\n\r\nfffffffffffffffffffff\r\n",
    "{post}Transfer-Encoding: chunked\r\n\r\n-1\r\n",
    "{get}Host : {host}\r\n\r\n", "{get}X: a\x00b\r\n\r\n",
    "{get}X-Long: " + "x" * 40_000 + "\r\n\r\n",
    "{get}" + "".join(f"X-{k}: y\r\n" for k in range(2000)) + "\r\n",
    "GET /api/state\r\n HTTP/1.1\r\nHost: {host}\r\n\r\n", "GET http://evil.example/api/state HTTP/1.1\r\n{ours}\r\n",
    "GET /api/state HTTP/9.9\r\n{ours}\r\n", "\x00\x16\x03\x01" * 9 + "\r\n\r\n", "PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n",
]  # fmt: skip
_HUGE = [1 << 16, 1 << 20, 1 << 24]


def lay_out(made):
    """A folder to be shown, beside which lies a secret, and links and files in it that lead there."""
    import h5py
    import numpy as np

    shown, outside = made / "shown", made / "outside"
    for folder in (shown, outside):
        folder.mkdir()
    for name in ("secret.toml", "secret.json", "secret.csv"):
        (outside / name).write_bytes(b'schema = "ambid.rig/1"\nname = "' + SECRET + b'"\n')
    (shown / "linked.toml").symlink_to(outside / "secret.toml")
    (shown / "linked").symlink_to(outside)
    (shown / "rig.toml").write_text('schema = "ambid.rig/1"\nname = "mine"\n', encoding="utf-8")
    (shown / "rec.csv").write_text(
        "time [s],voltage [V]\n" + "".join(f"{k / 10},{k}\n" for k in range(99)), encoding="utf-8"
    )
    (shown / "page.html").write_text("<p>mine", encoding="utf-8")
    rig = 'schema = "ambid.rig/1"\nname = "planted"\nmodel = "one-axis"\n'
    for name, place in (
        ("up", "../outside/secret.csv"),
        ("link", "linked/secret.csv"),
        ("whole", f"{outside}/secret.csv"),
    ):
        table = f'[channels.voltage]\ncolumn = "voltage"\ntable = "{place}"\n'
        (shown / f"table-{name}.toml").write_text(rig + table, encoding="utf-8")
        bench = f'[daq]\nrate_hz = 2000.0\nbench = "{place.replace("csv", "toml")}"\n'
        (shown / f"bench-{name}.toml").write_text(rig + bench, encoding="utf-8")
    with h5py.File(outside / "secret.h5", "w") as file:
        file["x"] = np.arange(99.0)
    with h5py.File(shown / "borrowed.h5", "w") as file:
        file.attrs.update(schema="ambid.record/1", rate_hz=10.0, start_s=0.0)
        file["history"], file["provenance"] = "[]", "{}"
        file.create_group("channels")["0"] = h5py.ExternalLink("../outside/secret.h5", "/x")
    return shown


def _lines(headers):
    pairs = [(n, v) for n, value in headers.items() for v in (value if isinstance(value, list) else [value])]
    return "".join(f"{name}: {value}\r\n" for name, value in pairs if value is not None)


def attacks(page, run, *, ourselves=False):
    """Name and bytes of each request; `run`: the id of a run of the folder; `ourselves`: instead what is asked for by
    the page itself, which is given.
    """
    name, _, value = page.cookie.partition("=")
    words = {"host": page.host, "name": name, "value": value, "short": page.cookie[:-1], "run": run}
    words |= {kind: next(f["number"] for f in page.state()["files"] if f["kind"] == kind) for kind in ("rig", "report")}
    ours = {"Host": page.host, "Cookie": page.cookie, "X-Ambid": PAGE, "X-Ambid-Key": page.key,
            "Content-Type": "application/json", "Connection": "close"}  # fmt: skip

    def filled(x):
        if isinstance(x, list):
            return [filled(y) for y in x]
        return x.format(**words) if isinstance(x, str) else x

    def request(method, path, body=None, headers=None, proof="ours"):
        path, by = filled(path), {k: filled(v) for k, v in (headers or {}).items()}
        proven = page.proof(path) if proof == "ours" else path if proof is None else f"{path}?proof={filled(proof)}"
        feed, alone = path.endswith("/feed"), path.startswith("/reports/")
        upgrade = {"Upgrade": "websocket", "Connection": "Upgrade", "Sec-WebSocket-Version": "13",
                   "Sec-WebSocket-Key": "A" * 22 + "==", "Origin": f"http://{page.host}"}  # fmt: skip
        head = ours | (upgrade if feed else {}) | by
        data = b"" if body is None else body if isinstance(body, bytes) else json.dumps(body).encode()
        length = {"Content-Length": len(data)} if method == "POST" else {}
        target = proven if feed or alone else path
        return f"{method} {target} HTTP/1.1\r\n{_lines({**head, **length})}\r\n".encode("latin-1") + data

    if ourselves:
        yield from ((f"{method} {path}", request(method, path)) for method, path, _ in _ASKED[:4])
        return
    for who, forged in _FORGED.items():
        headers = {k: v for k, v in forged.items() if k != "proof"}
        for method, path, body in _ASKED:
            yield f"{method} {path} with {who}", request(method, path, body, headers, forged.get("proof", "ours"))
    for other in ("/reports/0", "/api/runs/{run}/feed", "/", "/reports/{report}0"):
        stolen = page.proof(filled(other)).partition("=")[2]
        yield f"a report by the proof of {other}", request("GET", "/reports/{report}", proof=stolen)
        yield (
            f"a feed by the proof of {other}0",
            request("GET", "/api/runs/{run}/feed", proof=page.proof(filled(other) + "0").partition("=")[2]),
        )
    for folder in _FOLDERS:
        for target in _NAMES:
            yield f"GET {folder}{target}", request("GET", folder + target)
    for target in ("..%2f..%2f", run + "/..", "0000000000-000000", quote(run + "\x00")):
        yield f"an order to the run {target}", request("POST", f"/api/runs/{target}/say", {"word": "stop"})
        yield f"the feed of the run {target}", request("GET", f"/api/runs/{target}/feed")
    for method in _METHODS:
        for path in ("/", "/api/stop", "/api/runs", "/reports/{report}"):
            yield f"{method} {path}", request(method, path)
    for path in ("/api/stop", "/api/runs", "/api/drive"):
        for kind in ("text/plain", "multipart/form-data", "application/x-www-form-urlencoded", None):
            yield f"a form as {kind} to {path}", request("POST", path, {}, {"Content-Type": kind})
        yield f"no X-Ambid to {path}", request("POST", path, {}, {"X-Ambid": None})
    for wish in _WISHES:
        yield f"the wish {json.dumps(wish)[:70]}", request("POST", "/api/runs", json.dumps(wish).encode())
    for body in (
        b"",
        b"{",
        b"[" * 20_000,
        b'{"job": "rig", "out": NaN}',
        b"\xff\xfe{}",
        b'{"job":"rig"}' + b" " * 60_000,
    ):
        yield f"the body {body[:30]!r}", request("POST", "/api/runs", body)
    for order in _ORDERS:
        yield f"the order {json.dumps(order)}", request("POST", "/api/runs/{run}/say", order)
    for size in _HUGE:
        yield f"{size} bytes", request("POST", "/api/runs", b"x" * (size + 1))
    for text in _SMUGGLED:
        post = f"POST /api/drive HTTP/1.1\r\n{_lines(ours)}"
        get = f"GET /api/state HTTP/1.1\r\n{_lines(ours)}"
        raw = (
            text.replace("{post}", post)
            .replace("{get}", get)
            .replace("{ours}", _lines(ours))
            .replace("{host}", page.host)
        )
        yield f"the head {text[:60]!r}", raw.encode("latin-1")
    for token in ("", page.token, page.token[:-1], "x" * 5000, "%00"):
        yield f"the token {token[:20]}", request("GET", f"/?token={token}", headers={"Cookie": None})


def planted(page):
    """Runs that may begin, and are to be refused by what they read: their wishes."""
    files = {f["name"]: f["number"] for f in page.state()["files"]}
    for k, name in enumerate(n for n in files if n.startswith(("table", "bench"))):
        wish = {"job": "live", "port": "simulated", "rig": files[name], "seconds": 1.0, "out": f"live-{k}"}
        yield (
            name,
            wish
            if name.startswith("bench")
            else {"job": "identify", "record": files["rec.csv"], "rig": files[name], "out": f"out-{k}"},
        )
    yield "borrowed.h5", {"job": "preview", "record": files["borrowed.h5"]}


def answer(page, raw):
    """What a console answers to bytes, until it has said its first line, or closes."""
    data = b""
    with suppress(OSError), socket.create_connection(page.host.rsplit(":", 1), timeout=15) as line:
        with suppress(OSError):  # it may have answered before it took all
            line.sendall(raw)
        while part := line.recv(65536):
            data += part
            line.settimeout(0.3)  # one that is kept open says no more
    return data


def through(data):
    """Whether an answer gives something: what was asked for, a session, or the secret."""
    status = data.split(b" ", 2)[1:2]
    given = bool(status) and status[0][:1] in (b"1", b"2") and not data.startswith(b"HTTP/1.1 100")
    return given or SECRET in data or b"root:" in data or b"set-cookie" in data.lower()


def everything(folder):
    """Names and sizes of all that lies in a folder and beside it, but what runs keep."""
    found = (p for p in sorted(folder.parent.rglob("*")) if ".ambid" not in p.parts)
    return [(str(p), os.lstat(p).st_size) for p in found]
