"""Who may ask the server, and for what: host, origin, token; and what every answer says.

The page of a foreign site can neither read here nor change anything: a request must name one of
the server's own addresses (a foreign name that leads here, DNS rebinding, does not), whatever
changes something must come from a page of that same address, and all of it needs the token.
"""

from __future__ import annotations

import hmac
import time
from collections.abc import Callable
from http.cookies import CookieError, SimpleCookie
from urllib.parse import parse_qsl, quote, urlencode

from starlette.responses import HTMLResponse, PlainTextResponse, RedirectResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

SAFE = ("GET", "HEAD")
MONTH = 30 * 24 * 3600  # seconds that a browser keeps the token
WRONG_TOKENS = 20.0, 1 / 30  # at once, and a second afterwards, from one address
MOST_ADDRESSES = 1000  # whose wrong tokens are counted
POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data: blob:; "
    "connect-src 'self'; manifest-src 'self'; base-uri 'none'; form-action 'none'; "
    "frame-ancestors 'none'"
)
HEADERS = {
    "x-content-type-options": "nosniff",
    "referrer-policy": "no-referrer",
    "x-frame-options": "DENY",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
    "cache-control": "no-store",
}
LOCKED = """<!doctype html><html lang="en"><meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1"><title>invrender</title>
<h1>This page is locked</h1>
<p>Open the address that <code>invrender app</code> printed, or scan its QR code: it holds the
key.</p>"""


class Bucket:
    """Allows ``most`` things at once and ``rate`` a second afterwards."""

    def __init__(self, most: float, rate: float, clock: Callable[[], float] = time.monotonic):
        self.most, self.rate, self.clock = most, rate, clock
        self.left, self.at = most, clock()

    def take(self) -> float:
        """Take one: 0 where it is allowed, else the seconds to wait."""
        now = self.clock()
        self.left = min(self.most, self.left + (now - self.at) * self.rate)
        self.at = now
        if self.left >= 1:
            self.left -= 1
            return 0.0
        return (1 - self.left) / self.rate


class Guard:
    """An ASGI middleware. hosts: what a request's Host may be, with the port."""

    def __init__(self, app: ASGIApp, hosts: frozenset[str], token: str, cookie: str) -> None:
        self.app, self.hosts, self.token, self.cookie = app, hosts, token, cookie
        self.wrong: dict[str, Bucket] = {}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "lifespan":
            await self.app(scope, receive, send)
            return
        if scope["type"] != "http":  # no web sockets here
            return

        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                given = {name for name, _ in message["headers"]}
                extra = {"content-security-policy": POLICY, **HEADERS}
                message["headers"] = list(message["headers"]) + [
                    (k.encode(), v.encode()) for k, v in extra.items() if k.encode() not in given
                ]
            await send(message)

        refused = self._refusal(scope)
        await (refused or self.app)(scope, receive, send_with_headers)

    def _refusal(self, scope: Scope) -> Response | None:
        """The answer to a request that is not let through; None for one that is."""
        headers: dict[str, list[str]] = {}
        for name, value in scope["headers"]:
            headers.setdefault(name.decode("latin-1"), []).append(value.decode("latin-1"))
        hosts = headers.get("host", [])
        if len(hosts) != 1 or hosts[0].lower() not in self.hosts:
            return PlainTextResponse("This is not an address of this server.", 421)
        origins = headers.get("origin", [])
        if origins and origins != [f"http://{hosts[0]}"]:
            return PlainTextResponse("Pages of other sites may not ask here.", 403)
        if scope["method"] not in SAFE and not origins:
            return PlainTextResponse("Only this server's own page may change anything.", 403)
        query = parse_qsl(scope["query_string"].decode("latin-1"))
        given = dict(query).get("token")
        known = [given] if given is not None else self._cookies(headers.get("cookie", []))
        if not any(hmac.compare_digest(k.encode(), self.token.encode()) for k in known):
            return self._locked(scope, bool(known))
        if given is None:
            return None
        # The token goes into a cookie, out of the address and of the browser's history.
        rest = urlencode([(k, v) for k, v in query if k != "token"])
        answer = RedirectResponse(quote(scope["path"]) + (f"?{rest}" if rest else ""), 303)
        answer.set_cookie(self.cookie, self.token, MONTH, httponly=True, samesite="lax")
        return answer

    def _cookies(self, headers: list[str]) -> list[str]:
        try:
            cookies: SimpleCookie = SimpleCookie("; ".join(headers))
        except CookieError:
            return []
        return [cookies[self.cookie].value] if self.cookie in cookies else []

    def _locked(self, scope: Scope, tried: bool) -> Response:
        address = (scope.get("client") or ("",))[0]
        if tried:
            if len(self.wrong) > MOST_ADDRESSES:
                self.wrong.clear()
            wait = self.wrong.setdefault(address, Bucket(*WRONG_TOKENS)).take()
            if wait:
                return too_many(wait)
        return HTMLResponse(LOCKED, 401)


def too_many(wait: float) -> Response:
    return PlainTextResponse(
        "Too many at once: wait a little.", 429, {"retry-after": str(int(wait) + 1)}
    )
