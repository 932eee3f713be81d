"""Every error as RFC 9457 `application/problem+json`: ours, those of validation, of routing, and the unforeseen."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from http import HTTPStatus

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import Response
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from common.asgi import limited
from common.errors import NotFoundError, SurfacelinkError
from common.problems import (
    MEDIA_TYPE,
    Problem,
    kinds,
    problem_of,
    problem_of_fields,
    problem_of_status,
    refused_parameters,
)

logger = logging.getLogger(__name__)


def respond(problem: Problem, headers: Mapping[str, str] | None = None) -> Response:
    """A problem as an HTTP answer."""
    return Response(
        problem.model_dump_json(exclude_none=True),
        status_code=problem.status,
        media_type=MEDIA_TYPE,
        headers={"Cache-Control": "no-store", **(headers or {})},
    )


def _headers_of(error: SurfacelinkError) -> dict[str, str]:
    return {} if error.retry_after is None else {"Retry-After": str(error.retry_after)}


async def _on_surfacelink_error(_request: Request, error: Exception) -> Response:
    if not isinstance(error, SurfacelinkError):
        raise error
    if error.status >= HTTPStatus.INTERNAL_SERVER_ERROR:
        logger.error("%s: %s", error.title, error.detail)
    return respond(problem_of(error), _headers_of(error))


async def _on_http_exception(request: Request, error: Exception) -> Response:
    if not isinstance(error, HTTPException):
        raise error
    if isinstance(error.__cause__, SurfacelinkError):
        # FastAPI makes a 400 of whatever is raised while it reads a body of JSON.
        return await _on_surfacelink_error(request, error.__cause__)
    details = {
        HTTPStatus.BAD_REQUEST: "the body cannot be read; accepted is JSON in UTF-8",
        HTTPStatus.NOT_FOUND: f"there is nothing at {request.url.path}; /docs lists what there is",
        HTTPStatus.METHOD_NOT_ALLOWED: f"{request.method} is not possible here; see the header Allow",
    }
    headers = {**(error.headers or {}), **_allow(request)} if error.status_code == 405 else error.headers
    return respond(problem_of_status(error.status_code, details.get(HTTPStatus(error.status_code))), headers)


def _allow(request: Request) -> dict[str, str]:
    """The header Allow with all methods of a path: routing knows those of the first route that has the path."""
    path = getattr(request.scope.get("route"), "path_format", None)
    methods = request.app.openapi()["paths"].get(path, {})
    return {"Allow": ", ".join(method.upper() for method in methods)} if methods else {}


async def _on_validation_error(_request: Request, error: Exception) -> Response:
    if not isinstance(error, RequestValidationError):
        raise error
    return respond(problem_of_fields(error.errors()))


async def on_disconnect(_request: Request, _error: Exception) -> Response:
    """An upload that is broken off is no fault of the service, for its log; no one is there to read an answer."""
    return Response(status_code=HTTPStatus.BAD_REQUEST)


async def _on_anything_else(_request: Request, _error: Exception) -> Response:
    return respond(problem_of_status(500, "the fault is the receiver's; its log says more"))


async def known_query(request: Request) -> None:
    """For every route: raises RequestValidationError where a query parameter is none of the route's, or given twice."""
    if request.query_params:
        path = request.scope["route"].path_format
        given = [name for name, _ in request.query_params.multi_items()]
        refused = refused_parameters(request.app.openapi(), path, request.method, given)
        if refused:
            raise RequestValidationError(refused)


def install(app: FastAPI) -> None:
    """Make `app` answer each error as a problem."""
    app.add_exception_handler(SurfacelinkError, _on_surfacelink_error)
    app.add_exception_handler(HTTPException, _on_http_exception)
    app.add_exception_handler(RequestValidationError, _on_validation_error)
    app.add_exception_handler(ClientDisconnect, on_disconnect)
    app.add_exception_handler(Exception, _on_anything_else)

    @app.get("/problems/{name}", tags=["errors"], summary="What a kind of error means")
    def explain(name: str) -> Problem:
        kind = kinds().get(name)
        if kind is None:
            raise NotFoundError(f"no such kind of error; there are {', '.join(sorted(kinds()))}")
        meaning = " ".join((kind.__doc__ or "").split())
        return Problem(type=f"/problems/{name}", title=kind.title, status=kind.status, detail=meaning)


class Guard:
    """ASGI middleware around all others: limits the body, and answers our errors that are raised outside the routes."""

    def __init__(self, app: ASGIApp, max_body_bytes: int) -> None:
        self.app = app
        self.max_body_bytes = max_body_bytes

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        started = False

        async def noted(message: Message) -> None:
            nonlocal started
            started = True
            await send(message)

        try:
            await self.app(scope, limited(scope, receive, self.max_body_bytes), noted)
        except SurfacelinkError as error:
            if started:
                raise
            await respond(problem_of(error), _headers_of(error))(scope, receive, send)
