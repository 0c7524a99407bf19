"""The files that `cvtgs compare` writes: a page, a sheet of images and scores, and error maps."""

import base64
import json
import math
import os
from collections.abc import Callable, Sequence
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from jaxtyping import UInt8

from cvtgs.evaluation.compare import Comparison, Images
from cvtgs.evaluation.images import (
    ALPHA_SCALE,
    CSS_ALPHA_GRADIENT,
    CSS_GRADIENT,
    ERROR_SCALE,
    alpha_colors,
    alpha_error_map,
    encode,
    error_colors,
    error_map,
    resized,
)
from cvtgs.evaluation.scorer import SceneScores, Score
from cvtgs.io.atomic import check_outputs, write_atomically
from cvtgs.progress import ProgressEvent, ProgressListener, silent
from cvtgs.text import counted, size_text

if TYPE_CHECKING:
    from PIL.Image import Image
    from PIL.ImageFont import FreeTypeFont, ImageFont

PAGE, SHEET, ERRORS = "index.html", "sheet.png", "errors.png"
STAGE = "write pages"

_PAPER, _INK, _FADED = (250, 250, 249), (28, 28, 30), (110, 110, 115)
_LONGEST_TILE, _SHEET_WIDTH = 360, 2800
_GAP, _MARGIN, _SIDE, _HEAD, _FOOT = 8, 28, 260, 44, 84
_COLUMN = 90  # least width of a column, for its caption, and longer side of a reduced image
_RAMP, _APART = (340, 14), 100
_NAME, _TEXT = 20, 15

MOST_BYTES = 7_500_000  # of a page; to meet it, images are compressed more, then made smaller
_TRIES = ((84, 1.0), (72, 1.0), (55, 1.0), (55, 0.7), (45, 0.5), (35, 0.35), (30, 0.25))


def check_comparison_files(folder: str | os.PathLike[str], *, overwrite: bool = False) -> None:
    """Make the folder and check that the files can be written, before the work starts."""
    check_outputs(folder, (PAGE, SHEET, ERRORS), overwrite=overwrite)


def write_comparison(
    comparison: Comparison,
    folder: str | os.PathLike[str],
    *,
    overwrite: bool = False,
    viewer: str = "",
    listener: ProgressListener = silent,
) -> tuple[Path, ...]:
    """Write ``index.html``, ``sheet.png`` and ``errors.png``, each completely or not at all.

    Args:
        comparison: Images and scores.
        folder: The output folder; created if missing.
        overwrite: Whether existing files may be replaced.
        viewer: File name of a page with the scenes in 3D to link to, in the folder; or empty.
        listener: Called before the first file and after each.

    Returns:
        The paths of the files.

    Raises:
        OutputExistsError: A file exists and may not be replaced.
        OutputError: A file cannot be written.

    Example:
        >>> import tempfile
        >>> from cvtgs.evaluation import compare
        >>> from cvtgs.views import automatic_views
        >>> from cvtgs.synthetic import scene as make
        >>> scene = make("object", 300, sh_degree=0)
        >>> views = automatic_views(scene, 2, width=32, height=24)
        >>> comparison = compare(scene, {"same": scene}, views)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     [path.name for path in write_comparison(comparison, folder)]
        ['sheet.png', 'errors.png', 'index.html']
    """
    check_comparison_files(folder, overwrite=overwrite)
    makers: dict[str, Callable[[], bytes]] = {
        SHEET: lambda: encode(contact_sheet(comparison), "png"),
        ERRORS: lambda: encode(error_sheet(comparison), "png"),
        PAGE: lambda: comparison_page(comparison, viewer=viewer).encode(),
    }
    listener(ProgressEvent(stage=STAGE, done=0, total=len(makers)))
    paths = tuple(Path(folder) / name for name in makers)
    for done, (path, make) in enumerate(zip(paths, makers.values(), strict=True), start=1):
        write_atomically(path, make(), overwrite=overwrite)
        listener(ProgressEvent(stage=STAGE, done=done, total=len(makers)))
    return paths


class _Row(NamedTuple):
    """A row of a sheet: a name with lines of text, and an image per view."""

    name: str
    lines: Sequence[str]
    images: Images
    captions: Sequence[str] = ()


def contact_sheet(comparison: Comparison) -> UInt8[np.ndarray, "y x 3"]:
    """Draw all views of all scenes: a row per scene, the full one first; a column per view."""
    evaluation = comparison.evaluation
    size = _size_text(comparison, evaluation.reference)
    full = [counted(evaluation.reference_count, "Gaussian"), size]
    rows = [_Row(evaluation.reference, full, comparison.full.colors)]
    rows += [
        _small_row(comparison, scores, comparison.small[scores.name].colors)
        for scores in evaluation.scenes
    ]
    return _draw_sheet(comparison, rows)


def error_sheet(comparison: Comparison) -> UInt8[np.ndarray, "y x 3"]:
    """Draw a row of colour errors and one of alpha errors for each simplified scene."""
    rows = []
    for scores in comparison.evaluation.scenes:
        colors, alphas = error_maps(comparison, scores.name)
        rows.append(_small_row(comparison, scores, colors))
        if scores.alpha_error and scores.alpha_bias:
            lines = [
                "Alpha minus that of the full scene",
                f"error {scores.alpha_error.mean:.4f}",
                f"bias {scores.alpha_bias.mean:+z.4f}",
            ]
            views = scores.alpha_error.views
            captions = [f"error {views[view]:.4f}" for view in comparison.shown]
            rows.append(_Row("", lines, alphas, captions))
    return _draw_sheet(comparison, rows, legend=True)


def error_maps(comparison: Comparison, name: str) -> tuple[Images, Images]:
    """Return maps of the colour errors and the alpha errors of a simplified scene."""
    full, small = comparison.full, comparison.small[name]
    colors = map(error_map, full.colors, small.colors)
    return np.stack(list(colors)), np.stack(list(map(alpha_error_map, full.alphas, small.alphas)))


def _small_row(comparison: Comparison, scores: SceneScores, images: Images) -> _Row:
    lines = [
        counted(scores.count, "Gaussian"),
        _ratio_text(comparison.ratio(scores)),
        _size_text(comparison, scores.name),
        f"PSNR {_mean_psnr_text(scores.psnr, comparison.evaluation.blind)}",
        f"SSIM {scores.ssim.mean:.3f}",
        f"LPIPS {scores.lpips.mean:.3f}" if scores.lpips else "",
        f"alpha error {scores.alpha_error.mean:.4f}" if scores.alpha_error else "",
        f"alpha bias {scores.alpha_bias.mean:+z.4f}" if scores.alpha_bias else "",
    ]
    captions = [_psnr_text(scores.psnr.views[view]) for view in comparison.shown]
    return _Row(scores.name, lines, images, captions)


def _draw_sheet(
    comparison: Comparison, rows: Sequence[_Row], *, legend: bool = False
) -> UInt8[np.ndarray, "y x 3"]:
    """Draw rows of images with their texts, below a header of view names."""
    from PIL import Image, ImageDraw, ImageFont  # noqa: PLC0415 (takes time to load)

    views, height, width, _ = comparison.full.colors.shape
    longest = min(_LONGEST_TILE, max(_COLUMN, (_SHEET_WIDTH - _SIDE) / views - _GAP))
    factor = min(1.0, longest / max(width, height))
    tile = max(1, round(factor * width)), max(1, round(factor * height))
    line = 1.45 * _TEXT
    row_height = max(tile[1] + round(1.6 * _TEXT), round(9.5 * line)) + _GAP
    column = max(tile[0], _COLUMN)
    lefts = [_MARGIN + _SIDE + view * (column + _GAP) for view in range(views + 1)]
    bottom = _MARGIN + _HEAD + len(rows) * row_height
    right = max(lefts[-1], lefts[0] + legend * (2 * _RAMP[0] + _APART))
    size = right + _MARGIN, bottom + _MARGIN + legend * _FOOT
    sheet = Image.new("RGB", size, _PAPER)
    draw = ImageDraw.Draw(sheet)
    large, small = ImageFont.load_default(_NAME), ImageFont.load_default(_TEXT)
    for left, view in zip(lefts, comparison.views, strict=False):
        draw.text((left, _MARGIN), _shortened(view, column, small), _FADED, small)
    for number, row in enumerate(rows):
        top = _MARGIN + _HEAD + number * row_height
        draw.text((_MARGIN, top), _shortened(row.name, _SIDE - 20, large), _INK, large)
        for place, text in enumerate(filter(None, row.lines)):
            draw.text((_MARGIN, top + 1.5 * _NAME + place * line), text, _FADED, small)
        for left, image in zip(lefts, row.images, strict=False):
            sheet.paste(Image.fromarray(resized(image, tile)), (left, top))
        for left, caption in zip(lefts, row.captions, strict=False):
            draw.text((left, top + tile[1] + 4), caption, _FADED, small)
    if legend:
        _draw_legends(sheet, lefts[0], bottom + 16, small)
    return np.asarray(sheet)


def _draw_legends(sheet: "Image", left: int, top: int, font: "FreeTypeFont | ImageFont") -> None:
    """Draw both colour ramps with their numbers, side by side."""
    from PIL import Image, ImageDraw  # noqa: PLC0415

    draw, (width, height) = ImageDraw.Draw(sheet), _RAMP
    steps = np.linspace(0, 1, width, dtype=np.float32)[None].repeat(height, axis=0)
    below = "Difference of alpha (below 0: more background)"
    ramps = (
        ("RMS difference of colour", 0.0, ERROR_SCALE, error_colors),
        (below, -ALPHA_SCALE, ALPHA_SCALE, alpha_colors),
    )
    for place, (title, low, high, colors) in enumerate(ramps):
        start = left + place * (width + _APART)
        sheet.paste(Image.fromarray(colors(low + (high - low) * steps)), (start, top + 20))
        draw.text((start, top - 4), title, _INK, font)
        for share in (0.0, 0.5, 1.0):
            text = f"{low + share * (high - low):.2g}"
            shift = share * font.getlength(text)
            draw.text((start + share * width - shift, top + 24 + height), text, _FADED, font)


def _shortened(text: str, width: int, font: "FreeTypeFont | ImageFont") -> str:
    """Shorten a text in the middle to fit a width, pixels."""
    shown = text
    while len(shown) > 4 and font.getlength(shown) > width:
        keep = len(shown) - 2
        shown = f"{text[: keep // 2]}…{text[-(keep - keep // 2 - 1) :]}"
    return shown


def _psnr_text(value: float) -> str:
    return "equal" if math.isinf(value) else f"{value:.2f} dB"


def _mean_psnr_text(psnr: Score, blind: Sequence[int] = ()) -> str:
    """Return the mean; if only some of the views that count are equal, that of the others."""
    counted_ones = [value for view, value in enumerate(psnr.views) if view not in blind]
    finite = [value for value in counted_ones if math.isfinite(value)]
    if math.isfinite(psnr.mean) or not finite:
        return _psnr_text(psnr.mean)
    equal = len(counted_ones) - len(finite)
    return f"{_psnr_text(Score.of(finite).mean)}, {equal} equal"


def _size_text(comparison: Comparison, name: str) -> str:
    return size_text(comparison.sizes[name]) if name in comparison.sizes else ""


def _ratio_text(ratio: float) -> str:
    if abs(ratio - 1) < 0.005:
        return "as many"
    factor, word = (ratio, "fewer") if ratio > 1 else (1 / ratio, "more")
    return f"{factor:,.0f} times {word}" if factor >= 10 else f"{factor:.3g} times {word}"


def comparison_page(
    comparison: Comparison,
    *,
    summary: str = "",
    viewer: str = "",
    topic: str = "Before and after",
    is_named: bool = False,
    most_bytes: int = MOST_BYTES,
) -> str:
    """Return the HTML page, with ``summary`` (made by :func:`render_template`) above the images.

    Cards of scenes are headed by ratios unless ``is_named``; ``viewer`` is a page to link to.
    """
    parts = files("cvtgs.evaluation") / "page_parts"
    texts = {
        name: (parts / f"page.{name}").read_text(encoding="utf-8").strip()
        for name in ("html", "css", "js")
    }
    for quality, factor in _TRIES:
        page = render_template(
            texts["html"],
            title=f"{comparison.evaluation.reference}: {topic.lower()}",
            topic=topic,
            style=texts["css"],
            script=texts["js"],
            gradient=CSS_GRADIENT,
            error_scale=f"{ERROR_SCALE:g}",
            alpha_gradient=CSS_ALPHA_GRADIENT,
            alpha_scale=f"{ALPHA_SCALE:g}",
            summary=summary,
            viewer=viewer,
            data=_page_data(comparison, quality, factor) | {"named": is_named},
        )
        if len(page) <= most_bytes:
            break
    return page


def render_template(template: str, **values: Any) -> str:
    """Render a Jinja HTML template; values are escaped unless the template marks them as safe."""
    from jinja2 import Environment, StrictUndefined  # noqa: PLC0415 (takes time to load)

    environment = Environment(
        autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    environment.policies["json.dumps_kwargs"] = {"allow_nan": False, "separators": (",", ":")}
    return environment.from_string(template).render(values)


def _page_data(comparison: Comparison, quality: int, factor: float) -> dict[str, Any]:
    """Return the data for the script of the page."""
    evaluation = comparison.evaluation
    small = []
    for scores in evaluation.scenes:
        errors, alpha_errors = error_maps(comparison, scores.name)
        images = comparison.small[scores.name].colors
        small.append(
            {
                **json.loads(scores.model_dump_json()),  # encodes infinity as a string
                "bytes": comparison.sizes.get(scores.name),
                "images": _data_urls(images, quality, factor),
                "errors": _data_urls(errors, quality - 10, factor),
                "alpha_errors": _data_urls(alpha_errors, quality - 10, factor),
            }
        )
    return {
        "backend": evaluation.backend,
        "width": evaluation.width,
        "height": evaluation.height,
        "lpips": evaluation.lpips_network,
        "views": comparison.views,
        "shown": comparison.shown,
        "blind": evaluation.blind,
        "scored": evaluation.view_count,
        "reference": {
            "name": evaluation.reference,
            "count": evaluation.reference_count,
            "bytes": comparison.sizes.get(evaluation.reference),
        },
        "full": _data_urls(comparison.full.colors, quality, factor),
        "small": small,
    }


def _data_urls(images: Images, quality: int, factor: float) -> list[str]:
    urls = []
    for image in images:
        height, width, _ = image.shape
        size = max(1, round(factor * width)), max(1, round(factor * height))
        content = encode(resized(image, size), "webp", quality=quality)
        urls.append("data:image/webp;base64," + base64.b64encode(content).decode())
    return urls
