"""The app without a server between: asked as its own page does."""

import asyncio
import json
from contextlib import asynccontextmanager
from urllib.parse import quote

from asgi import ask

from invrender.app import store
from invrender.app.server import make_app

HOST = "localhost:8765"


class Client:
    """Asks an application as its own page does."""

    def __init__(self, app, root):
        self.app, self.root = app, root
        self.cookie = f"c={store.token(root)}"

    async def __call__(self, method, path, body=b"", **headers):
        body = body if isinstance(body, bytes) else json.dumps(body).encode()
        given = {"host": HOST, "origin": f"http://{HOST}", "cookie": self.cookie, **headers}
        status, _, answer = await ask(self.app, method, path, body, **given)
        return status, json.loads(answer) if answer[:1] in (b"{", b"[") else answer

    async def upload(self, name, body, query=""):
        return await self("POST", f"/api/captures?file={quote(name)}{query}", body)

    async def settled(self, id):
        """The capture once nothing is being done about it."""
        while True:
            _, capture = await self("GET", f"/api/captures/{id}")
            checks = [p["check"] for p in capture["photos"]]
            busy = capture["state"] in ("queued", "working")
            if not busy and all(c and c.get("whole") for c in checks):
                return capture
            await asyncio.sleep(0.02)


@asynccontextmanager
async def running(root):
    app = make_app(root, frozenset({HOST}), {"here": f"http://{HOST}/"}, "c", warm=False)
    async with app.router.lifespan_context(app):
        yield Client(app, root)
