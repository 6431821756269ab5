"""What browsers get: pages, figures, and what comes of them as it comes.

Only this box is answered, under the names that it goes by: a page of somebody else cannot have a browser read
from here.
"""

from __future__ import annotations

import asyncio
import gzip
import json
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
from starlette.responses import HTMLResponse, JSONResponse, Response, StreamingResponse
from starlette.routing import Route

from daqsvc import __version__
from daqsvc.page.charts import THEMES
from daqsvc.page.presence import Picture
from daqsvc.page.source import NOT_OURS
from daqsvc.page.text import WORST, tile
from daqsvc.page.views.all_views import VIEWS

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from starlette.requests import Request
    from starlette.types import ASGIApp, Message, Receive, Scope, Send

    from daqsvc.page.charts import Theme
    from daqsvc.page.machine_live import MachineLive
    from daqsvc.page.sources import MachineSource
    from daqsvc.page.views.view import MachineView

HEADERS = {
    # BokehJS puts styles into its figures.
    "content-security-policy": (
        "default-src 'none'; script-src 'self'; connect-src 'self'; img-src 'self' data: blob:; "
        "style-src 'self' 'unsafe-inline'; base-uri 'none'; form-action 'self'; frame-ancestors 'none'"
    ),
    "x-content-type-options": "nosniff",
    "referrer-policy": "no-referrer",
    "cache-control": "no-store",
}
FIRST_S = 3.0
"""How long a page waits for what the service tells first."""


def application(source: MachineSource) -> Starlette:
    """The page of a box; ``state.close`` ends what browsers listen to.

    Args:
        source: of the machines.
    """
    page = _Page(source)
    routes = [
        Route("/", page.plant),
        Route("/plant.json", page.plant_rows),
        Route("/machines/{machine}", page.machine),
        Route("/machines/{machine}/{view}", page.machine),
        Route("/events/{machine}", page.events),
        Route("/events/{machine}/{view}", page.events),
        Route("/figures/{machine}/{view}", page.figures),
        Route("/static/{name}", _static),
    ]

    middleware = [
        Middleware(TrustedHostMiddleware, allowed_hosts=["localhost", "127.0.0.1", "[::1]"]),
        Middleware(_Guarded),
    ]
    made = Starlette(routes=routes, middleware=middleware)
    made.state.close = page.close
    return made


class _Guarded:
    """Adds `HEADERS` to whatever is answered."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        async def guarded(message: Message) -> None:
            if message["type"] == "http.response.start":
                own = {name.lower() for name, _ in message["headers"]}
                added = [(name.encode(), value.encode()) for name, value in HEADERS.items()]
                message["headers"] = [*message["headers"], *(one for one in added if one[0] not in own)]
            await send(message)

        await self._app(scope, receive, guarded)


class _Page:
    def __init__(self, source: MachineSource) -> None:
        self._source = source
        self._pictures: dict[tuple[str, ...], Picture] = {}
        self._templates = Environment(
            loader=PackageLoader("daqsvc.page"), autoescape=True, undefined=StrictUndefined
        )

    async def close(self) -> None:
        """End what browsers listen to."""
        for picture in self._pictures.values():
            await picture.close()
        await self._source.close()

    async def plant(self, _: Request) -> Response:
        """All machines of the box."""
        return self._html("plant.html", title="Plant", **await self._plant())

    async def plant_rows(self, _: Request) -> Response:
        """The same as JSON, for who looks again."""
        return JSONResponse(await self._plant())

    async def _plant(self) -> dict[str, Any]:
        try:
            tiles = [tile(status) for status in await self._source.statuses()]
        except (OSError, *NOT_OURS):
            return {"tiles": [], "why": "no daqsvc answers on this box: it is started with daqsvc run"}
        tiles.sort(key=lambda one: (-WORST.get(one["level"], 0), one["name"]))
        return {"tiles": tiles, "why": ""}

    async def machine(self, request: Request) -> Response:
        """One machine, by one view or as a whole."""
        name, chosen_view = request.path_params["machine"], request.path_params.get("view")
        live, why = await self._first(name)
        view = VIEWS.get(chosen_view or "")
        if live is None or (chosen_view and view is None):
            why = why or f"there is no view {chosen_view!r}"
            page = self._html("absent.html", title=name, why=why, again=live is None)
            page.status_code = 404
            return page
        choices, chosen = _chosen(view, live, request.query_params)
        asked = request.query_params
        others = [(asked[name], one) for name, one in chosen.items() if asked.get(name, one) != one]
        instead = [f"{wanted} is not there; {one} is shown" for wanted, one in others]
        return self._html(
            "machine.html",
            title=f"{view.title if view else 'Machine'}: {name}",
            machine=name,
            description=live.values["machine"].get("description", ""),
            views=[
                {"name": one.name, "title": one.title, "absent": one.why_not(live)} for one in VIEWS.values()
            ],
            view=view,
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
        name, view = request.path_params["machine"], VIEWS.get(request.path_params.get("view", ""))
        live, why = await self._first(name)
        if live is None:
            # A browser asks again after an answer that ends well, and never after an error.
            told = json.dumps({"age_s": 0.0, "why": why})
            return Response(f"retry: 2000\ndata: {told}\n\n", media_type="text/event-stream")
        _, chosen = _chosen(view, live, request.query_params)
        key = (name, view.name if view else "", *(f"{a}={b}" for a, b in sorted(chosen.items())))
        if key not in self._pictures:
            self._pictures[key] = Picture(self._source, name, view, chosen)
        return StreamingResponse(self._pictures[key].events(), media_type="text/event-stream")

    async def _first(self, machine: str) -> tuple[MachineLive | None, str]:
        """A machine; None if the source does not know it yet, and why."""
        try:
            async with self._source.looking(machine) as heard:
                return await heard.first(FIRST_S), heard.why_not
        except KeyError:
            return None, f"there is no {machine!r} here"

    def _html(self, template: str, **values: Any) -> HTMLResponse:
        return HTMLResponse(self._templates.get_template(template).render(version=__version__, **values))


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
    told = []
    for one in view.figures(live, chosen, theme):
        for source in one.made.select({"type": ColumnDataSource}):
            if source.name in shown.sources:
                told_now = shown.sources[source.name]
                source.data = {column: np.asarray(values) for column, values in told_now.items()}
        item = json_item(one.made, ID(f"figure-{one.name}"))
        told.append({"name": one.name, "label": one.label, "item": item})
    return json.dumps(told)


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
