"""The app's server: what the page asks for and what it may change.

Everything runs in one event loop, which alone writes ``capture.json``; decoding, fitting and
exporting run in two `Worker` processes, one for short work and one for maps, one capture at a time.
"""

from __future__ import annotations

import asyncio
import json
import shutil
import tempfile
import time
import traceback
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress
from dataclasses import asdict
from importlib import resources
from importlib.metadata import version
from pathlib import Path
from typing import Any

from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.middleware import Middleware
from starlette.requests import ClientDisconnect, Request
from starlette.responses import FileResponse, JSONResponse, Response, StreamingResponse
from starlette.routing import Route

from invrender.app import patterns, profiles, store
from invrender.app.guard import Bucket, Guard, too_many
from invrender.app.profiles import Profile
from invrender.app.workers import Died, Worker
from invrender.data.tablets import TABLETS
from invrender.pattern.display import pattern_page
from invrender.report.report import Report
from invrender.types import InputError

LARGEST_UPLOAD = 400_000_000  # bytes; a raw file of 100 megapixels has half of that
LARGEST_JSON = 200_000  # bytes
FREE = 1_000_000_000  # bytes of disk that an upload must leave
SLOWEST = 30.0  # seconds between two parts of an upload
UPLOADS = 60.0, 2.0  # photos at once, and a second afterwards
CHECK_SECONDS = 180.0  # of work after which a photo is given up
EXPORT_SECONDS = 300.0
ATTEMPTS = 2  # that a capture's maps are begun, where the program ends in the middle
SIZES = (128, 256, 512, 1024, 2048)  # pixels a side of maps
HEARTBEAT = 15.0  # seconds between signs of life to a page
# Files of a capture that the page may see, by the name in the address.
SHOWN_FILES = {
    **{f"preview_{n}.jpg": f"shown/preview_{n}.jpg"
       for n in ("diffuse", "specular", "roughness", "normal", "render", "lit")},
    **{f"{k}_{n}.jpg": f"shown/{k}_{n}.jpg" for k in ("map", "sigma")
       for n in ("diffuse", "specular", "roughness", "normal")},
    **{f"{n}.jpg": f"shown/{n}.jpg" for n in ("tile", "repeated", "height")},
    **{f"{n}.png": f"result/{n}.png"
       for n in ("photo", "render")},
    "viewer.json": "shown/viewer.json", "report.html": "result/report.html",
    "report.json": "result/report.json",
}  # fmt: skip
REPORT_POLICY = "sandbox allow-scripts; frame-ancestors 'none'"  # the report has its own policy
PAGE_FILES = {
    ".html": "text/html", ".css": "text/css", ".js": "text/javascript", ".svg": "image/svg+xml",
}  # fmt: skip


class App:
    """The server's state: the data folder, the workers, who listens, what is being computed."""

    def __init__(self, root: Path, links: dict[str, str], warm: bool = True) -> None:
        self.root, self.links, self.warm = root, links, warm
        self.quick, self.slow = Worker(), Worker()
        self.listeners: set[asyncio.Queue[str]] = set()
        self.stages: dict[str, dict[str, Any]] = {}  # of captures that are being computed
        self.looks: dict[str, dict[int, Any]] = {}  # at photos that are being checked
        self.queue: list[str] = []
        self.running: str | None = None
        self.cancelled = False
        self.wake = asyncio.Event()
        self.uploads = Bucket(*UPLOADS)
        self.shown = {"pattern": "default", "profile": ""}
        self.tasks: set[asyncio.Task[Any]] = set()
        self.rooms: dict[str, Any] | None = None

    # --- what the page sees ---------------------------------------------------------------------

    def capture(self, id: str) -> dict[str, Any]:
        """All that the page shows of a capture. Raises `KeyError`."""
        folder = store.folder_of(self.root, id)
        content = store.read(folder)
        photos = []
        for number in store.photo_numbers(folder):
            check = self.looks.get(id, {}).get(number)
            if check is None:
                check = store.read_json(folder / "shown" / str(number) / "check.json")
                check = check and {**check, "whole": True}
            told = content["files"].get(str(number), {})
            photos.append({"number": number, "check": check, **told})
        job, report = content["job"] or {}, None
        try:
            whole = Report.read(folder / "result")
            report = {
                k: v for k, v in whole.to_dict().items()
                if k in ("size", "sample_size", "seconds", "photo_error", "warnings", "map_error",
                         "converged", "status")
            }  # fmt: skip
            report["made"] = (folder / "result" / "report.json").stat().st_mtime
        except (InputError, OSError):
            pass
        state = "new" if report is None else "done"
        if job:
            state = "working" if id == self.running else job.get("state", "queued")
        return {
            "id": id, "photos": photos, "report": report, "state": state,
            "queue": self.queue.index(id) + 1 if id in self.queue else 0,
            "problem": job.get("problem"), "progress": self.stages.get(id),
            **{k: content[k] for k in ("name", "created", "notes", "tags", "job")},
        }  # fmt: skip

    def state(self) -> dict[str, Any]:
        """All that the page shows at first."""
        captures = []
        for id in store.all_ids(self.root):
            with suppress(KeyError, OSError):
                captures.append(self.capture(id))
        return {
            "version": version("invrender"), "captures": captures,
            "links": dict.fromkeys(self.links, True),
            "profiles": [asdict(p) for p in self.profiles()], "sizes": SIZES,
            "tablets": [t._asdict() for t in TABLETS], "shown": self.shown,
            "patterns": patterns.PATTERN_NAMES, "folder": str(self.root),
        }  # fmt: skip

    def profiles(self) -> list[Profile]:
        return profiles.read_profiles(self.root / "profiles.json")

    def profile(self, id: str) -> Profile:
        """The rig by its id, else the first."""
        known = self.profiles()
        return next((p for p in known if p.id == id), known[0])

    def tell(self, kind: str, content: Any) -> None:
        """Tell every page that listens."""
        text = f"event: {kind}\ndata: {json.dumps(content)}\n\n"
        for queue in list(self.listeners):
            if queue.full():  # a page that does not read: it will ask for all of it again
                self.listeners.discard(queue)
            else:
                queue.put_nowait(text)

    def changed(self, id: str) -> None:
        try:
            self.tell("capture", self.capture(id))
        except KeyError:
            self.tell("gone", id)

    # --- work -----------------------------------------------------------------------------------

    def start(self, coroutine: Any) -> None:
        """Run beside the rest, and keep it from being forgotten."""
        task = asyncio.create_task(coroutine)
        self.tasks.add(task)
        task.add_done_callback(self.tasks.discard)

    async def resume(self) -> None:
        """Take up what a server that ended has left: checks that are missing, jobs that wait."""
        for id in reversed(store.all_ids(self.root)):
            folder = store.folder_of(self.root, id)
            for number in store.photo_numbers(folder):
                if store.read_json(folder / "shown" / str(number) / "check.json") is None:
                    self.start(self.check(id, number))
            job = store.read(folder)["job"]
            if job and job.get("state") == "queued":
                if job.get("attempts", 0) >= ATTEMPTS:
                    text = "the program ended while it made these maps, twice: try a smaller size"
                    store.update(folder, job={**job, "state": "failed", "problem": text})
                else:
                    self.queue.append(id)
        self.wake.set()

    async def check(self, id: str, number: int) -> None:
        """Show a photo and what is found in it."""
        looks = self.looks.setdefault(id, {})
        looks[number] = {}

        def look(answer: dict[str, Any]) -> None:
            looks[number] = answer
            self.changed(id)

        self.changed(id)
        try:
            folder = store.folder_of(self.root, id)
            place = str(folder)
            await self.quick.run("check", place, number, progress=look, seconds=CHECK_SECONDS)
        except KeyError:
            return  # discarded meanwhile
        except Exception as error:
            text = "this file ends the program that reads it, or takes too long; it was left alone"
            if not isinstance(error, Died):
                traceback.print_exc()
                text = "this photo cannot be looked at: a fault of the program, told in its window"
            out = folder / "shown" / str(number)
            with suppress(OSError):
                out.mkdir(parents=True, exist_ok=True)
                (out / "check.json").write_text(json.dumps({"problem": text}), encoding="utf-8")
        finally:
            looks.pop(number, None)
        self.changed(id)

    async def work(self) -> None:
        """Make the maps of what is in the queue, one capture after another, for ever."""
        while True:
            await self.wake.wait()
            self.wake.clear()
            while self.queue:
                id = self.running = self.queue.pop(0)
                self.cancelled = False
                try:
                    await self._refine(id)
                except Exception:
                    traceback.print_exc()
                self.running = None
                self.stages.pop(id, None)
                self.changed(id)
                for waiting in self.queue:
                    self.changed(waiting)

    async def _refine(self, id: str) -> None:
        try:
            folder = store.folder_of(self.root, id)
        except KeyError:
            return
        job = store.read(folder)["job"] or {}
        job = {**job, "attempts": job.get("attempts", 0) + 1}
        store.update(folder, job=job)
        stage = self.stages[id] = {"stage": "lights", "share": 0.0, "began": time.time()}

        def progress(told: dict[str, Any]) -> None:
            stage.update(told)
            self.changed(id)

        self.changed(id)
        problem = None
        try:
            await self.slow.run(
                "refine", str(folder), job.get("size", 256), "network", progress=progress
            )
        except InputError as error:
            problem = str(error)
        except Died:
            problem = None if self.cancelled else "the process that made the maps was ended"
        except Exception:
            traceback.print_exc()
            problem = "a fault of the program, told in its window"
        if folder.is_dir():  # not discarded meanwhile
            failed = {**job, "state": "failed", "problem": problem}
            store.update(folder, job=failed if problem else None)
            if self.warm and not problem:  # while a person looks at the maps
                self.start(_quietly(self.quick.run("warm_export")))

    def cancel(self, id: str) -> None:
        """Take a capture out of the queue, or end what is being computed."""
        folder = store.folder_of(self.root, id)
        if id in self.queue:
            self.queue.remove(id)
        if id == self.running:
            self.cancelled = True
            self.slow.kill()
        store.update(folder, job=None)
        self.changed(id)


# --- requests -------------------------------------------------------------------------------------


def _app(request: Request) -> App:
    return request.app.state.app  # type: ignore[no-any-return]


async def _json(request: Request) -> Any:
    """The body as JSON. Raises `InputError`."""
    body = b""
    async for part in request.stream():
        body += part
        if len(body) > LARGEST_JSON:
            raise InputError("that is too long")
    try:
        return json.loads(body or b"{}")
    except (ValueError, RecursionError):
        raise InputError("that is not JSON") from None


async def get_state(request: Request) -> Response:
    return JSONResponse(_app(request).state())


async def get_events(request: Request) -> Response:
    """Everything that changes, as server-sent events; all of it first."""
    app = _app(request)
    queue: asyncio.Queue[str] = asyncio.Queue(1000)
    app.listeners.add(queue)

    async def stream() -> AsyncIterator[str]:
        try:
            yield f"event: state\ndata: {json.dumps(app.state())}\n\n"
            while queue in app.listeners:
                try:
                    yield await asyncio.wait_for(queue.get(), HEARTBEAT)
                except TimeoutError:
                    yield ": still here\n\n"
        finally:
            app.listeners.discard(queue)

    return StreamingResponse(stream(), media_type="text/event-stream")


async def post_profile(request: Request) -> Response:
    app, values = _app(request), await _json(request)
    id = values.get("id", "") if isinstance(values, dict) else ""
    known = {p.id for p in app.profiles()}
    profile = profiles.profile_of(values, id if id in known and isinstance(id, str) else "")
    profile = profiles.save_profile(app.root / "profiles.json", profile)
    app.tell("profiles", [asdict(p) for p in app.profiles()])
    return JSONResponse(asdict(profile), 201)


async def delete_profile(request: Request) -> Response:
    app = _app(request)
    profiles.delete_profile(app.root / "profiles.json", request.path_params["id"])
    app.tell("profiles", [asdict(p) for p in app.profiles()])
    return Response(status_code=204)


async def get_guide(request: Request) -> Response:
    app = _app(request)
    profile = app.profile(request.path_params["id"])
    with tempfile.TemporaryDirectory(dir=app.root / "uploads") as folder:
        file = Path(folder) / "guide.pdf"
        await app.quick.run("guide", profile.rig(), str(file), seconds=EXPORT_SECONDS)
        content = file.read_bytes()
    name = {"content-disposition": 'attachment; filename="invrender-guide.pdf"'}
    return Response(content, media_type="application/pdf", headers=name)


async def post_capture(request: Request) -> Response:
    """Take an upload: its body is the file, the address says its name, rig and pattern."""
    app, query = _app(request), request.query_params
    if wait := app.uploads.take():
        return too_many(wait)
    if query.get("example"):
        id, number = store.create_example(app.root), 1
    else:
        file = query.get("file", "")
        suffix = store.photo_suffix(file)
        pattern = query.get("pattern", app.shown["pattern"])
        if pattern not in patterns.PATTERN_NAMES:
            raise InputError("no such pattern")
        into = query.get("capture")
        folder = store.folder_of(app.root, into) if into else None
        with tempfile.TemporaryDirectory(dir=app.root / "uploads") as place:
            uploaded = Path(place) / f"photo{suffix}"
            await _receive(request, uploaded, app.root)
            if into is None or folder is None:
                profile = app.profile(query.get("profile", ""))
                into = store.create(app.root, Path(file).stem[:80], profile.rig_toml())
                folder = store.folder_of(app.root, into)
            image = patterns.pattern(pattern)
            number = store.add_photo(folder, uploaded, suffix, file, pattern, image)
        id = into
    app.start(app.check(id, number))
    return JSONResponse(app.capture(id), 201)


async def _receive(request: Request, file: Path, root: Path) -> None:
    """Write a request's body to a file. Raises `InputError` for one that is too long, or empty."""
    expected = request.headers.get("content-length", "0")
    size, room = 0, shutil.disk_usage(root).free - FREE
    expected_size = int(expected) if expected.isascii() and expected.isdigit() else 0
    with file.open("wb") as out:
        stream = request.stream().__aiter__()
        while True:
            try:
                part = await asyncio.wait_for(anext(stream), SLOWEST)
            except StopAsyncIteration:
                break
            except TimeoutError:
                raise InputError("the upload has stalled: try again") from None
            size += len(part)
            if max(size, expected_size) > LARGEST_UPLOAD:
                raise InputError(
                    f"the file has more than {LARGEST_UPLOAD // 1_000_000} MB: no photo needs that"
                )
            if max(size, expected_size) > room:
                raise InputError(
                    f"the disk is full: less than {FREE // 1_000_000} MB would be left"
                )
            out.write(part)
    if not size:
        raise InputError("the file is empty")


async def get_capture(request: Request) -> Response:
    return JSONResponse(_app(request).capture(request.path_params["id"]))


async def patch_capture(request: Request) -> Response:
    """Change name, notes or tags; or what was set by hand in a photo, which is then checked."""
    app, id, values = _app(request), request.path_params["id"], await _json(request)
    folder = store.folder_of(app.root, id)
    if not isinstance(values, dict):
        raise InputError("that is not what a capture has")
    store.update(folder, **store.checked_texts(values))
    if "fix" in values:
        number = values.get("number", 1)
        if number not in store.photo_numbers(folder):
            raise InputError("there is no such photo")
        fix = store.checked_fix(values["fix"])
        store.update(folder, fixes={**store.read(folder)["fixes"], str(number): fix})
        app.start(app.check(id, number))
    app.changed(id)
    return JSONResponse(app.capture(id))


async def delete_capture(request: Request) -> Response:
    app, id = _app(request), request.path_params["id"]
    app.cancel(id)
    if id == app.running:
        with suppress(TimeoutError):
            await asyncio.wait_for(_until(lambda: app.running != id), 10)
    store.discard(app.root, id)
    app.tell("gone", id)
    return Response(status_code=204)


async def _until(true: Callable[[], bool]) -> None:
    while not true():
        await asyncio.sleep(0.02)


async def post_restore(request: Request) -> Response:
    app, id = _app(request), request.path_params["id"]
    store.restore(app.root, id)
    app.changed(id)
    return JSONResponse(app.capture(id))


async def post_refine(request: Request) -> Response:
    app, id, values = _app(request), request.path_params["id"], await _json(request)
    folder = store.folder_of(app.root, id)
    size = values.get("size", 256) if isinstance(values, dict) else None
    if size not in SIZES:
        raise InputError(f"the maps have {', '.join(map(str, SIZES))} pixels a side")
    if not store.photo_numbers(folder):
        raise InputError("this capture has no photo yet")
    if id != app.running and id not in app.queue:
        store.update(folder, job={"state": "queued", "size": size, "attempts": 0})
        app.queue.append(id)
        app.wake.set()
    app.changed(id)
    return JSONResponse(app.capture(id), 202)


async def post_cancel(request: Request) -> Response:
    app, id = _app(request), request.path_params["id"]
    app.cancel(id)
    return JSONResponse(app.capture(id))


async def post_export(request: Request) -> Response:
    app, id, values = _app(request), request.path_params["id"], await _json(request)
    folder = store.folder_of(app.root, id)
    known = {
        "target": str, "format": str, "normal_convention": str, "name": str, "licence": str,
        "tileable": bool, "height": bool,
    }  # fmt: skip
    if not isinstance(values, dict) or not all(
        isinstance(v, known.get(k, type(None))) for k, v in values.items()
    ):
        raise InputError("no such export")
    target = values.pop("target", "")
    options = {k: v for k, v in values.items() if v != ""}
    return JSONResponse(
        await app.quick.run("export", str(folder), target, options, seconds=EXPORT_SECONDS)
    )


async def post_tile(request: Request) -> Response:
    app = _app(request)
    folder = store.folder_of(app.root, request.path_params["id"])
    return JSONResponse(await app.quick.run("tile", str(folder), seconds=EXPORT_SECONDS))


async def get_export(request: Request) -> Response:
    folder = store.folder_of(_app(request).root, request.path_params["id"]) / "exports"
    name = request.path_params["file"]
    if not folder.is_dir() or name not in {p.name for p in folder.iterdir() if p.is_file()}:
        raise KeyError(name)
    return FileResponse(folder / name, filename=name, media_type="application/octet-stream")


async def get_file(request: Request) -> Response:
    """A picture of a capture."""
    app = _app(request)
    folder = store.folder_of(app.root, request.path_params["id"])
    name, number = request.path_params["file"], request.path_params.get("number")
    if number is not None:
        if name not in store.PHOTO_FILES:
            raise KeyError(name)
        file = folder / "shown" / str(number) / name
    else:
        file = folder / SHOWN_FILES[name]
        if not file.is_file() and (folder / "result" / "report.json").is_file():
            await app.slow.run("views", str(folder))
    if not file.is_file():
        raise KeyError(name)
    headers = {"content-security-policy": REPORT_POLICY} if name == "report.html" else {}
    return FileResponse(file, headers=headers)


async def get_rooms(request: Request) -> Response:
    app = _app(request)
    if app.rooms is None:
        app.rooms = await app.quick.run("rooms")
    return JSONResponse(app.rooms)


async def get_tablet(request: Request) -> Response:
    """The pattern's page, which follows what the other pages choose."""
    app = _app(request)
    profile = app.profile(request.query_params.get("profile", app.shown["profile"]))
    page = pattern_page(
        patterns.pattern(app.shown["pattern"]),
        profile.rig().screen_sides,
        profile.ppi,
        script="/page/tablet.js",
    )
    policy = {"content-security-policy": "frame-ancestors 'none'"}  # the page has its own
    return Response(page, media_type="text/html; charset=utf-8", headers=policy)


async def get_pattern(request: Request) -> Response:
    return Response(patterns.pattern_png(request.path_params["name"]), media_type="image/png")


async def post_shown(request: Request) -> Response:
    """Choose what the tablet shows."""
    app, values = _app(request), await _json(request)
    pattern = values.get("pattern", "default") if isinstance(values, dict) else ""
    if pattern not in patterns.PATTERN_NAMES:
        raise InputError("no such pattern")
    app.shown = {"pattern": pattern, "profile": app.profile(str(values.get("profile", ""))).id}
    app.tell("shown", app.shown)
    return JSONResponse(app.shown)


async def get_qr(request: Request) -> Response:
    """The QR code of one of the server's links."""
    import io

    import segno

    link = _app(request).links[request.path_params["name"]]
    out = io.BytesIO()
    segno.make(link, error="m").save(out, kind="svg", scale=4, border=2, xmldecl=False)
    return Response(out.getvalue(), media_type="image/svg+xml")


async def get_page(request: Request) -> Response:
    """The page's own files; the viewer is the report's."""
    name = request.path_params.get("file", "index.html")
    folder = resources.files("invrender.app") / "page"
    if name == "viewer.js":
        folder = resources.files("invrender.report") / "templates"
    if name not in {f.name for f in folder.iterdir()} or Path(name).suffix not in PAGE_FILES:
        raise KeyError(name)
    content = (folder / name).read_bytes()
    return Response(content, media_type=PAGE_FILES[Path(name).suffix] + "; charset=utf-8")


async def on_input_error(request: Request, error: Exception) -> Response:
    return JSONResponse({"problem": str(error)}, 422)


async def on_missing(request: Request, error: Exception) -> Response:
    return JSONResponse({"problem": "there is no such thing here"}, 404)


async def on_died(request: Request, error: Exception) -> Response:
    text = "that took too long, or ended the program that did it"
    return JSONResponse({"problem": text}, 500)


async def on_http(request: Request, error: Exception) -> Response:
    assert isinstance(error, HTTPException)
    return JSONResponse({"problem": error.detail}, error.status_code)


async def on_cut_off(request: Request, error: Exception) -> Response:
    return Response(status_code=400)


ROUTES = [
    Route("/", get_page),
    Route("/page/{file}", get_page),
    Route("/tablet", get_tablet),
    Route("/qr/{name}.svg", get_qr),
    Route("/patterns/{name}.png", get_pattern),
    Route("/api/state", get_state),
    Route("/api/events", get_events),
    Route("/api/shown", post_shown, methods=["POST"]),
    Route("/api/rooms", get_rooms),
    Route("/api/profiles", post_profile, methods=["POST"]),
    Route("/api/profiles/{id}", delete_profile, methods=["DELETE"]),
    Route("/api/profiles/{id}/guide.pdf", get_guide),
    Route("/api/captures", post_capture, methods=["POST"]),
    Route("/api/captures/{id}", get_capture),
    Route("/api/captures/{id}", patch_capture, methods=["PATCH"]),
    Route("/api/captures/{id}", delete_capture, methods=["DELETE"]),
    Route("/api/captures/{id}/restore", post_restore, methods=["POST"]),
    Route("/api/captures/{id}/refine", post_refine, methods=["POST"]),
    Route("/api/captures/{id}/cancel", post_cancel, methods=["POST"]),
    Route("/api/captures/{id}/export", post_export, methods=["POST"]),
    Route("/api/captures/{id}/tile", post_tile, methods=["POST"]),
    Route("/captures/{id}/exports/{file}", get_export),
    Route("/captures/{id}/photos/{number:int}/{file}", get_file),
    Route("/captures/{id}/{file}", get_file),
]


def make_app(
    root: Path, hosts: frozenset[str], links: dict[str, str], cookie: str, warm: bool = True
) -> Starlette:
    """The ASGI application. hosts: the addresses, with the port, that it answers to; links: the
    addresses with the token that the page shows as QR codes; warm: compile before anybody asks."""
    store.prepare(root)
    state = App(root, links, warm)

    @asynccontextmanager
    async def lifespan(app: Starlette) -> AsyncIterator[None]:
        state.start(state.work())
        await state.resume()
        if warm:
            state.start(_quietly(state.quick.run("warm_check")))
            if not state.queue:
                state.start(_quietly(state.slow.run("warm")))
        yield
        for worker in (state.quick, state.slow):
            worker.kill()
        for task in list(state.tasks):
            task.cancel()

    app = Starlette(
        routes=ROUTES,
        middleware=[Middleware(Guard, hosts=hosts, token=store.token(root), cookie=cookie)],
        exception_handlers={
            InputError: on_input_error, KeyError: on_missing, Died: on_died,
            HTTPException: on_http, ClientDisconnect: on_cut_off,
        },
        lifespan=lifespan,
    )  # fmt: skip
    app.state.app = state
    return app


async def _quietly(coroutine: Any) -> None:
    with suppress(Died, RuntimeError, InputError):
        await coroutine
