"""The door of the service: who may come in, and with what body."""

from __future__ import annotations

import asyncio
import base64
import binascii
import hmac
import ipaddress
import json
from collections.abc import Awaitable, Callable, MutableMapping
from contextlib import suppress
from typing import Any
from urllib.parse import urlsplit

from marl_pack.service.refusals import Refusal, document

Message = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[Message]]
Send = Callable[[Message], Awaitable[None]]
App = Callable[[Message, Receive, Send], Awaitable[None]]

SHORTEST_TOKEN = 16
"""Characters of the shortest token that is accepted."""
PATIENCE_S = 30.0
"""Seconds in which a body has to arrive."""
OPEN_PATHS = ("/health",)
"""Paths that need no token."""


def is_loopback(host: str) -> bool:
    """Return whether a host is this machine for itself: localhost, 127.0.0.1 or ::1."""
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return host.lower() == "localhost"


class Guard:
    """Check host, origin, token, type and size of every request before the application sees it.

    Without a token only addresses of this machine are served, so that no web page can reach the
    service under a name of its own (DNS rebinding). Requests that web pages of other sites send are
    refused.

    Args:
        app: the application.
        token: what clients have to know; None for no token.
        max_body: largest body in bytes.
    """

    def __init__(self, app: App, token: str | None, max_body: int) -> None:
        self.app, self.max_body = app, max_body
        self.token = None if token is None else token.encode()

    async def __call__(self, scope: Message, receive: Receive, send: Send) -> None:
        """Serve a request."""
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        headers = {name: value.decode("latin-1") for name, value in scope["headers"]}
        try:
            self._check(scope, headers)
            body = await self._body(headers, receive)
        except Refusal as error:
            await _refuse(error, send)
            return
        sent = False

        async def receive_body() -> Message:
            nonlocal sent
            if sent:
                return await receive()
            sent = True
            return {"type": "http.request", "body": body, "more_body": False}

        await self.app(scope, receive_body, send)

    def _check(self, scope: Message, headers: dict[bytes, str]) -> None:
        """Refuse a foreign host or origin, and a wrong token."""
        host = headers.get(b"host", "")
        if self.token is None and not is_loopback(_name(host)):
            raise Refusal("foreign_host", f"Host {host!r}: needs localhost or a loopback address")
        origin = headers.get(b"origin")
        if origin is not None and urlsplit(origin).netloc.lower() != host.lower():
            raise Refusal("foreign_origin", f"Origin {origin!r}: needs a page of this service")
        if self.token is None or scope["path"] in OPEN_PATHS:
            return
        if not hmac.compare_digest(_credential(headers.get(b"authorization", "")), self.token):
            raise Refusal(
                "unauthorized", "needs Authorization: Bearer TOKEN, or Basic with it as password",
                {"www-authenticate": 'Bearer, Basic realm="marl_pack", charset="UTF-8"'},
            )  # fmt: skip

    async def _body(self, headers: dict[bytes, str], receive: Receive) -> bytes:
        """Return the body of a request, which is JSON of limited size, or nothing."""
        length = headers.get(b"content-length", "0")
        if length == "0" and b"transfer-encoding" not in headers:
            return b""
        kind = headers.get(b"content-type", "").partition(";")[0].strip().lower()
        if kind != "application/json":
            raise Refusal("wrong_type", f"Content-Type {kind!r}: needs application/json")
        large = Refusal("too_large", f"the body needs at most {self.max_body} bytes (max_body)",
                        {"connection": "close"})  # fmt: skip
        if length.isdigit() and int(length[:20]) > self.max_body:
            raise large
        body = bytearray()
        try:
            async with asyncio.timeout(PATIENCE_S):
                while True:
                    message = await receive()
                    body += message.get("body", b"")
                    if len(body) > self.max_body:
                        raise large
                    if not message.get("more_body", False):
                        return bytes(body)
        except TimeoutError:
            raise Refusal(
                "slow", f"the body needs to arrive within {PATIENCE_S:g} s", {"connection": "close"}
            ) from None


def _name(host: str) -> str:
    """Return the host of a header ``Host`` without its port."""
    if host.startswith("["):
        return host.partition("]")[0] + "]"
    return host.partition(":")[0]


def _credential(header: str) -> bytes:
    """Return the token in a header ``Authorization``; empty if there is none."""
    scheme, _, value = header.partition(" ")
    if scheme.lower() == "bearer":
        return value.strip().encode("latin-1")
    if scheme.lower() == "basic":
        with suppress(binascii.Error, ValueError):
            return base64.b64decode(value.strip(), validate=True).partition(b":")[2]
    return b""


async def _refuse(error: Refusal, send: Send) -> None:
    """Answer with an error."""
    content = json.dumps(document(error.code, error.detail)).encode()
    headers = {
        "content-type": "application/json", "content-length": str(len(content)),
        **(error.headers or {}),
    }  # fmt: skip
    await send({
        "type": "http.response.start", "status": error.status_code,
        "headers": [(name.encode(), value.encode()) for name, value in headers.items()],
    })  # fmt: skip
    await send({"type": "http.response.body", "body": content})
