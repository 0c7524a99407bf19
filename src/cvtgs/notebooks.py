"""HTML representations of scenes and results for notebooks: an image and facts."""

import base64
import html
from collections.abc import Mapping

import torch

from cvtgs.errors import CvtgsError
from cvtgs.evaluation.images import as_bytes, encode
from cvtgs.rendering import render
from cvtgs.report import Simplified
from cvtgs.scene import GaussianScene
from cvtgs.tags import described_tags
from cvtgs.text import size_text
from cvtgs.views import automatic_views

WIDTH, HEIGHT = 320, 240
MOST_DRAWN = 200_000  # the heaviest of larger scenes, so that a cell takes about a second


def scene_html(scene: GaussianScene) -> str:
    """Return HTML with an image of a scene beside its facts."""
    return _panel("GaussianScene", scene, _scene_facts(scene))


def result_html(result: Simplified) -> str:
    """Return HTML with an image of a simplified scene beside facts about the simplification."""
    scene, report = result
    facts = {
        "Gaussians": f"{report.input_count:,} &rarr; {report.output_count:,}",
        "seconds": f"{report.seconds:.2f}",
        "preset": html.escape(report.config.preset),
        "checkpoint": html.escape(report.checkpoint),
    }
    if report.refinement is not None:
        facts["refined"] = f"{report.refinement.gain:+.2f} dB in {report.refinement.steps:,} steps"
    if report.shortfall:
        facts["fewer than asked for"] = html.escape(report.shortfall)
    rest = {name: text for name, text in _scene_facts(scene).items() if name not in facts}
    return _panel("Simplified", scene, facts | rest)


def _scene_facts(scene: GaussianScene) -> dict[str, str]:
    """Return facts about a scene, as HTML, by name."""
    tensors = [*scene.tensors().values(), *scene.extras.values()]
    size = sum(tensor.numel() * tensor.element_size() for tensor in tensors)
    facts = {
        "Gaussians": f"{len(scene):,}",
        "SH degree": f"{scene.sh_degree}",
        "memory": f"{size_text(size)}, {str(scene.dtype).removeprefix('torch.')}",
        "device": str(scene.device),
    }
    if tags := described_tags(scene.comments):
        facts["tags"] = tags
    if scene.extras:
        facts["extra columns"] = html.escape(", ".join(scene.extras))
    return facts


def _panel(title: str, scene: GaussianScene, facts: Mapping[str, str]) -> str:
    rows = "".join(
        f'<tr><th style="text-align:left">{html.escape(name)}</th>'
        f'<td style="text-align:left">{text}</td></tr>'
        for name, text in facts.items()
    )
    image, caption = _image(scene)
    note = f'<div style="opacity:.7">{caption}</div>' if caption else ""
    return (
        f'<div style="display:flex;gap:16px;align-items:center">{image}<div><b>{title}</b>'
        f'<table style="margin:4px 0">{rows}</table>{note}</div></div>'
    )


def _image(scene: GaussianScene) -> tuple[str, str]:
    """Return the HTML of an image, empty if none can be made, and a note for below the facts."""
    if len(scene) > MOST_DRAWN:
        drawn = scene.select(torch.topk(scene.masses.nan_to_num(), MOST_DRAWN).indices)
        caption = f"drawn: the {MOST_DRAWN:,} heaviest"
    else:
        drawn, caption = scene, ""
    try:
        cameras = automatic_views(drawn, 1, width=WIDTH, height=HEIGHT)
        with torch.no_grad():
            pixels = as_bytes(render(drawn, cameras).rgb[0])
    except CvtgsError as error:
        return "", html.escape(f"no image: {error}")
    data = base64.b64encode(encode(pixels, "png")).decode("ascii")
    size = f'width="{WIDTH}" height="{HEIGHT}"'
    return f'<img src="data:image/png;base64,{data}" {size} alt="an automatic view">', caption
