"""What a console refuses: each attack is answered by a refusal, changes nothing, and the page goes on."""

import json
import socket

import pytest

pytest.importorskip("uvicorn", reason="the extra [console] is not installed")
pytest.importorskip("starlette", reason="the extra [console] is not installed")

from websockets.exceptions import InvalidStatus, WebSocketException

from tests.console.pages import PAGE, console


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    made = tmp_path_factory.mktemp("bench")
    (made / "outside").mkdir()
    (made / "shown" / "sub").mkdir(parents=True)
    secret = made / "outside" / "secret.toml"
    secret.write_text('schema = "ambid.rig/1"\nname = "secret"\n', encoding="utf-8")
    shown = made / "shown"
    (shown / "linked.toml").symlink_to(secret)
    (shown / "linked").symlink_to(made / "outside")
    (shown / "rig.toml").write_text('schema = "ambid.rig/1"\nname = "mine"\n', encoding="utf-8")
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


GETS = ["/", "/api/state", "/api/rigs/1", "/reports/1", "/static/console.js"]


@pytest.mark.parametrize("path", GETS)
def test_without_the_cookie_nothing_is_shown(page, path):
    assert page.ask("GET", path, cookie="none=1").status == 403


@pytest.mark.parametrize(
    "cookie", ["ambid_console=", "ambid_console=x", "ambid_console=\xe4", "ambid_console=a; ambid_console=b"]
)
def test_a_wrong_cookie_opens_nothing(page, cookie):
    assert page.ask("GET", "/api/state", cookie=cookie).status == 403


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
    answer = page.ask("GET", path)
    assert answer.status in (400, 404, 405)
    assert b"secret" not in answer.body
    assert b"root:" not in answer.body


def test_links_are_not_followed(page):
    names = [f["name"] for f in page.state()["files"]]
    assert "rig.toml" in names
    assert not [n for n in names if "linked" in n]


BODIES = [
    b"", b"[]", b"null", b"{", b'{"job": 5}', b'{"job": "exec"}', b"[" * 20_000,
    json.dumps({"job": "identify", "record": "../../etc/passwd", "rig": 1, "out": "x"}).encode(),
    json.dumps({"job": "identify", "record": True, "rig": 1, "out": "x"}).encode(),
    json.dumps({"job": "preview", "record": 1, "folder": "/etc"}).encode(),
    json.dumps({"job": "rig", "text": 'schema = "ambid.rig/1"', "out": "../planted"}).encode(),
    json.dumps({"job": "rig", "text": 'schema = "ambid.rig/1"', "out": "/tmp/planted"}).encode(),
    json.dumps({"job": "rig", "text": 'schema = "ambid.rig/1"', "out": ".hidden"}).encode(),
    json.dumps({"job": "rig", "text": 'schema = "ambid.rig/1"', "out": "rig"}).encode(),
    json.dumps({"job": "rig", "text": "x" * 60_000, "out": "long"}).encode(),
    json.dumps({"job": "live", "rig": 1, "port": ["simulated"], "out": "x"}).encode(),
    json.dumps({"job": "live", "rig": 1, "port": "simulated", "seconds": True, "out": "x"}).encode(),
    b'{"job": "export", "record": 1, "from_s": NaN, "to_s": 1e999, "out": "x"}',
]  # fmt: skip


@pytest.mark.parametrize("body", BODIES, ids=range(len(BODIES)))
def test_a_wrong_wish_starts_nothing(page, folder, body):
    before = sorted(p.name for p in folder.rglob("*"))
    answer = page.ask("POST", "/api/runs", body)
    assert answer.status == 400
    assert "error" in json.loads(answer.body)
    assert sorted(p.name for p in folder.rglob("*")) == before


def test_a_huge_request_is_cut_off(page):
    assert page.ask("POST", "/api/runs", b"x" * (1 << 20)).status == 413
    with socket.create_connection(page.host.rsplit(":", 1)) as line:  # no length, and no end
        line.sendall(
            f"POST /api/runs HTTP/1.1\r\nHost: {page.host}\r\nCookie: {page.cookie}\r\nX-Ambid: {PAGE}\r\n"
            "Content-Type: application/json\r\nTransfer-Encoding: chunked\r\n\r\n".encode()
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
    answer = page.ask("GET", f"/reports/{report['number']}")
    assert answer.headers["content-security-policy"].startswith("sandbox allow-scripts")
    assert "allow-same-origin" not in answer.headers["content-security-policy"]
    assert answer.headers["x-content-type-options"] == "nosniff"


def test_read_only_changes_nothing(folder):
    with console(folder, "--read-only") as started:
        started.open()
        assert started.ask("POST", "/api/drive", {}).status == 403
        assert started.ask("POST", "/api/runs", {"job": "rig", "text": "", "out": "new"}).status == 403
        assert started.state()["read_only"] is True


def test_many_clients_are_refused_and_the_page_goes_on(page):
    lines = []
    try:
        for _ in range(200):
            line = socket.create_connection(page.host.rsplit(":", 1), timeout=5)
            line.sendall(f"GET /api/state HTTP/1.1\r\nHost: {page.host}\r\n".encode())  # never ends
            lines.append(line)
    finally:
        for line in lines:
            line.close()
    assert page.state()["folder"] == "shown"
