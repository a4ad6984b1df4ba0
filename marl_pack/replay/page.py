"""Make the replay page: HTML with everything in it, which opens without a network."""

from __future__ import annotations

import base64
import hashlib
import html
import json
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from string import Template
from typing import Any

WEB = Path(__file__).with_name("web")
SCRIPTS = ("three.bundle.js", "model.js", "scene.js", "why.js", "page.js")
"""The scripts of the page, in order; the first one is three.js (``make three``)."""


@cache
def _read(name: str) -> str:
    """Return a file of the page."""
    return (WEB / name).read_text(encoding="utf-8")


def _hash(text: str) -> str:
    """Return the hash of a script or style, as a content security policy names it."""
    digest = base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
    return f"'sha256-{digest}'"


@cache
def _policy(live: bool) -> str:
    """Return the page's content security policy: its own scripts run, and nothing is fetched.

    Args:
        live: whether the page asks the server that it comes from for news.
    """
    scripts = " ".join(_hash(_read(name)) for name in SCRIPTS)
    connect = "'self'" if live else "'none'"
    return (
        f"default-src 'none'; script-src {scripts}; style-src 'unsafe-inline'; img-src data:; "
        f"connect-src {connect}; base-uri 'none'; form-action 'none'"
    )


def make_page(document: Mapping[str, Any], live: str | None = None) -> str:
    """Return the replay page as HTML.

    Args:
        document: what :func:`marl_pack.replay.document.make_document` returned.
        live: an address on the server of the page that returns the document as JSON; the page asks
            it once a second. None for a page that does not change.
    """
    # In a script, "<" could begin a tag; in JSON it may be written like this.
    content = json.dumps(document, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")
    return Template(_read("page.html")).substitute(
        title=html.escape(document["title"] or "Replay"),
        live="" if live is None else f' data-live="{html.escape(live)}"',
        policy=html.escape(_policy(live is not None), quote=True),
        style=_read("page.css"),
        document=content,
        scripts="\n".join(f"<script>{_read(name)}</script>" for name in SCRIPTS),
    )
