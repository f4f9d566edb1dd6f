"""One request to an ASGI application, without a server between."""

import asyncio


async def ask(app, method, path, body=b"", **headers):
    """(status, headers, body) of a request; a header's ``_`` stands for ``-``."""
    path, _, query = path.partition("?")
    pairs = [(k.replace("_", "-").encode(), v.encode()) for k, v in headers.items()]
    scope = {
        "type": "http", "asgi": {"version": "3.0"}, "http_version": "1.1", "method": method,
        "scheme": "http", "path": path, "raw_path": path.encode(), "root_path": "",
        "query_string": query.encode(), "headers": pairs, "client": ("127.0.0.1", 5),
        "server": ("localhost", 8765),
    }  # fmt: skip
    sent, status, given = [], None, {}
    parts = [body[i : i + 65536] for i in range(0, len(body), 65536)] or [b""]

    async def receive():
        part = parts.pop(0) if parts else None
        if part is None:
            await asyncio.sleep(3600)
        return {"type": "http.request", "body": part, "more_body": bool(parts)}

    async def send(message):
        nonlocal status, given
        if message["type"] == "http.response.start":
            status = message["status"]
            given = {k.decode(): v.decode() for k, v in message["headers"]}
        else:
            sent.append(message.get("body", b""))

    await app(scope, receive, send)
    return status, given, b"".join(sent)
