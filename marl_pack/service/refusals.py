"""The one form of all errors of the service, and the reasons why it refuses a request."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from http import HTTPStatus
from typing import Any

from fastapi import HTTPException

from marl_pack.checks import one_line

CODES = {
    "not_json": (400, "the body is not JSON as it should be"),
    "unauthorized": (401, "the token is missing or wrong"),
    "foreign_host": (403, "the host in the address is not this machine's"),
    "foreign_origin": (403, "the request comes from another web site"),
    "unknown_bin": (404, "there is no such bin"),
    "not_found": (404, "there is no such page"),
    "wrong_method": (405, "the page takes other methods"),
    "exists": (409, "a bin has this id already"),
    "closed": (409, "the bin is closed"),
    "wrong_step": (409, "the bin has changed since the step that the request names"),
    "nothing_done": (409, "there is nothing to undo or to report"),
    "other_box": (409, "another box was placed last"),
    "impossible_pose": (409, "no box can be where the report says"),
    "too_many_bins": (409, "as many bins are open as may be"),
    "too_many_steps": (409, "the bin has as many changes as it may"),
    "slow": (408, "the body took too long to arrive"),
    "too_large": (413, "the body is larger than it may be"),
    "wrong_type": (415, "the body is not application/json"),
    "impossible": (422, "a value is impossible"),
    "key_reused": (422, "the idempotency key belongs to another request"),
    "internal": (500, "an error in the service"),
    "storage": (503, "the disk refused; nothing was done"),
    "unavailable": (503, "the bin cannot be made again with the options of this server"),
}
"""The status and the meaning of every code of an error."""


class Refusal(HTTPException):
    """A request is refused, and why.

    Args:
        code: a key of :data:`CODES`.
        message: one sentence for the user; by default the meaning of the code.
        headers: of the answer.
    """

    def __init__(self, code: str, message: str = "", headers: dict[str, str] | None = None) -> None:
        status, meaning = CODES[code]
        self.code = code
        super().__init__(status, one_line(message or meaning), headers)


@contextmanager
def checking_values() -> Iterator[None]:
    """Refuse a request whose values raise ValueError; the message says what would be right."""
    try:
        yield
    except (ValueError, FileNotFoundError) as error:
        message = str(error).replace("box: row 0", "the box")  # the only one of the request
        code = "impossible_pose" if message.startswith("actual: ") else "impossible"
        raise Refusal(code, message) from error


def document(code: str, message: str) -> dict[str, Any]:
    """Return the content of an error's answer."""
    return {"error": {"code": code, "message": one_line(message)}}


def code_of(status: int) -> str:
    """Return the code of an error that the web framework found."""
    codes = {404: "not_found", 405: "wrong_method", 413: "too_large", 415: "wrong_type"}
    return codes.get(status, HTTPStatus(status).phrase.lower().replace(" ", "_"))
