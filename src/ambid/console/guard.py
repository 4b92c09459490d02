"""Who may do what: the one door through which every request of a console comes.

The page is for the person who started it. A one-time token in the link becomes a cookie that scripts cannot read and
other sites cannot send, and a key that the page keeps: browsers send the cookie to every port of an address, the key to
nobody. All but the bare page needs both. Host and Origin must be the console's own, so that no other page, and no name
that is bound to the loopback address later, reaches it; what changes something needs a header that a plain form cannot
send.
"""

from __future__ import annotations

import asyncio
import hashlib
import hmac
import secrets
from collections.abc import Iterable, MutableMapping
from http.cookies import CookieError, SimpleCookie
from typing import Any
from urllib.parse import parse_qs

from starlette.responses import PlainTextResponse, RedirectResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from ambid.settings.caller import flag

COOKIE = "ambid_console"
HEADER = b"x-ambid"
KEY = b"x-ambid-key"
MOST_BYTES = 1 << 16  # of the body of a request
BODY_S = 10.0  # in which it has to come
MOST_HEADERS = 1 << 14
_MOST_LINES = 100  # of them
_SANDBOXED = "/reports/"
_BARE = "/static/"  # holds nothing of the folder
_CHANGES_NOTHING = "/api/previews"
_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; connect-src 'self'; "
    "font-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
_REPORT_POLICY = (
    "sandbox allow-scripts allow-modals allow-popups; default-src 'none'; script-src 'unsafe-inline'; style-src "
    "'unsafe-inline'; img-src data: blob:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)


class Guard:
    """Lets through what belongs here.

    `hosts`: values of Host that are the console's own; `read_only`: nothing may be changed.
    """

    def __init__(self, app: ASGIApp, *, hosts: Iterable[str], read_only: bool = False) -> None:
        self._app, self._hosts, self._read_only = app, frozenset(hosts), read_only
        self.cookie = f"{COOKIE}_{next(iter(self._hosts)).rpartition(':')[2]}"  # ports of an address share cookies
        self.token: str | None = secrets.token_urlsafe(32)
        self._sessions: dict[str, str] = {}  # cookies, and the key of each

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Let a request through, or answer why not."""
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        headers = _headers(scope)
        refusal = self._refusal(scope, headers)
        if scope["type"] == "websocket":
            if refusal is None:
                await self._app(scope, receive, send)
            else:
                await receive()
                await send({"type": "websocket.close", "code": 1008})
            return

        async def guarded(message: Message) -> None:
            if message["type"] == "http.response.start":
                _protect(message, sandboxed=scope["path"].startswith(_SANDBOXED))
            await send(message)

        if refusal is None:
            await self._app(scope, _limited(receive), guarded)
        else:
            await refusal(scope, receive, guarded)

    def _refusal(self, scope: Scope, headers: MutableMapping[bytes, bytes]) -> Response | None:
        """Return the answer to what is not let through; None where it is."""
        size = sum(len(name) + len(value) for name, value in scope["headers"])
        if size > MOST_HEADERS or len(scope["headers"]) > _MOST_LINES or scope["http_version"] not in ("1.0", "1.1"):
            return _no(431, "the head of the request is too long, or of another protocol")
        host, origin = headers.get(b"host", b"").decode("latin-1"), headers.get(b"origin", b"").decode("latin-1")
        if host not in self._hosts:
            return _no(421, "this console answers to its own address only. Open the link that it printed")
        if origin and origin != f"http://{host}":
            return _no(403, "the request comes from another page")
        if scope["type"] == "websocket":
            return None if origin and self._known(headers, scope) else _no(403, "")
        if scope["method"] == "POST":
            if HEADER not in headers or not headers.get(b"content-type", b"").startswith(b"application/json"):
                return _no(403, "a change needs the header X-Ambid and JSON")
            length = headers.get(b"content-length", b"0")
            if not length.isdigit() or int(length[:20]) > MOST_BYTES:
                return _no(413, "the request is too long")
        elif scope["method"] not in ("GET", "HEAD"):
            return _no(405, "GET and POST only")
        if scope["path"] == "/" and scope["query_string"]:
            return self._opened(parse_qs(scope["query_string"].decode("latin-1")).get("token", [""])[0])
        if not self._known(headers, scope):
            return _no(403, "open the link that 'ambid console' printed; each link opens one page. Start it again")
        if scope["method"] == "POST" and self._read_only and not scope["path"].startswith(_CHANGES_NOTHING):
            return _no(403, f"this console was started with {flag('read_only')}. Start it without")
        return None

    def _opened(self, token: str) -> Response:
        """Exchange the token, which is worth nothing from then on, for a cookie."""
        if self.token is None or not hmac.compare_digest(token.encode(), self.token.encode()):
            return _no(403, "this link was used before, or is wrong. Start 'ambid console' again for another")
        self.token = None
        # the key goes into the fragment of an address, which browsers send to no server
        session, key = secrets.token_urlsafe(32), secrets.token_urlsafe(32)
        self._sessions[session] = key
        answer = RedirectResponse(f"/#key={key}", status_code=303)
        answer.set_cookie(self.cookie, session, httponly=True, samesite="strict", path="/")
        return answer

    def _known(self, headers: MutableMapping[bytes, bytes], scope: Scope) -> bool:
        """Whether a request has the cookie of a session and, for all but the bare page, its key: in a header, or as
        what it makes of an address that a browser opens by itself.
        """
        try:
            found = SimpleCookie(headers.get(b"cookie", b"").decode("latin-1")).get(self.cookie)
        except CookieError:
            return False
        given = "" if found is None else found.value
        key = next((k for s, k in self._sessions.items() if hmac.compare_digest(given.encode(), s.encode())), None)
        if key is None:
            return False
        path = scope["path"]
        if path == "/" or path.startswith(_BARE):
            return True
        if scope["type"] == "websocket" or path.startswith(_SANDBOXED):
            proof = parse_qs(scope["query_string"].decode("latin-1")).get("proof", [""])[0]
            right = hmac.new(key.encode(), path.encode(), hashlib.sha256).hexdigest()
            return hmac.compare_digest(proof.encode(), right.encode())
        return hmac.compare_digest(headers.get(KEY, b""), key.encode())


def _headers(scope: Scope) -> MutableMapping[bytes, bytes]:
    """Return the headers; one that occurs twice, where that changes who is asked, is nobody's."""
    found: dict[bytes, bytes] = {}
    for name, value in scope["headers"]:
        found[name] = b"twice" if name in found and name in (b"host", b"origin", b"cookie", HEADER, KEY) else value
    return found


def _no(status: int, why: str) -> Response:
    return PlainTextResponse(f"ambid: {why}\n", status_code=status)


def _protect(message: Message, *, sandboxed: bool) -> None:
    """Add what a browser has to know about a page of this console."""
    message["headers"] = [
        *message["headers"],
        (b"content-security-policy", (_REPORT_POLICY if sandboxed else _POLICY).encode()),
        (b"x-content-type-options", b"nosniff"),
        (b"referrer-policy", b"no-referrer"),
        (b"cross-origin-opener-policy", b"same-origin"),
        (b"cross-origin-resource-policy", b"same-origin"),
        (b"cache-control", b"no-store"),
    ]


def _limited(receive: Receive) -> Receive:
    """Cut off a body that is longer, or takes longer, than it may."""
    came, whole, end = 0, False, asyncio.get_running_loop().time() + BODY_S

    async def taken() -> Message:
        nonlocal came, whole
        try:
            async with asyncio.timeout_at(None if whole else end):
                message: Any = await receive()
        except TimeoutError:
            return {"type": "http.disconnect"}
        came += len(message.get("body", b""))
        whole = whole or not message.get("more_body", False)
        return {"type": "http.disconnect"} if came > MOST_BYTES else message

    return taken
