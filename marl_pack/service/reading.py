"""Read the JSON of a request strictly: no NaN, no key twice, no text that is not Unicode."""

from __future__ import annotations

import json
from collections.abc import Callable, Coroutine, Mapping, Sequence
from typing import Any

from fastapi import Request, Response
from fastapi.routing import APIRoute

from marl_pack import renamed
from marl_pack.checks import LONGEST_TEXT, one_line, shown
from marl_pack.inputs import unique_keys
from marl_pack.service.refusals import Refusal

EXTRA = "extra_forbidden"


def read_json(content: bytes) -> Any:
    """Return what JSON in UTF-8 says.

    Raises:
        Refusal: if it is not JSON, or has NaN, Infinity, a key twice or half a character.
    """
    try:
        value = json.loads(
            content.decode(), parse_constant=_no_constant, object_pairs_hook=unique_keys
        )
        if b"\\u" in content:
            json.dumps(value, ensure_ascii=False).encode()  # half of a surrogate pair is no text
        return value
    except RecursionError:
        reason = "it is nested too deeply"
    except UnicodeError:
        reason = "it has a text that is not Unicode"
    except (json.JSONDecodeError, KeyError) as error:
        reason = one_line(str(error.args[0]), 200)
    except ValueError as error:
        constant = "NaN" in str(error) or "Infinity" in str(error)
        reason = str(error) if constant else "it has a number of thousands of digits"
    raise Refusal("not_json", f"the body is not JSON as it should be: {reason}")


def _no_constant(name: str) -> Any:
    raise ValueError(f"{name} is not a number")


class _StrictRequest(Request):
    async def json(self) -> Any:
        return read_json(await self.body())


class StrictRoute(APIRoute):
    """A route whose bodies are read by :func:`read_json`."""

    def get_route_handler(self) -> Callable[[Request], Coroutine[Any, Any, Response]]:
        """Return the function that answers a request."""
        handler = super().get_route_handler()

        async def handle(request: Request) -> Response:
            return await handler(_StrictRequest(request.scope, request.receive))

        return handle


NEEDS = {
    "tuple_type": "needs a list of numbers",
    "list_type": "needs a list",
    "string_pattern_mismatch": "needs letters, digits, _, . and -, at most 64, and no . or - first",
}
"""What a value needs, by the type of the error."""


def describe(errors: Sequence[Mapping[str, Any]], names: Sequence[str]) -> str:
    """Return one sentence for the errors that the check of a request found.

    Args:
        errors: those of pydantic.
        names: the keys of the body that are valid.
    """
    first = errors[0]
    _, *path = first["loc"]  # after body, query, path or header
    # A union adds the names of its types, which mean nothing to a client.
    where = ".".join(str(part) for k, part in enumerate(path) if k == 0 or isinstance(part, int))
    if first["type"] == EXTRA:
        return f"unknown key {shown(where)}{renamed.guess(where, names)}"
    if first["type"] == "missing":
        return f"{where or 'body'}: is missing"
    message = NEEDS.get(first["type"], first["msg"][:1].lower() + first["msg"][1:])
    return f"{where or 'body'}: {message}, not {_as_json(first.get('input'))}"


def _as_json(value: Any) -> str:
    """Return a value for a message as the client wrote it."""
    try:
        return one_line(json.dumps(value, ensure_ascii=False), LONGEST_TEXT)
    except ValueError:  # an int of more digits than Python writes
        return shown(value)
