"""The first page of the service: its bins, with links to their replays."""

from __future__ import annotations

import html
from collections.abc import Sequence
from string import Template

from marl_pack.service.store import BinRow

PAGE = Template("""<!doctype html>
<html lang="en"><head><meta charset="utf-8"><title>marl_pack: bins</title>
<meta name="viewport" content="width=device-width, initial-scale=1">
<style>
:root { color-scheme: light dark; }
body { font: 15px/1.5 system-ui, sans-serif; max-width: 720px; margin: 24px auto; padding: 0 16px; }
table { border-collapse: collapse; width: 100%; }
th, td { text-align: left; padding: 3px 8px; overflow-wrap: anywhere; }
</style></head>
<body><main><h1>Bins</h1><p>$text <a href="docs">All requests</a></p>
<table><thead><tr><th>bin</th><th>opened</th><th>changes</th><th>state</th></tr></thead>
<tbody>$rows</tbody></table></main></body></html>
""")


def bins_page(bins: Sequence[BinRow]) -> str:
    """Return the page as HTML.

    Args:
        bins: the bins, the last one first.
    """
    rows = [
        f'<tr><td><a href="bins/{html.escape(row.id)}/replay">{html.escape(row.id)}</a></td>'
        f"<td>{html.escape(row.opened)}</td><td>{row.step}</td>"
        f"<td>{'closed' if row.closed else 'open'}</td></tr>"
        for row in bins
    ]
    text = "The bins that were opened last; each links to its replay." if rows else "No bins yet."
    return PAGE.substitute(text=text, rows="".join(rows))
