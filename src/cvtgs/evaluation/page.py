"""One self-contained HTML page to look at a comparison: no network, no other file."""

import base64
import html
import json
from collections.abc import Iterable, Iterator
from importlib.resources import files
from typing import Any

import numpy as np
from jaxtyping import UInt8

from cvtgs.evaluation.compare import Comparison, Images
from cvtgs.evaluation.error_maps import ERROR_SCALE, css_gradient, error_map
from cvtgs.evaluation.images import encode, resized
from cvtgs.evaluation.scores import SceneScores

MOST_BYTES = 7_500_000
"""Pages are kept below this: images are compressed harder, and then made smaller."""

_TRIES = ((84, 1.0), (72, 1.0), (55, 1.0), (55, 0.7), (45, 0.5), (35, 0.35), (30, 0.25))


def comparison_page(
    comparison: Comparison, *, foreword: str = "", most_bytes: int = MOST_BYTES
) -> str:
    """Write the page.

    It has a divider between the full and a simplified scene, a chooser of scene and view, counts,
    bytes and scores, and maps of the differences. ``#view=2&small=1&split=30&error=1`` at the end
    of its address chooses what it shows first.
    """
    page = ""
    for quality, factor in _TRIES:
        page = _page(comparison, quality, factor, foreword=foreword)
        if len(page) <= most_bytes:
            break
    return page


def _page(comparison: Comparison, quality: int, factor: float, *, foreword: str) -> str:
    title = html.escape(f"{comparison.evaluation.reference}: before and after")
    parts = {
        "TITLE": title,
        "STYLE": _part("page.css"),
        "GRADIENT": css_gradient(),
        "ERROR_SCALE": f"{ERROR_SCALE:g}",
        "SCRIPT": _part("page.js"),
        "SHEET": "" if foreword else " The same images are in sheet.png, next to it.",
        "FOREWORD": foreword,
        "DATA": _for_script(_data(comparison, quality, factor)),
    }
    page = _part("page.html")
    for name, content in parts.items():  # the data, which may hold anything, comes last
        page = page.replace("{{" + name + "}}", content)
    return page


def _part(name: str) -> str:
    return (files("cvtgs.evaluation") / "page_parts" / name).read_text(encoding="utf-8").strip()


def _for_script(data: dict[str, Any]) -> str:
    """Write JSON that cannot end the script element that holds it."""
    return json.dumps(data, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")


def _data(comparison: Comparison, quality: int, factor: float) -> dict[str, Any]:
    evaluation = comparison.evaluation
    return {
        "backend": evaluation.backend,
        "width": evaluation.width,
        "height": evaluation.height,
        "lpips": evaluation.lpips_network,
        "views": evaluation.views,
        "reference": {
            "name": evaluation.reference,
            "count": evaluation.reference_count,
            "bytes": comparison.sizes.get(evaluation.reference),
        },
        "full": list(_addresses(comparison.full, quality, factor)),
        "small": [_small(comparison, scores, quality, factor) for scores in evaluation.scenes],
    }


def _small(
    comparison: Comparison, scores: SceneScores, quality: int, factor: float
) -> dict[str, Any]:
    images = comparison.small[scores.name]
    return {
        **json.loads(scores.model_dump_json()),  # which writes infinity as text
        "bytes": comparison.sizes.get(scores.name),
        "images": list(_addresses(images, quality, factor)),
        "errors": list(_addresses(_errors(comparison.full, images), quality - 10, factor)),
    }


def _errors(full: Images, small: Images) -> Iterator[UInt8[np.ndarray, "h w 3"]]:
    return (error_map(one, other) for one, other in zip(full, small, strict=True))


def _addresses(
    images: Iterable[UInt8[np.ndarray, "h w 3"]], quality: int, factor: float
) -> Iterator[str]:
    for image in images:
        height, width, _ = image.shape
        size = max(1, round(factor * width)), max(1, round(factor * height))
        content = encode(resized(image, size), "webp", quality=quality)
        yield "data:image/webp;base64," + base64.b64encode(content).decode()
