"""Who is let through: host, origin, token; and how often a wrong token may be tried."""

import asyncio

import pytest
from asgi import ask
from starlette.responses import PlainTextResponse

from invrender.app.guard import Bucket, Guard

HOST, TOKEN = "localhost:8765", "a-token-of-some-length"
COOKIE = f"invrender-8765={TOKEN}"


@pytest.fixture
def guarded():
    inside = PlainTextResponse("inside")
    guard = Guard(inside, frozenset({HOST, "192.168.1.7:8765"}), TOKEN, "invrender-8765")
    return lambda method, path, **headers: asyncio.run(
        ask(guard, method, path, **{"host": HOST, **headers})
    )


def test_the_token_opens_and_leaves_the_address(guarded):
    status, headers, _ = guarded("GET", f"/tablet?token={TOKEN}&profile=a%26b")
    assert status == 303 and headers["location"] == "/tablet?profile=a%26b"
    assert "HttpOnly" in headers["set-cookie"] and "SameSite=lax" in headers["set-cookie"]
    assert guarded("GET", "/", cookie=COOKIE)[2] == b"inside"


@pytest.mark.parametrize("cookie", ["", "invrender-8765=x", "other=" + TOKEN, "\x7f;=;,"])
def test_nothing_without_it(guarded, cookie):
    status, headers, body = guarded("GET", "/", cookie=cookie)
    assert status == 401 and b"inside" not in body and b"key" in body
    assert "frame-ancestors 'none'" in headers["content-security-policy"]
    assert headers["referrer-policy"] == "no-referrer"


def test_another_name_that_leads_here_is_refused(guarded):
    """DNS rebinding: the browser believes that the page is evil.example's own."""
    for host in ("evil.example:8765", "localhost", "localhost:1", "localhost:8765.evil.example"):
        assert guarded("GET", "/", host=host, cookie=COOKIE)[0] == 421
    assert guarded("GET", "/", host="192.168.1.7:8765", cookie=COOKIE)[0] == 200


def test_pages_of_other_sites_change_nothing(guarded):
    own = f"http://{HOST}"
    assert guarded("POST", "/", cookie=COOKIE, origin=own)[0] == 200
    for origin in ("http://evil.example", "null", "http://192.168.1.7:8765", own + ".evil", ""):
        assert guarded("POST", "/", cookie=COOKIE, origin=origin)[0] == 403
        assert guarded("DELETE", "/", cookie=COOKIE, origin=origin)[0] == 403
    assert guarded("POST", "/", cookie=COOKIE)[0] == 403  # a form of an old browser
    assert guarded("GET", "/", cookie=COOKIE, origin="http://evil.example")[0] == 403


def test_wrong_tokens_are_counted(guarded):
    tries = [guarded("GET", f"/?token=guess{i}") for i in range(60)]
    assert {status for status, *_ in tries} == {401, 429}
    assert int(tries[-1][1]["retry-after"]) > 0
    assert guarded("GET", f"/?token={TOKEN}")[0] == 303  # who knows it is not kept out


def test_a_bucket_fills_again():
    now = [0.0]
    bucket = Bucket(2, 0.5, clock=lambda: now[0])
    assert [bucket.take(), bucket.take()] == [0, 0]
    assert bucket.take() == pytest.approx(2)
    now[0] = 2.0
    assert bucket.take() == 0 and bucket.take() > 0
