"""The HTTP interface of the service: :func:`make_app`."""

from __future__ import annotations

import json
import logging
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import asdict
from typing import Annotated, Any

from fastapi import APIRouter, Depends, FastAPI, Header, Path, Query, Request, Response
from fastapi.exceptions import RequestValidationError
from fastapi.security import HTTPBearer
from fastapi_offline import FastAPIOffline
from starlette.concurrency import run_in_threadpool
from starlette.exceptions import HTTPException

import marl_pack
from marl_pack.packer.packer import Packer
from marl_pack.plan import Plan
from marl_pack.service import models
from marl_pack.service.guard import App, Guard
from marl_pack.service.home import bins_page
from marl_pack.service.limits import LONGEST_KEY
from marl_pack.service.reading import StrictRoute, describe
from marl_pack.service.refusals import CODES, Refusal, code_of, document
from marl_pack.service.service import Answer, Bin, Service, dump
from marl_pack.service.store import StoreError

DESCRIPTION = """\
Open a bin, place boxes in it as they come, report where the robot really put them, and fetch the
plan. Lengths are in millimetres, weights in kilograms, angles in degrees.

A request that changes a bin may carry an `Idempotency-Key`: the same request with the same key is
done once, and gets the same answer again. Every answer has the bin's `step`; a request that names
a `step` is refused if the bin has changed since.
"""
BinId = Annotated[str, Path(description="The bin's id.", max_length=200)]
Key = Annotated[
    str | None,
    Header(
        alias="Idempotency-Key", min_length=1, max_length=LONGEST_KEY,
        description="The same request with the same key is done once.",
    ),
]  # fmt: skip
LISTED = 200
"""Bins on the first page."""
PAGE = {
    "content-security-policy": "default-src 'self' 'unsafe-inline' data: blob:",
    "x-content-type-options": "nosniff",
    "cache-control": "no-store",
}
"""Headers of a page: it loads nothing from elsewhere, and is always new."""


def _errors(*codes: str) -> dict[int | str, dict[str, Any]]:
    """Return the descriptions of errors for the description of the API."""
    found: dict[int | str, dict[str, Any]] = {}
    for code in codes:
        status, meaning = CODES[code]
        entry = found.setdefault(status, {"model": models.ErrorAnswer, "description": ""})
        entry["description"] += f"{', ' if entry['description'] else ''}`{code}`: {meaning}"
    return found


READS = _errors("unknown_bin", "impossible")
CHANGES = _errors(
    "not_json", "unknown_bin", "closed", "wrong_step", "too_many_steps", "impossible", "key_reused",
    "storage",
)  # fmt: skip


def _json(answer: Answer, status: int = 200) -> Response:
    """Return the response for an answer."""
    headers = {"Idempotent-Replayed": "true"} if answer.replayed else None
    return Response(answer.text, status, headers, "application/json")


def _given(body: models.Model | None) -> dict[str, Any]:
    """Return the values that a client gave."""
    return {} if body is None else body.model_dump(mode="json", exclude_unset=True)


def make_router(service: Service) -> APIRouter:
    """Return the routes of the service."""
    router = APIRouter(route_class=StrictRoute)

    @router.get("/", include_in_schema=False)
    def home() -> Response:
        """Return a page with links to the bins that were opened last."""
        return Response(bins_page(service.latest(LISTED)), 200, PAGE, "text/html; charset=utf-8")

    @router.get("/health", tags=["service"], summary="Whether the service runs")
    async def health() -> dict[str, str]:
        return {"status": "ok", "version": marl_pack.__version__}

    @router.post(
        "/bins", tags=["bins"], summary="Open a bin", status_code=201, response_model=models.Opened,
        responses=_errors("not_json", "exists", "too_many_bins", "impossible", "storage"),
    )  # fmt: skip
    async def open_bin(body: models.OpenBin | None = None, key: Key = None) -> Any:
        return _json(await service.open(_given(body), key), 201)

    @router.get(
        "/bins", tags=["bins"], summary="List the bins", response_model=models.Listing,
        responses=READS,
    )  # fmt: skip
    def list_bins(
        after: Annotated[str | None, Query(description="Begin after this bin.")] = None,
        limit: Annotated[int, Query(ge=1, le=1000)] = 100,
    ) -> Any:
        return Response(dump(service.list(after, limit)), media_type="application/json")

    @router.get(
        "/bins/{id}", tags=["bins"], summary="The bin so far", response_model=models.State,
        responses=READS,
    )  # fmt: skip
    async def read_bin(id: BinId) -> Any:
        return Response(await service.read(id, _state), media_type="application/json")

    @router.post(
        "/bins/{id}/offer", tags=["boxes"], summary="What place would do; nothing changes",
        response_model=models.Placed | models.NotPlaced, responses=CHANGES,
    )  # fmt: skip
    async def offer(id: BinId, body: models.Box) -> Any:
        return _json(await service.offer(id, _given(body)))

    @router.post(
        "/bins/{id}/place", tags=["boxes"], summary="Place a box",
        response_model=models.Placed | models.NotPlaced, responses=CHANGES,
    )  # fmt: skip
    async def place(id: BinId, body: models.Box, key: Key = None) -> Any:
        return _json(await service.change(id, "place", _given(body), key))

    @router.post(
        "/bins/{id}/actual", tags=["boxes"], summary="Report where the robot really put the box",
        response_model=models.Placed,
        responses=CHANGES | _errors("nothing_done", "other_box", "impossible_pose"),
    )  # fmt: skip
    async def actual(id: BinId, body: models.Actual, key: Key = None) -> Any:
        return _json(await service.change(id, "actual", _given(body), key))

    @router.post(
        "/bins/{id}/undo", tags=["boxes"], summary="Undo the last place or actual",
        response_model=models.Undone, responses=CHANGES | _errors("nothing_done"),
    )  # fmt: skip
    async def undo(id: BinId, body: models.Change | None = None, key: Key = None) -> Any:
        return _json(await service.change(id, "undo", _given(body), key))

    @router.post(
        "/bins/{id}/close", tags=["bins"], summary="Close the bin; it can only be read then",
        response_model=models.Closed, responses=CHANGES,
    )  # fmt: skip
    async def close(id: BinId, body: models.Change | None = None, key: Key = None) -> Any:
        return _json(await service.change(id, "close", _given(body), key))

    @router.get(
        "/bins/{id}/plan", tags=["results"], summary="The plan: plan.schema.json describes it",
        response_model=dict[str, Any], responses=READS,
    )  # fmt: skip
    async def read_plan(id: BinId) -> Any:
        plan = await service.read(id, _plan)
        text = await run_in_threadpool(lambda: dump(plan.to_dict()))
        return Response(text, media_type="application/json")

    async def replay_of(id: str) -> dict[str, Any]:
        """Return the content of the replay page; the bin may change meanwhile."""
        from marl_pack.replay.document import make_document

        plan, closed = await service.read(id, lambda bin, packer: (packer.plan, bin.closed))
        return {**await run_in_threadpool(make_document, plan, title=id), "closed": closed}

    @router.get(
        "/bins/{id}/replay", tags=["results"], summary="A page that shows the bin being packed",
        response_class=Response, responses={200: {"content": {"text/html": {}}}, **READS},
    )  # fmt: skip
    async def replay(id: BinId) -> Any:
        from marl_pack.replay.page import make_page

        page = make_page(await replay_of(id), live="replay.json")
        return Response(page, 200, PAGE, "text/html; charset=utf-8")

    @router.get(
        "/bins/{id}/replay.json", tags=["results"], summary="What the page shows",
        response_model=dict[str, Any], responses=READS,
    )  # fmt: skip
    async def replay_json(id: BinId) -> Any:
        text = dump(await replay_of(id))
        return Response(text, headers={"cache-control": "no-store"}, media_type="application/json")

    return router


def _state(bin: Bin, packer: Packer) -> str:
    """Return the state of a bin as JSON."""
    assert bin.row is not None
    state = packer.state
    return dump({
        "id": bin.id, "opened": bin.row.opened, "policy": json.loads(bin.row.arguments)["policy"],
        "boxes": state.boxes[0], "utilization": state.utilization[0], "weight": state.weight[0],
        "least_margin": state.least_margin, "step": bin.step, "closed": bin.closed,
        "options": asdict(packer.spec),
    })  # fmt: skip


def _plan(_: Bin, packer: Packer) -> Plan:
    return packer.plan


def make_app(service: Service, token: str | None = None) -> App:
    """Return the application (ASGI).

    Args:
        service: the bins. They are closed when the application ends.
        token: what clients have to know; None for no token.
    """

    @asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncIterator[None]:
        yield
        service.close()

    app = FastAPIOffline(
        redoc_url=None, title="marl_pack", version=marl_pack.__version__, description=DESCRIPTION,
        lifespan=lifespan,
    )  # fmt: skip
    # The guard checks the token; this only describes it.
    described = [] if token is None else [Depends(HTTPBearer(auto_error=False))]
    app.include_router(make_router(service), dependencies=described)

    def answer(status: int, code: str, message: str, headers: Any = None) -> Response:
        return Response(dump(document(code, message)), status, headers, "application/json")

    @app.exception_handler(HTTPException)
    def refused(_: Request, error: HTTPException) -> Response:
        if isinstance(error, Refusal):
            return answer(error.status_code, error.code, error.detail, error.headers)
        code = code_of(error.status_code)
        meaning = CODES[code][1] if code in CODES else str(error.detail)
        if code == "wrong_method":
            meaning = f"the page takes {(error.headers or {}).get('Allow', 'other methods')} only"
        return answer(error.status_code, code, meaning, error.headers)

    @app.exception_handler(RequestValidationError)
    def invalid(_: Request, error: RequestValidationError) -> Response:
        return answer(422, "impossible", describe(error.errors(), models.KEYS))

    @app.exception_handler(StoreError)
    def storage(_: Request, error: StoreError) -> Response:
        logging.getLogger(__name__).error("%s", error)
        return answer(503, "storage", f"nothing was done: {error}")

    @app.exception_handler(Exception)
    def unexpected(_: Request, error: Exception) -> Response:
        return answer(500, "internal", "an error in the service; its log says more")

    return Guard(app, token, service.limits.max_body)
