"""What browsers get: pages, figures, and what comes of them as it comes.

Only this box is answered, under the names that it goes by: a page of somebody else cannot have a browser read
from here.
"""

from __future__ import annotations

import asyncio
import contextlib
import gzip
import json
import time
from datetime import datetime
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any

import bokeh
import numpy as np
from bokeh.core.types import ID
from bokeh.embed import json_item
from bokeh.models import ColumnDataSource
from jinja2 import Environment, PackageLoader, StrictUndefined
from starlette.applications import Starlette
from starlette.middleware import Middleware
from starlette.middleware.trustedhost import TrustedHostMiddleware
from starlette.responses import (
    HTMLResponse,
    JSONResponse,
    PlainTextResponse,
    RedirectResponse,
    Response,
    StreamingResponse,
)
from starlette.routing import Mount, Route

from daqsvc import __version__
from daqsvc.acquisition.clock import NS_PER_S
from daqsvc.page.access.person import peer_of
from daqsvc.page.access.ways import COOKIE, ByAccounts, OpenHere, SignInError
from daqsvc.page.charts import THEMES
from daqsvc.page.detectable import Detectabilities, why_no_detector
from daqsvc.page.documentation import WHY_NOT, Documentation
from daqsvc.page.guard import FRAMING, Admitted, FormError, Forms, Guarded
from daqsvc.page.handling import MOST_EVENTS, FormOutcomes, alarms_page, handle
from daqsvc.page.listening import NOT_OURS
from daqsvc.page.presence import Picture
from daqsvc.page.recorded import NoPictureError
from daqsvc.page.sources import NotToldError
from daqsvc.page.text import WORST, tile
from daqsvc.page.views.all_views import VIEWS
from daqsvc.page.views.modes import ModesView

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Collection, Mapping, Sequence

    from starlette.requests import Request

    from daqsvc.page.access.person import Access, Person
    from daqsvc.page.box_snapshots import KeptSnapshot
    from daqsvc.page.charts import Theme
    from daqsvc.page.machine_live import MachineLive
    from daqsvc.page.sources import MachineSource
    from daqsvc.page.views.view import MachineView

LOOK_AGAIN_S = 2.0
"""How often it is seen whether who listens is still signed in."""
FIRST_S = 3.0
"""How long a page waits for what the service tells first."""


PANEL = ModesView.name
"""The view that the page of a machine as a whole has in it."""
LOOPBACK = ("localhost", "127.0.0.1", "[::1]")


def application(
    source: MachineSource,
    access: Access | None = None,
    *,
    hosts: Collection[str] = (),
    tls: bool = False,
    documentation: Path | None = None,
) -> Starlette:
    """The page of a box; ``state.close`` ends what browsers listen to.

    Args:
        source: of the machines.
        access: who may look, and who may act; None: everybody may look, and nobody act.
        hosts: names that it goes by, beside those of this box for itself.
        tls: whether browsers reach it over TLS.
        documentation: the folder of its site; None if it is not here.
    """
    access = access or OpenHere()
    page = _Page(source, access, tls=tls, has_documentation=documentation is not None)
    routes = [
        Route("/", page.plant),
        Route("/plant.json", page.plant_rows),
        Route("/sign-in", page.sign_in, methods=["GET", "POST"]),
        Route("/sign-out", page.sign_out, methods=["POST"]),
        Route("/operator", page.operator),
        Route("/machines/{machine}", page.machine),
        Route("/machines/{machine}/alarms", page.alarms, name="alarms"),
        Route("/machines/{machine}/alarms", page.handle, methods=["POST"]),
        Route("/machines/{machine}/snapshots", page.snapshots),
        Route("/machines/{machine}/detectability", page.detectability),
        Route("/beside", page.beside),
        Route("/machines/{machine}/{view}", page.machine),
        Route("/events/{machine}", page.events),
        Route("/events/{machine}/{view}", page.events),
        Route("/figures/{machine}/{view}", page.figures),
        Route("/static/{name}", _static),
        Mount("/docs", Documentation(documentation))
        if documentation
        else Route("/docs/{path:path}", page.no_documentation),
    ]

    middleware = [
        Middleware(Guarded),
        Middleware(TrustedHostMiddleware, allowed_hosts=[*LOOPBACK, *hosts]),
        Middleware(Admitted, access=access),
    ]
    made = Starlette(routes=routes, middleware=middleware)
    made.state.close = page.close
    return made


class _Page:
    def __init__(self, source: MachineSource, access: Access, *, tls: bool, has_documentation: bool) -> None:
        self._source = source
        self._access = access
        self._tls = tls
        self._has_documentation = has_documentation
        self._forms = Forms()
        self._outcomes = FormOutcomes()
        self._detectabilities = Detectabilities()
        self._pictures: dict[tuple[str, ...], Picture] = {}
        self._templates = Environment(
            loader=PackageLoader("daqsvc.page"), autoescape=True, undefined=StrictUndefined
        )

    async def close(self) -> None:
        """End what browsers listen to."""
        for picture in [*self._pictures.values()]:
            await picture.close()
        await self._detectabilities.close()
        await self._source.close()

    async def sign_in(self, request: Request) -> Response:
        """The form to sign in by, and what comes of it."""
        access = self._access
        if not isinstance(access, ByAccounts):
            return RedirectResponse("/", 303)
        then, why = _local(request.query_params.get("then", "/")), ""
        if request.method == "POST":
            try:
                fields = await self._forms.read(request)
                name, password = fields.get("name", ""), fields.get("password", "")
                secret = await access.sign_in(name, password, peer_of(request))
            except (FormError, SignInError) as error:
                why = f"{error}"
            else:
                return self._signed_in(secret, _local(fields.get("then", "/")))
        page = self._html(request, "sign_in.html", title="Sign in", then=then, why=why)
        page.status_code = 401 if why else 200
        return page

    async def operator(self, request: Request) -> Response:
        """Let who has the key of this start handle alarms."""
        if not isinstance(self._access, OpenHere):
            return RedirectResponse("/", 303)
        try:
            secret = self._access.begin(request.query_params.get("key", ""))
        except SignInError as error:
            page = self._html(request, "absent.html", title="Operator", why=f"{error}", again=False)
            page.status_code = 403
            return page
        return self._signed_in(secret, "/")

    async def sign_out(self, request: Request) -> Response:
        """End a session."""
        try:
            await self._forms.read(request)
        except FormError as error:
            return PlainTextResponse(f"Nothing was done: {error}.", 403)
        if isinstance(self._access, ByAccounts | OpenHere):
            self._access.end(request.cookies.get(COOKIE, ""))
        gone = RedirectResponse("/", 303)
        gone.delete_cookie(COOKIE, httponly=True, samesite="strict", secure=self._tls)
        return gone

    def _signed_in(self, secret: str, then: str) -> Response:
        come = RedirectResponse(then, 303)
        come.set_cookie(COOKIE, secret, httponly=True, samesite="strict", secure=self._tls)
        return come

    async def alarms(self, request: Request) -> Response:
        """All alarms of a machine, what has happened, and what can be done."""
        name = request.path_params["machine"]
        live, why = await self._first(name)
        if live is None:
            return self._absent(request, name, why)
        context = await alarms_page(self._source, live, name, request, self._forms, self._outcomes)
        return self._html(
            request,
            "alarms.html",
            **self._of_machine(live, name),
            title=f"Alarms: {name}",
            view=None,
            **context,
        )

    async def handle(self, request: Request) -> Response:
        """Do with an alarm what a form asks for."""
        return await handle(
            self._source, request.path_params["machine"], request, self._forms, self._outcomes
        )

    async def snapshots(self, request: Request) -> Response:
        """The recorder's snapshots of a machine, and two of them beside each other."""
        name = request.path_params["machine"]
        live, why = await self._first(name)
        if live is None:
            return self._absent(request, name, why)
        try:
            kept, why = await self._source.snapshots(name), ""
        except NotToldError as error:
            kept, why = [], f"{error}"
        except OSError:
            kept, why = [], "the snapshots cannot be read by who runs the page"
        calm = await self._healthy(name, kept)
        about = self._of_machine(live, name) | {"kept": kept, "why": why, "calm": calm}
        return self._html(request, "snapshots.html", title=f"Snapshots: {name}", view=None, **about)

    async def _healthy(self, machine: str, kept: Sequence[KeptSnapshot]) -> str:
        """The newest snapshot during which no alarm was active, by the journal; "" if there is none."""
        try:
            events = await self._source.journal(machine, "", MOST_EVENTS)
        except OSError:
            events = []
        return next((one.name for one in kept if one.kind != "alarm" and not _stood(events, one)), "")

    async def detectability(self, request: Request) -> Response:
        """Which faults can be distinguished on a machine."""
        name = request.path_params["machine"]
        live, why = await self._first(name)
        if live is None:
            return self._absent(request, name, why)
        result = self._detectabilities.of(live)
        about = self._of_machine(live, name) | {
            "waits": result is None,
            "text": result.text if result else "",
            "why_not": result.why_not.rstrip(".") if result else "",
        }
        return self._html(request, "detectability.html", title=f"Detectability: {name}", view=None, **about)

    async def beside(self, request: Request) -> Response:
        """Two machines or snapshots by one view, beside each other."""
        asked = request.query_params
        names = [name for name in (asked.get("left", ""), asked.get("right", "")) if name]
        view = VIEWS.get(asked.get("view", ""))
        page = self._html(
            request, "beside.html", title=" beside ".join(names) or "Beside", names=names, view=view
        )
        page.headers["content-security-policy"] = FRAMING
        return page

    async def plant(self, request: Request) -> Response:
        """All machines, or those that are looked for."""
        asked = request.query_params
        chosen = {"find": asked.get("find", ""), "show": asked.get("show", "")}
        return self._html(request, "plant.html", title="Plant", **chosen, **await self._plant(asked))

    async def plant_rows(self, request: Request) -> Response:
        """The same as JSON, for who looks again."""
        return JSONResponse(await self._plant(request.query_params))

    async def _plant(self, asked: Mapping[str, str]) -> dict[str, Any]:
        try:
            tiles = [tile(status) for status in await self._source.statuses()]
        except NotToldError as error:
            return {"tiles": [], "why": f"{error}", "hidden": 0}
        except (OSError, *NOT_OURS):
            why = "no daqsvc answers on this box: it is started with daqsvc run"
            return {"tiles": [], "why": why, "hidden": 0}
        tiles.sort(key=lambda one: (-WORST.get(one["level"], 0), one["level"] == "normal", one["name"]))
        find = asked.get("find", "").casefold()
        only_wrong = asked.get("show") == "wrong"
        shown = [
            one
            for one in tiles
            if find in f"{one['title']} {one['place']}".casefold()
            and not (only_wrong and one["level"] == "normal" and not one["alarms"])
        ]
        return {"tiles": shown, "why": "", "hidden": len(tiles) - len(shown)}

    async def machine(self, request: Request) -> Response:
        """One machine, by one view or as a whole."""
        name, chosen_view = request.path_params["machine"], request.path_params.get("view")
        live, why = await self._first(name)
        view = VIEWS.get(chosen_view or "")
        if live is None or (chosen_view and view is None):
            return self._absent(request, name, why or f"there is no view {chosen_view!r}", again=live is None)
        choices, chosen = _chosen(view, live, request.query_params)
        panel = "" if view or VIEWS[PANEL].why_not(live) else PANEL
        asked = request.query_params
        others = [(asked[name], one) for name, one in chosen.items() if asked.get(name, one) != one]
        instead = [f"{wanted} is not there; {one} is shown" for wanted, one in others]
        return self._html(
            request,
            "machine.html",
            **self._of_machine(live, name),
            title=f"{view.title if view else 'Machine'}: {name}",
            view=view,
            panel=panel,
            why_not=view.why_not(live) if view else "",
            choices=choices,
            chosen=chosen,
            instead=instead,
        )

    async def figures(self, request: Request) -> Response:
        """The figures of a view, for BokehJS."""
        view = VIEWS.get(request.path_params["view"])
        live, _ = await self._first(request.path_params["machine"])
        if view is None or live is None or view.why_not(live):
            return JSONResponse([])
        theme = THEMES.get(request.query_params.get("theme", ""), THEMES["light"])
        _, chosen = _chosen(view, live, request.query_params)
        return Response(
            await asyncio.to_thread(_figures, view, live, chosen, theme), media_type="application/json"
        )

    async def events(self, request: Request) -> Response:
        """What comes, for as long as the browser listens."""
        name, asked = request.path_params["machine"], request.path_params.get("view")
        view = VIEWS.get(asked or PANEL)
        live, why = await self._first(name)
        if live is None:
            # A browser asks again after an answer that ends well, and never after an error.
            message = json.dumps({"age_s": 0.0, "why": why})
            return Response(f"retry: 2000\ndata: {message}\n\n", media_type="text/event-stream")
        _, chosen = _chosen(view, live, request.query_params)
        key = (name, asked or "", *(f"{a}={b}" for a, b in sorted(chosen.items())))
        picture = Picture(self._source, name, view, chosen, as_a_whole=asked is None)
        return StreamingResponse(self._listened(key, picture, request), media_type="text/event-stream")

    async def _listened(
        self,
        key: tuple[str, ...],
        picture: Picture,
        request: Request,
    ) -> AsyncIterator[bytes]:
        """The events of a picture, or of one that is the same, for as long as this person may look."""
        picture = self._pictures.setdefault(key, picture)
        looked_s = time.monotonic()
        try:
            async with contextlib.aclosing(picture.events()) as events:
                async for event in events:
                    yield event
                    if time.monotonic() - looked_s > LOOK_AGAIN_S:
                        looked_s = time.monotonic()
                        if self._access.person(request) is None:
                            return
        finally:
            if not picture.is_looked_at:
                self._pictures.pop(key, None)

    async def _first(self, machine: str) -> tuple[MachineLive | None, str]:
        """A machine; None if the source does not know it yet, and why."""
        try:
            async with self._source.looking(machine) as heard:
                return await heard.first(FIRST_S), heard.why_not
        except KeyError:
            return None, f"there is no {machine!r} here"
        except NoPictureError as error:
            return None, f"{error}"

    def _of_machine(self, live: MachineLive, name: str) -> dict[str, Any]:
        """What every page of a machine shows."""
        views = VIEWS.values()
        return {
            "machine": name,
            "no_detectability": why_no_detector(live),
            "views": [{"name": one.name, "title": one.title, "absent": one.why_not(live)} for one in views],
        }

    async def no_documentation(self, request: Request) -> Response:
        """Say how to get it."""
        return self._absent(request, "Documentation", WHY_NOT, again=False)

    def _absent(self, request: Request, name: str, why: str, *, again: bool = True) -> Response:
        page = self._html(request, "absent.html", title=name, why=why, again=again)
        page.status_code = 404
        return page

    def _html(self, request: Request, template: str, **values: Any) -> HTMLResponse:
        person: Person | None = request.state.person
        about = {
            "version": __version__,
            "has_documentation": self._has_documentation,
            "person": person,
            "token": self._forms.token(person),
        }
        return HTMLResponse(self._templates.get_template(template).render(**about | values))


def _chosen(
    view: MachineView | None, live: MachineLive, asked: Mapping[str, str]
) -> tuple[Sequence[Any], dict[str, str]]:
    """What can be chosen in a view, and what is."""
    if view is None or view.why_not(live):
        return [], {}
    choices = view.choices(live)
    chosen = {
        one.name: asked[one.name] if asked.get(one.name) in one.options else next(iter(one.options))
        for one in choices
    }
    return choices, chosen


def _figures(view: MachineView, live: MachineLive, chosen: Mapping[str, str], theme: Theme) -> str:
    """The figures of a view with what is to be seen now, as JSON."""
    shown = view.shown(live, chosen)
    figures = []
    for one in view.figures(live, chosen, theme):
        for source in one.made.select({"type": ColumnDataSource}):
            if source.name in shown.sources:
                columns = shown.sources[source.name]
                source.data = {column: np.asarray(values) for column, values in columns.items()}
        item = json_item(one.made, ID(f"figure-{one.name}"))
        figures.append({"name": one.name, "label": one.label, "item": item})
    return json.dumps(figures)


def _stood(events: Sequence[Mapping[str, Any]], snapshot: KeptSnapshot) -> bool:
    """Whether an alarm was active when a snapshot was made, by its last event before; newest first."""
    at_ns = datetime.fromisoformat(snapshot.time_utc).timestamp() * NS_PER_S
    last: dict[str, str] = {}
    for event in events:
        if event["wall_ns"] <= at_ns:
            last.setdefault(event["alarm"], event["level"])
    return any(level != "normal" for level in last.values())


def _local(there: str) -> str:
    """A path of this server, for a browser to go on to."""
    # Browsers take two slashes, and a backslash, for the begin of another server's name.
    is_here = there.startswith("/") and there[1:2] not in {"/", "\\"} and there.isprintable()
    return there if is_here else "/"


async def _static(request: Request) -> Response:
    name = request.path_params["name"]
    kinds = {"bokeh.js": "text/javascript", "page.js": "text/javascript", "page.css": "text/css"}
    if name not in kinds:
        return Response("there is no such file", status_code=404)
    headers = {"content-encoding": "gzip", "cache-control": "max-age=3600", "vary": "accept-encoding"}
    return Response(_packed(name), media_type=kinds[name], headers=headers)


@cache
def _packed(name: str) -> bytes:
    """A file for the browser, compressed."""
    if name == "bokeh.js":
        data = (Path(bokeh.__file__).parent / "server" / "static" / "js" / "bokeh.min.js").read_bytes()
    else:
        data = (files("daqsvc.page") / "static" / name).read_bytes()
    return gzip.compress(data, 9)
