"""Tables that Jupyter shows in place of a `repr`."""

from __future__ import annotations

from collections.abc import Mapping
from html import escape


def notebook_table(title: str, rows: Mapping[str, object]) -> str:
    """A table of names and values as HTML, without style or script of its own; everything is escaped.

    Examples
    --------
    >>> notebook_table("Scene <1>", {"points": 7})
    '<table><caption>Scene &lt;1&gt;</caption><tr><th>points</th><td>7</td></tr></table>'
    """
    body = "".join(f"<tr><th>{escape(name)}</th><td>{escape(str(value))}</td></tr>" for name, value in rows.items())
    return f"<table><caption>{escape(title)}</caption>{body}</table>"
