"""One self-contained HTML page to look at a comparison: no network, no other file."""

import base64
import json
from collections.abc import Iterable
from importlib.resources import files
from typing import Any

import numpy as np
from jaxtyping import UInt8

from cvtgs.evaluation.compare import Comparison
from cvtgs.evaluation.images import (
    ALPHA_SCALE,
    CSS_ALPHA_GRADIENT,
    CSS_GRADIENT,
    ERROR_SCALE,
    alpha_error_map,
    encode,
    error_map,
    resized,
)

MOST_BYTES = 7_500_000
"""Pages are kept below this: images are compressed harder, and then made smaller."""

_TRIES = ((84, 1.0), (72, 1.0), (55, 1.0), (55, 0.7), (45, 0.5), (35, 0.35), (30, 0.25))


def comparison_page(
    comparison: Comparison,
    *,
    summary: str = "",
    viewer: str = "",
    most_bytes: int = MOST_BYTES,
) -> str:
    """Return the page, with a summary of :func:`render_template` above the images.

    It links to a page with the scenes in 3D, if there is one beside it.

    It has a divider between the full and a simplified scene, a chooser of scene and view, counts,
    bytes and scores, and maps of the differences of colour and of alpha.
    ``#view=2&small=1&split=30&error=1`` at the end of its address chooses what it shows first;
    ``error=2`` is alpha.
    """
    parts = files("cvtgs.evaluation") / "page_parts"
    texts = {
        name: (parts / f"page.{name}").read_text(encoding="utf-8").strip()
        for name in ("html", "css", "js")
    }
    page = ""
    for quality, factor in _TRIES:
        page = render_template(
            texts["html"],
            title=f"{comparison.evaluation.reference}: before and after",
            style=texts["css"],
            script=texts["js"],
            gradient=CSS_GRADIENT,
            error_scale=f"{ERROR_SCALE:g}",
            alpha_gradient=CSS_ALPHA_GRADIENT,
            alpha_scale=f"{ALPHA_SCALE:g}",
            summary=summary,
            viewer=viewer,
            data=_page_data(comparison, quality, factor),
        )
        if len(page) <= most_bytes:
            break
    return page


def render_template(template: str, **values: Any) -> str:
    """Fill in an HTML template of Jinja; values are escaped unless it marks them as safe."""
    from jinja2 import Environment, StrictUndefined  # noqa: PLC0415 (takes time to load)

    environment = Environment(
        autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    environment.policies["json.dumps_kwargs"] = {"allow_nan": False, "separators": (",", ":")}
    return environment.from_string(template).render(values)


def _page_data(comparison: Comparison, quality: int, factor: float) -> dict[str, Any]:
    """Return what the script of the page reads."""
    evaluation = comparison.evaluation
    small = []
    for scores in evaluation.scenes:
        full, images = comparison.full, comparison.small[scores.name]
        maps = {
            "errors": map(error_map, full.colors, images.colors),
            "alpha_errors": map(alpha_error_map, full.alphas, images.alphas),
        }
        small.append(
            {
                **json.loads(scores.model_dump_json()),  # which writes infinity as text
                "bytes": comparison.sizes.get(scores.name),
                "images": _data_urls(images.colors, quality, factor),
                **{name: _data_urls(part, quality - 10, factor) for name, part in maps.items()},
            }
        )
    return {
        "backend": evaluation.backend,
        "width": evaluation.width,
        "height": evaluation.height,
        "lpips": evaluation.lpips_network,
        "views": comparison.views,
        "shown": comparison.shown,
        "scored": len(evaluation.views),
        "reference": {
            "name": evaluation.reference,
            "count": evaluation.reference_count,
            "bytes": comparison.sizes.get(evaluation.reference),
        },
        "full": _data_urls(comparison.full.colors, quality, factor),
        "small": small,
    }


def _data_urls(
    images: Iterable[UInt8[np.ndarray, "h w 3"]], quality: int, factor: float
) -> list[str]:
    urls = []
    for image in images:
        height, width, _ = image.shape
        size = max(1, round(factor * width)), max(1, round(factor * height))
        content = encode(resized(image, size), "webp", quality=quality)
        urls.append("data:image/webp;base64," + base64.b64encode(content).decode())
    return urls
