"""What a console refuses: each attack is answered by a refusal, changes nothing, and the page goes on."""

import json
import os
import socket
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, suppress
from types import SimpleNamespace

import pytest

pytest.importorskip("uvicorn", reason="the extra [console] is not installed")
pytest.importorskip("starlette", reason="the extra [console] is not installed")

from websockets.exceptions import InvalidStatus, WebSocketException

from ambid.console.folder import Folder, open_plain
from ambid.console.runs import Heard, Run, Runs
from ambid.errors import AmbidError
from tests.console.pages import PAGE, Started, console, frames_of, told, until


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    made = tmp_path_factory.mktemp("bench")
    (made / "outside").mkdir()
    (made / "shown" / "named.toml").mkdir(parents=True)
    (made / "shown" / "sub").mkdir()
    (made / "shown" / "sub" / "plain.csv").write_text("time [s],x [V]\n0,1\n0.1,2\n", encoding="utf-8")
    secret = made / "outside" / "secret.toml"
    secret.write_text('schema = "ambid.rig/1"\nname = "secret"\n', encoding="utf-8")
    shown = made / "shown"
    (shown / "linked.toml").symlink_to(secret)
    (shown / "linked").symlink_to(made / "outside")
    (shown / "rig.toml").write_text('schema = "ambid.rig/1"\nname = "mine"\n', encoding="utf-8")
    os.mkfifo(shown / "pipe.csv")
    os.mkfifo(shown / "pipe.json")
    (shown / "device.csv").symlink_to("/dev/zero")
    (shown / "deep.json").write_text("[" * 100_000, encoding="utf-8")
    (shown / os.fsdecode(b"no\xfftext.csv")).write_text("a\n1\n", encoding="utf-8")
    planted = "<img src=x onerror=alert(1)>.html"
    (shown / planted).write_text("<script>document.title='planted'</script>", encoding="utf-8")
    return shown


@pytest.fixture(scope="module")
def page(folder):
    with console(folder) as started:
        yield started.open()


def test_the_link_opens_the_page_once(folder):
    with console(folder) as started:
        first = started.ask("GET", f"/?token={started.token}", cookie="")
        cookie = first.headers["set-cookie"]
        assert first.status == 303
        assert "HttpOnly" in cookie
        assert "SameSite=strict" in cookie
        assert started.ask("GET", "/", cookie=cookie.partition(";")[0]).status == 200
        for again in (started.token, started.token[:-1], "", "x" * 5000):
            assert started.ask("GET", f"/?token={again}", cookie="").status in (400, 403, 414, 431)


GETS = ["/", "/api/state", "/api/rigs/1", "/reports/1", "/static/main.js"]


@pytest.mark.parametrize("path", GETS)
def test_without_the_cookie_nothing_is_shown(page, path):
    assert page.ask("GET", path, cookie="none=1").status == 403


@pytest.mark.parametrize(
    "cookie",
    ["ambid_console=", "ambid_console_{p}=x", "ambid_console_{p}=\xe4", "ambid_console_{p}=a; ambid_console_{p}=b"],
)
def test_a_wrong_cookie_opens_nothing(page, cookie):
    name = cookie.format(p=page.host.rpartition(":")[2])
    assert page.ask("GET", "/api/state", cookie=name).status == 403
    assert page.ask("GET", "/api/state", cookie=page.cookie[:-1]).status == 403
    assert page.ask("GET", "/api/state", cookie=page.cookie.replace("=", "1=")).status == 403  # of another port


HOSTS = ["evil.example", "127.0.0.1", "127.0.0.1:1", "localhost.evil.example", "[::1]", "0.0.0.0:80"]


@pytest.mark.parametrize("host", HOSTS)
def test_a_foreign_host_is_refused(page, host):
    assert page.ask("GET", "/api/state", host=host).status == 421


ORIGINS = ["http://evil.example", "null", "https://{host}", "http://{host}.evil.example", "http://localhost"]


@pytest.mark.parametrize("origin", ORIGINS)
def test_a_foreign_origin_is_refused(page, origin):
    sent = {"Origin": origin.format(host=page.host)}
    assert page.ask("POST", "/api/drive", {}, headers=sent).status == 403
    assert page.ask("GET", "/api/state", headers=sent).status == 403


@pytest.mark.parametrize("second", ["null", "http://evil.example", "http://{host}", ""])
def test_two_origins_are_refused(page, second):
    ours = f"Host: {page.host}\r\nCookie: {page.cookie}\r\nX-Ambid: {PAGE}\r\nX-Ambid-Key: {page.key}\r\n"
    upgrade = (
        " HTTP/1.1\r\nUpgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
        f"Sec-WebSocket-Key: {'A' * 22}==\r\nX-Rest: "
    )
    for head in ("GET /api/state", "POST /api/stop", f"GET {page.proof('/api/runs/1-1/feed')}{upgrade}"):
        with socket.create_connection(page.host.rsplit(":", 1), timeout=5) as line:
            line.sendall(
                f"{head} HTTP/1.1\r\n{ours}Content-Type: application/json\r\nOrigin: http://{page.host}\r\n"
                f"Origin: {second.format(host=page.host)}\r\n\r\n".encode()
            )
            assert line.recv(4096).startswith((b"HTTP/1.1 403", b"HTTP/1.1 400"))


def test_a_cookie_that_another_port_received_opens_nothing_without_the_key(page):
    """As a server on another port of the address replays it, with our Host and our Origin."""
    ours = {"Origin": f"http://{page.host}", "X-Ambid-Key": None}
    report = next(f["number"] for f in page.state()["files"] if f["kind"] == "report")
    for path in ("/api/state", "/api/rigs/1", f"/reports/{report}", f"/reports/{report}?proof=", "/api/runs/1-1/feed"):
        assert page.ask("GET", path, headers=ours).status == 403
    for path in ("/api/stop", "/api/drive", "/api/runs", "/api/previews", "/api/runs/1-1/say"):
        assert page.ask("POST", path, {}, headers=ours).status == 403
        assert page.ask("POST", path, {}, headers={**ours, "X-Ambid-Key": page.cookie.partition("=")[2]}).status == 403
    bare = page.ask("GET", "/", headers=ours)  # which holds nothing of the folder, and no key
    assert bare.status == 200
    assert page.key.encode() not in bare.body
    with pytest.raises((InvalidStatus, WebSocketException)):
        Started.feed(SimpleNamespace(cookie=page.cookie, host=page.host, proof=lambda path: f"{path}?proof=x"), "1-1")
    other = page.proof("/reports/999999").partition("?")[2]  # of another address
    assert page.ask("GET", f"/reports/{report}?{other}", headers=ours).status == 403
    assert page.ask("GET", page.proof(f"/reports/{report}"), headers=ours).status == 200


BENCH = 'schema = "ambid.rig/1"\nname = "planted"\nmodel = "one-axis"\n[daq]\nrate_hz = 2000.0\nbench = "{}"\n'


@pytest.mark.parametrize("bench", ["../outside/secret.toml", "linked.toml", "{made}/outside/secret.toml"])
def test_a_bench_of_a_rig_lies_in_the_folder(folder, monkeypatch, bench):
    from ambid.acquisition.devices.benches import bench_of
    from ambid.rig import rig_from_text

    rig = rig_from_text(BENCH.format(bench.format(made=folder.parent)), folder / "planted.toml")
    monkeypatch.setattr("ambid.record.record.INSIDE", [folder])
    with pytest.raises(AmbidError, match="is outside of"):
        bench_of(rig, None)


def test_a_change_needs_the_header_and_json(page):
    for headers in ({"X-Ambid": None}, {"Content-Type": "text/plain"}, {"Content-Type": "multipart/form-data"}):
        assert page.ask("POST", "/api/drive", {}, headers=headers).status == 403
    assert page.ask("GET", "/api/drive").status == 405
    assert page.ask("PUT", "/api/drive", {}).status == 405
    assert page.ask("DELETE", "/api/runs/1").status == 405


PATHS = [
    "/static/../../pyproject.toml", "/static/%2e%2e%2f%2e%2e%2fpyproject.toml", "/static/..", "/reports/../rig.toml",
    "/reports/-1", "/reports/0", "/reports/999999", "/reports/1e9", "/api/rigs/../../etc/passwd", "/api/rigs/99",
    "//etc/passwd", "/.ambid/runs", "/rig.toml", "/api/runs/..%2f..%2f/say",
]  # fmt: skip


@pytest.mark.parametrize("path", PATHS)
def test_no_path_leads_out_of_the_folder(page, path):
    answer = page.ask("GET", page.proof(path) if path.startswith("/reports/") else path)
    assert answer.status in (400, 404, 405)
    assert b"secret" not in answer.body
    assert b"root:" not in answer.body


def test_links_are_not_followed(page):
    names = [f["name"] for f in page.state()["files"]]
    assert "rig.toml" in names
    assert not [n for n in names if "linked" in n or "pipe" in n or "device" in n or "named" in n]
    assert any("text.csv" in n for n in names)  # whose name is no text


def test_a_file_exchanged_for_a_link_is_not_opened(folder, monkeypatch):
    files = Folder(folder)
    number = next(e.number for e in files.entries() if e.name == "rig.toml")
    secret, rig = folder.parent / "outside" / "secret.toml", folder / "rig.toml"
    assert b"mine" in files.read(number, "rig", 1000)
    with pytest.raises(AmbidError, match="is longer"):
        files.read(number, "rig", 10)
    for opened in (lambda path: open_plain(secret), lambda path: open_plain(folder / "linked.toml")):
        monkeypatch.setattr("ambid.console.folder.open_plain", opened)
        with pytest.raises((AmbidError, OSError)):
            files.read(number, "rig", 1000)
    with pytest.raises(OSError, match="no plain file"):
        open_plain(folder / "pipe.csv")
    assert rig.read_text(encoding="utf-8").endswith('"mine"\n')


def test_a_folder_of_ten_thousand_files_is_listed_soon(tmp_path):
    for k in range(10_000):
        (tmp_path / f"{k}.csv").touch()
    files, begin = Folder(tmp_path), time.process_time()
    assert len(files.entries()) == 2000
    assert files.left_out == 8000
    assert time.process_time() - begin < 2.0


BODIES = [
    b"", b"[]", b"null", b"{", b'{"job": 5}', b'{"job": "exec"}', b"[" * 20_000,
    json.dumps({"job": "identify", "record": "../../etc/passwd", "rig": 1, "out": "x"}).encode(),
    json.dumps({"job": "identify", "record": True, "rig": 1, "out": "x"}).encode(),
    json.dumps({"job": "preview", "record": 1, "folder": "/etc"}).encode(),
    json.dumps({"job": "history", "ledger": "../outside/works.db"}).encode(),
    json.dumps({"job": "history", "ledger": 1, "bearing": ["A"]}).encode(),
    json.dumps({"job": "rig", "text": 'schema = "ambid.rig/1"', "out": "../planted"}).encode(),
    json.dumps({"job": "rig", "text": 'schema = "ambid.rig/1"', "out": "/tmp/planted"}).encode(),
    json.dumps({"job": "rig", "text": 'schema = "ambid.rig/1"', "out": ".hidden"}).encode(),
    json.dumps({"job": "rig", "text": 'schema = "ambid.rig/1"', "out": "rig"}).encode(),
    json.dumps({"job": "rig", "text": "x" * 60_000, "out": "long"}).encode(),
    json.dumps({"job": "live", "rig": 1, "port": ["simulated"], "out": "x"}).encode(),
    *(
        json.dumps({"job": "live", "port": port, "out": "x"}).encode()
        for port in ("replay:/etc/passwd", "replay:../outside/secret.toml", "replay:linked/secret.toml", "/dev/mem",
                     "/dev/tty/../mem", "socket://evil.example:1", "/dev/watchdog", "hwgrep://x", " simulated")
    ),
    json.dumps({"job": "live", "port": "simulated", "excitation": "/etc/passwd", "out": "x"}).encode(),
    json.dumps({"job": "live", "port": "simulated", "pace": "../fast", "out": "x"}).encode(),
    json.dumps({"job": "live", "rig": 1, "port": "simulated", "seconds": True, "out": "x"}).encode(),
    b'{"job": "export", "record": 1, "from_s": NaN, "to_s": 1e999, "out": "x"}',
]  # fmt: skip


@pytest.mark.parametrize("body", BODIES, ids=range(len(BODIES)))
def test_a_wrong_wish_starts_nothing(page, folder, body):
    before = sorted(p.name for p in folder.rglob("*"))
    answer = page.ask("POST", "/api/runs", body)
    assert answer.status == 400
    assert "error" in json.loads(answer.body)
    assert b"root:" not in answer.body
    assert sorted(p.name for p in folder.rglob("*")) == before


def test_a_huge_request_is_cut_off(page):
    assert page.ask("POST", "/api/runs", b"x" * (1 << 20)).status == 413
    with socket.create_connection(page.host.rsplit(":", 1)) as line:  # no length, and no end
        line.sendall(
            f"POST /api/runs HTTP/1.1\r\nHost: {page.host}\r\nCookie: {page.cookie}\r\nX-Ambid: {PAGE}\r\n"
            f"X-Ambid-Key: {page.key}\r\nContent-Type: application/json\r\nTransfer-Encoding: chunked\r\n\r\n".encode()
        )
        try:
            for _ in range(40):
                line.sendall(b"4000\r\n" + b"x" * 0x4000 + b"\r\n")
            line.settimeout(5.0)
            answer = line.recv(4096)
        except OSError:
            answer = b""
    assert b"200 OK" not in answer
    assert page.ask("GET", "/", headers={"X-Long": "x" * 40_000}).status in (400, 431)
    assert page.state()


@pytest.mark.parametrize("origin", [None, "http://evil.example", "null"])
def test_a_websocket_needs_our_origin(page, origin):
    with pytest.raises((InvalidStatus, WebSocketException)), page.feed("1-1", origin=origin):
        pass


def test_a_websocket_needs_the_cookie_and_a_run(page):
    with pytest.raises((InvalidStatus, WebSocketException)), page.feed("1-1", headers={"Cookie": "none=1"}):
        pass
    with pytest.raises((InvalidStatus, WebSocketException)), page.feed("..%2f..%2f"):
        pass


def test_pages_and_reports_cannot_run_what_is_planted(page):
    assert "script-src 'self'" in page.ask("GET", "/").headers["content-security-policy"]
    report = next(f for f in page.state()["files"] if f["kind"] == "report")
    answer = page.ask("GET", page.proof(f"/reports/{report['number']}"))
    assert answer.headers["content-security-policy"].startswith("sandbox allow-scripts")
    assert "allow-same-origin" not in answer.headers["content-security-policy"]
    assert answer.headers["x-content-type-options"] == "nosniff"


def test_read_only_changes_nothing(folder):
    before = sorted(folder.rglob("*"))
    with console(folder, "--read-only") as started:
        started.open()
        assert started.ask("POST", "/api/drive", {}).status == 403
        assert started.ask("POST", "/api/runs", {"job": "rig", "text": "", "out": "new"}).status == 403
        assert started.ask("POST", "/api/previews", {"job": "rig", "text": "", "out": "new"}).status == 400
        begun = started.json("POST", "/api/previews", {"job": "preview", "record": started.number("sub/plain.csv")})
        with started.feed(begun["id"]) as feed:
            assert told(frames_of(feed), "end")
        assert sorted(folder.rglob("*")) == before
        assert started.ask("POST", "/api/runs/0000000000-000000/say", {"word": "stop"}).status == 403
        assert started.state()["read_only"] is True


HEADS = [
    "GET / HTTP/1.0\r\n\r\n", "GET / HTTP/1.1\r\n\r\n", "GET http://evil.example/ HTTP/1.1\r\nHost: {host}\r\n\r\n",
    "GET /api/state HTTP/1.1\r\nHost: {host}\r\nHost: evil.example\r\nCookie: {cookie}\r\n\r\n",
    "GET /api/state HTTP/1.1\r\nHost: user@{host}\r\nCookie: {cookie}\r\n\r\n",
    "GET /api/state HTTP/1.1\r\nHost: {host}.\r\nCookie: {cookie}\r\n\r\n",
    "GET /api/state HTTP/1.1\r\nHost : {host}\r\nCookie: {cookie}\r\n\r\n",
    "GET /api/state HTTP/1.1\r\nHost: evil.example\r\nX-Forwarded-Host: {host}\r\nCookie: {cookie}\r\n\r\n",
    "GET /api/state HTTP/1.1\r\nHost: {host}\r\nCookie: x=1\r\nCookie: {cookie}\r\n\r\n",
    "GET /api/state HTTP/1.1\r\nHost: {host}\r\nOrigin: http://{host}\r\nOrigin: null\r\nX:1\r\n\r\n",
    "CONNECT evil.example:80 HTTP/1.1\r\nHost: {host}\r\nCookie: {cookie}\r\n\r\n",
    "TRACE / HTTP/1.1\r\nHost: {host}\r\nCookie: {cookie}\r\n\r\n",
    "OPTIONS /api/runs HTTP/1.1\r\nHost: {host}\r\nOrigin: http://evil.example\r\n\r\n",
    "GET /api/state\r\n HTTP/1.1\r\nHost: {host}\r\n\r\n", "\x00\x16\x03\x01" * 9 + "\r\n\r\n",
    "POST /api/drive HTTP/1.1\r\n{ours}Content-Length: 5\r\nContent-Length: 6\r\n\r\nGET / ",
    "POST /api/drive HTTP/1.1\r\n{ours}Content-Length: -1\r\n\r\n",
    "POST /api/drive HTTP/1.1\r\n{ours}Content-Length: 99999999999999999999999999\r\n\r\n",
    "POST /api/drive HTTP/1.1\r\n{ours}Transfer-Encoding: chunked, identity\r\n\r\n0\r\n\r\n",
    "POST /api/drive HTTP/1.1\r\n{ours}Transfer-Encoding: chunked\r\n\r\nfffffffffffffffffffff\r\n",
]  # fmt: skip


@pytest.mark.parametrize("head", HEADS, ids=range(len(HEADS)))
def test_a_head_that_is_none_of_ours_is_refused(page, head):
    key = f"X-Ambid-Key: {page.key}\r\n"
    ours = f"Host: {page.host}\r\nCookie: {page.cookie}\r\n{key}X-Ambid: {PAGE}\r\nContent-Type: application/json\r\n"
    head = head.replace("Cookie: {cookie}\r\n", "Cookie: {cookie}\r\n" + key)
    with socket.create_connection(page.host.rsplit(":", 1), timeout=5) as line:
        line.sendall(head.format(host=page.host, cookie=page.cookie, ours=ours).encode("latin-1"))
        answer = line.recv(4096)
    assert answer.partition(b"\r\n")[0].split(b" ")[1][:1] == b"4", answer
    assert page.state()


def test_of_many_that_race_for_the_link_one_gets_in(folder):
    with console(folder) as started, ThreadPoolExecutor(20) as clients:
        path = f"/?token={started.token}"
        found = [a.status for a in clients.map(lambda _: started.ask("GET", path, cookie=""), range(20))]
    assert sorted(found) == [303, *[403] * 19]


def test_what_is_planted_among_the_runs_harms_nothing(tmp_path):
    runs, outside = tmp_path / "shown" / ".ambid" / "runs", tmp_path / "outside"
    outside.mkdir()
    runs.mkdir(parents=True)
    planted = [
        "[]",
        "null",
        "{",
        '{"pid": "x"}',
        '{"pid": 1e400, "began": NaN}',
        '{"job": NaN, "rig": [[]]}',
        "[" * 99_999,
    ]
    for k, text in enumerate(planted):
        place = runs / f"{k:010d}-{k:06x}"
        place.mkdir()
        for name in ("spec.json", "process.json", "control.jsonl", "feed-000000.bin", "feed-x.bin"):
            (place / name).write_text(text + "\n", encoding="utf-8")
    (runs / "0000000099-00000a").symlink_to(outside)
    place = runs / "0000000000-000000"
    for name in ("feed-000001.bin", "pipe"):
        os.mkfifo(place / name)
    (place / "control.jsonl").write_text('[]\n{\n"x"\n{"word": "stop"}\n', encoding="utf-8")
    assert list(Heard(Run(place))) == [{"word": "stop"}]
    (place / "control.jsonl").unlink()
    (place / "control.jsonl").symlink_to(outside / "made")
    with console(tmp_path / "shown") as page:
        page.open()
        found = page.state()["runs"]
        assert len(found) == len(planted)
        assert not any(r["alive"] for r in found)
        for run in found:
            with page.feed(run["id"]) as feed:
                assert list(feed) == []  # and closed
        page.ask("POST", "/api/runs/0000000000-000000/say", {"word": "stop"})
        page.ask("POST", "/api/runs/0000000099-00000a/say", {"word": "stop"})
        assert not list(outside.iterdir())
        runs.rename(tmp_path / "moved")
        runs.symlink_to(outside)
        wish = {"job": "rig", "text": "x", "out": "new"}
        assert "is a link" in page.json("POST", "/api/runs", wish)["error"]
        assert page.state()["runs"] == []
    assert not list(outside.iterdir())


def test_a_program_in_the_folder_is_not_run(tmp_path):
    for name in ("numpy.py", "json.py", "ambid.py", "sitecustomize.py"):
        (tmp_path / name).write_text(f"open({str(tmp_path / 'ran')!r}, 'w')\n", encoding="utf-8")
    run = Runs(tmp_path).start({"job": "rig", "text": "no rig", "out": "new.toml"})
    assert told(until(run), "end")[0]["how"] == "refused"
    assert not (tmp_path / "ran").exists()


def test_many_viewers_are_refused_and_one_that_takes_nothing_stays_alone(folder, page):
    run = Runs(folder).start({"job": "rig", "text": "no rig", "out": "new.toml"})
    until(run)
    with ExitStack() as all_of_them:
        seen = 0
        for _ in range(40):
            with suppress(WebSocketException, OSError):
                all_of_them.enter_context(page.feed(run.id, max_queue=1))
                seen += 1
        assert page.state()
    assert seen


def test_many_clients_are_refused_and_the_page_goes_on(page):
    lines = []
    try:
        for _ in range(200):
            line = socket.create_connection(page.host.rsplit(":", 1), timeout=5)
            line.sendall(f"GET /api/state HTTP/1.1\r\nHost: {page.host}\r\n".encode())  # never ends
            lines.append(line)
        assert page.state()["folder"] == "shown"  # while all of them wait
    finally:
        for line in lines:
            line.close()
    assert page.state()["folder"] == "shown"
