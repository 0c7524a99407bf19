"""What stands on the page above the images: the plot and the table."""

import base64
import html
from collections.abc import Iterable

from cvtgs.tradeoff.results import Tradeoff
from cvtgs.tradeoff.table import MARK, MARK_MEANS, cells, heading, how_measured


def foreword(tradeoff: Tradeoff, chart: bytes | None) -> str:
    """Write the plot and the table."""
    return (
        '<section class="tradeoff">\n<h2>What more time buys</h2>\n'
        + ("" if chart is None else _image(chart))
        + '<div class="scroller"><table id="tradeoff">\n'
        + "".join(_groups(tradeoff))
        + "</table></div>\n"
        + f'<p class="note">{html.escape(MARK_MEANS)}. {html.escape(how_measured(tradeoff))}</p>\n'
        + "".join(
            f'<p class="note">{html.escape(failure.name)} failed: {html.escape(failure.reason)}'
            "</p>\n"
            for failure in tradeoff.failures
        )
        + "</section>"
    )


def _image(chart: bytes) -> str:
    address = "data:image/png;base64," + base64.b64encode(chart).decode()
    text = "PSNR and SSIM over seconds, a line per ratio; the table has the same numbers"
    return f'<img class="chart" src="{address}" alt="{text}">\n'


def _groups(tradeoff: Tradeoff) -> Iterable[str]:
    headings = list(cells(tradeoff, tradeoff.results[0]))
    yield f"<thead>{_row('th', headings)}</thead>\n"
    for rho in tradeoff.ratios:
        rows = [cells(tradeoff, result) for result in tradeoff.results if result.rho == rho]
        title = html.escape(heading(tradeoff, rho))
        yield f'<tbody><tr><th class="group" colspan="{len(headings)}">{title}</th></tr>\n'
        for row in rows:
            yield _row("td", [row[name].strip() for name in headings]) + "\n"
        yield "</tbody>\n"


def _row(kind: str, words: Iterable[str]) -> str:
    first, *others = (html.escape(word) for word in words)
    rest = "".join(f"<{kind}{_look(word)}>{word}</{kind}>" for word in others)
    return f"<tr><th>{first}</th>{rest}</tr>"


def _look(word: str) -> str:
    return ' class="best"' if word.endswith(MARK) else ""
