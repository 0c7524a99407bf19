"""PSNR, SSIM and LPIPS against the full scene, for every preset or for single choices.

``python -m benchmarks.quality`` scores the presets on generated scenes with cvtgs' own renderer and
views. For your own scenes, name the files; cameras beside a file (``benchmarks.cameras``) are used.
For LPIPS give ``--lpips WEIGHTS``. For another scorer give ``--scorer
"python score.py --json {full} {small}"``; it gets the full scene and the simplified ones, and
prints a JSON list in the same order, of objects with ``psnr``, ``ssim`` and optionally ``lpips``.
For one scene with cameras give ``--cameras CAPTURE``; ``--images DIR`` scores against photographs.

``--choices`` instead changes one choice of ``standard`` at a time; ``--set merge.network=false``
measures the choices without the network, which was trained with all of them unchanged.
"""

import argparse
import json
import shlex
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import mean
from typing import NamedTuple, Self

from jaxtyping import Float
from torch import Tensor

import cvtgs
from benchmarks.cameras import cameras_beside, cameras_file
from benchmarks.measuring import digest_of, filled, names_of, run, settings_of
from cvtgs.cameras import Cameras
from cvtgs.errors import FileFormatError
from cvtgs.evaluation import (
    EvaluationSettings,
    LpipsWeights,
    SceneScores,
    fit_cameras,
    load_lpips,
    load_photographs,
    scorer as scorers,
)
from cvtgs.views import automatic_views

VIEWS = 8
SIZE = 400
"""Number of automatic views, and their width and height in pixels, for the own renderer."""

BACKGROUNDS = {"black": (0.0, 0.0, 0.0), "gray": (0.5, 0.5, 0.5), "white": (1.0, 1.0, 1.0)}
RATIOS = (0.1, 0.01, 0.001)
MEAN = "mean"
SCORES = ("psnr", "ssim", "lpips", "alpha_error", "alpha_bias")


@dataclass(frozen=True, slots=True, kw_only=True)
class Quality:
    """Scores of the images of a simplified scene against those of the full one.

    Attributes:
        psnr: dB.
        ssim: At most 1.
        lpips: At least 0, lower is better; None if not measured.
        alpha_error: Mean absolute difference of alpha, lower is better; None if not measured.
        alpha_bias: Mean of alpha minus that of the full scene; None if not measured.
    """

    psnr: float
    ssim: float
    lpips: float | None = None
    alpha_error: float | None = None
    alpha_bias: float | None = None

    @classmethod
    def of(cls, scores: SceneScores) -> Self:
        """Make a quality of the means of an evaluation."""
        return cls(**scores.means())


Simplify = Callable[[cvtgs.GaussianScene, float], cvtgs.GaussianScene]
"""Function of a scene and the ratio to keep."""

Scorer = Callable[[cvtgs.GaussianScene, Sequence[cvtgs.GaussianScene]], list[Quality]]
"""Function of the full scene and simplified ones."""

Table = Mapping[str, Mapping[str, Sequence[Quality]]]
"""One quality per ratio, by name of the scene and name of the variant."""


def scoring_parser(description: str | None) -> argparse.ArgumentParser:
    """Make a parser with options for scenes, ratios and scorers."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("files", nargs="*", type=Path, help="scenes; generated ones if none")
    parser.add_argument("--rho", type=float, nargs="+", default=list(RATIOS))
    parser.add_argument("--count", type=int, default=100_000, help="size of generated scenes")
    parser.add_argument("--means", action="store_true", help="print means only")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    judges = parser.add_mutually_exclusive_group()
    judges.add_argument(
        "--scorer", help="command with {full} and {small}; prints a JSON list with psnr and ssim"
    )
    judges.add_argument("--lpips", type=Path, help="weights file; also measure LPIPS")
    parser.add_argument(
        "--cameras", type=Path, help="cameras of a single scene, as cvtgs reads them"
    )
    parser.add_argument(
        "--size", type=int, metavar="PIXELS",
        help="longer side of the images; not with --scorer or --cameras",
    )  # fmt: skip
    parser.add_argument("--split", choices=("train", "test"), help="part of --cameras to use")
    parser.add_argument(
        "--images", type=Path, metavar="DIR", help="photographs of --cameras, to score against"
    )
    parser.add_argument(
        "--background", choices=BACKGROUNDS, default="black", help="of scenes and of --images"
    )
    return parser


def configuration(options: argparse.Namespace, settings: Mapping[str, str]) -> cvtgs.SimplifyConfig:
    """Compose a configuration of the command line and ``settings`` (``preset`` too), which win."""
    values = {**settings_of(options.set), **settings}
    return cvtgs.SimplifyConfig.compose(preset=values.pop("preset", None), settings=values)


def variants_of(
    options: argparse.Namespace, table: Mapping[str, Mapping[str, str]]
) -> dict[str, Simplify]:
    """Return a simplifier for every row of settings."""
    return {
        name: cvtgs.Simplifier(config=configuration(options, settings)).simplify
        for name, settings in table.items()
    }


def measure(variants: Mapping[str, Simplify], options: argparse.Namespace) -> Iterator[Table]:
    """Score every variant on every scene; yield the table so far after each scene."""
    table: dict[str, dict[str, list[Quality]]] = {}
    for name, scene in scenes(options.files, options.count):
        file = options.files[len(table)] if options.files else None
        score = make_scorer(options, file)
        small = [simplify(scene, rho) for simplify in variants.values() for rho in options.rho]
        found = iter(score(scene, small))
        table[name] = {variant: [next(found) for _ in options.rho] for variant in variants}
        print(f"scored {name}: {len(scene)} Gaussians, {len(small)} small scenes", file=sys.stderr)
        yield dict(table)


def scenes(files: Sequence[Path], count: int) -> Iterator[tuple[str, cvtgs.GaussianScene]]:
    """Yield names and scenes of the files, or one generated scene of each kind."""
    for name, file in zip(names_of(files), files, strict=True):
        yield name, cvtgs.load(file)
    for seed, kind in enumerate(() if files else cvtgs.synthetic.KINDS):
        yield kind, cvtgs.synthetic.scene(kind, count, sh_degree=1, seed=seed)


def make_scorer(options: argparse.Namespace, file: Path | None) -> Scorer:
    """Make the scorer that the options ask for, for the scene of a file or a generated one."""
    if options.size is not None and (options.scorer or options.cameras is not None):
        raise SystemExit("--size cannot be used with --scorer or --cameras.")
    if options.scorer:
        return command_scorer(options.scorer)
    weights = None if options.lpips is None else any_lpips(options.lpips)
    background = BACKGROUNDS[options.background]
    if options.cameras is not None:
        return given_scorer(options, weights, background)
    if options.images is not None:
        raise SystemExit("--images needs the cameras of the photographs: --cameras.")
    beside = file is not None and cameras_file(file).is_file()
    cameras = cameras_beside(file, size=options.size) if file and beside else None
    return own_scorer(weights, cameras, background=background, size=options.size or SIZE)


def judge_of(options: argparse.Namespace, files: Sequence[Path]) -> str:
    """Describe the scorer of some files (none for generated scenes) that the options ask for."""
    if options.scorer:
        return f"the command {options.scorer}"
    side = options.size or SIZE
    automatic = f"{VIEWS} automatic views of {side} x {side} pixels"
    if options.cameras is not None:
        part = f" ({options.split})" if options.split else ""
        cameras = f"the cameras of {options.cameras}{part}"
        cameras += f" against the photographs in {options.images}" if options.images else ""
    elif not any(cameras_file(file).is_file() for file in files):
        cameras = automatic
    else:
        cameras = "cameras beside the scenes"
        cameras += f" at {side} pixels" if options.size is not None else ""
        if not all(cameras_file(file).is_file() for file in files):
            cameras += f", {automatic} where there are none"
    judge = f"cvtgs' own renderer, {cameras}, over {options.background}"
    if options.lpips is None:
        return judge
    network, digest = any_lpips(options.lpips).network, digest_of(options.lpips)
    return f"{judge}, LPIPS of {network} ({digest[:12]})"


def given_scorer(
    options: argparse.Namespace, weights: LpipsWeights | None, background: scorers.Color
) -> Scorer:
    """Return a scorer from given cameras, against the full scene or against photographs."""
    if len(options.files) != 1:
        raise SystemExit(f"--cameras needs exactly one scene, found {len(options.files)} scenes.")
    try:
        cameras = cvtgs.load_cameras(options.cameras, split=options.split)
        if options.images is None:
            return own_scorer(weights, cameras, background=background)
        cameras = fit_cameras(cameras, options.images)
        photographs = load_photographs(options.images, cameras, background=background)
    except cvtgs.CvtgsError as error:
        raise SystemExit(str(error)) from None
    judge = PhotographJudge(cameras, photographs, background, scorers.Metrics(lpips=weights))
    return lambda full, small: [judge.score(scene) for scene in small]


class PhotographJudge(NamedTuple):
    """Scores scenes against photographs.

    Attributes:
        cameras: The cameras of the photographs.
        photographs: One per camera, of the size of the cameras.
        background: Background colour of the renderings.
        metrics: The metrics to compute.
    """

    cameras: Cameras
    photographs: Float[Tensor, "c h w 3"]
    background: scorers.Color
    metrics: scorers.Metrics

    def score(self, scene: cvtgs.GaussianScene) -> Quality:
        """Return the means over the photographs."""
        color = scene.means.new_tensor(self.background)
        rows = [
            self.metrics.compare(
                scorers.render_views(scene, camera).over(color).clamp(0, 1),
                self.photographs[number : number + 1],
            )
            for number, camera in enumerate(self.cameras.singles())
        ]
        return Quality.of(scorers.scene_scores("", len(scene), rows))


def any_lpips(path: Path) -> LpipsWeights:
    """Read LPIPS weights of either network."""
    try:
        return load_lpips("vgg", path)
    except FileFormatError:
        return load_lpips("alex", path)


def own_scorer(
    weights: LpipsWeights | None,
    cameras: Cameras | None,
    *,
    background: scorers.Color,
    size: int = SIZE,
) -> Scorer:
    """Return a scorer with cvtgs' own renderer, from cameras or else from automatic views."""
    metrics = scorers.Metrics(lpips=weights)

    def score(full: cvtgs.GaussianScene, small: Sequence[cvtgs.GaussianScene]) -> list[Quality]:
        views = cameras or automatic_views(full, VIEWS, width=size, height=size)
        scorer = scorers.Scorer(full, views.singles(), metrics=metrics, backgrounds=(background,))
        found = [scorers.scene_scores("", len(scene), scorer.score(scene)) for scene in small]
        return [Quality.of(scores) for scores in found]

    return score


def score_views(
    full: cvtgs.GaussianScene, small: Mapping[str, cvtgs.GaussianScene], cameras: Cameras
) -> dict[str, Quality]:
    """Return scores of simplified scenes against the full one, as means over the cameras."""
    settings = EvaluationSettings(lpips="off")
    found = cvtgs.evaluate(full, small, cameras, settings=settings)
    return {one.name: Quality.of(one) for one in found.scenes}


def command_scorer(template: str) -> Scorer:
    """Return a scorer by a command, which gets files and prints named scores as JSON."""

    def score(full: cvtgs.GaussianScene, small: Sequence[cvtgs.GaussianScene]) -> list[Quality]:
        with tempfile.TemporaryDirectory() as folder:
            paths = [Path(folder) / f"{number}.ply" for number in range(len(small) + 1)]
            for scene, path in zip([full, *small], paths, strict=True):
                cvtgs.save(scene, path)
            first, *others = (shlex.quote(str(path)) for path in paths)
            words = filled(template, {"{full}": first, "{small}": " ".join(others)})
            return printed_scores(run(shlex.split(words)).output, len(small))

    return score


def printed_scores(output: str, count: int) -> list[Quality]:
    """Read the scores of some scenes that a command printed."""
    try:
        rows = json.loads(output)
        found = [Quality(**{key: row[key] for key in SCORES if key in row}) for row in rows]
    except (ValueError, TypeError):
        found = []
    if len(found) != count:
        wanted = f"a JSON list of {count} objects with psnr and ssim"
        raise SystemExit(f"--scorer must print {wanted}; found {output.strip()[:200]!r}.")
    return found


def means(table: Table) -> dict[str, list[Quality]]:
    """Average over the scenes: one quality per ratio, by variant."""
    first, *_ = table.values()
    return {
        variant: [
            Quality(
                psnr=mean(quality.psnr for quality in column),
                ssim=mean(quality.ssim for quality in column),
                lpips=mean_or_none([quality.lpips for quality in column]),
                alpha_error=mean_or_none([quality.alpha_error for quality in column]),
                alpha_bias=mean_or_none([quality.alpha_bias for quality in column]),
            )
            for column in zip(*(rows[variant] for rows in table.values()), strict=True)
        ]
        for variant in first
    }


def mean_or_none(values: Sequence[float | None]) -> float | None:
    """Return the mean, or None if any value is None."""
    known = [value for value in values if value is not None]
    return mean(known) if len(known) == len(values) else None


def markdown(table: Table, ratios: Sequence[float], *, means_only: bool = False) -> str:
    """Return a Markdown table: the mean first, then scene by scene."""
    heads = [
        f"{name} at {rho:g}" for rho in ratios for name in ("PSNR", "SSIM", "LPIPS", "alpha error")
    ]
    shown = {MEAN: means(table)} if means_only else {MEAN: means(table), **table}
    lines = [
        [scene, variant, *(cell for quality in row for cell in cells_of(quality))]
        for scene, rows in shown.items()
        for variant, row in rows.items()
    ]
    return markdown_rows(["scene", "variant", *heads], lines)


def markdown_rows(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Lay out a Markdown table."""
    lines = [heads, ["---"] * len(heads), *rows]
    return "".join(f"| {' | '.join(cells)} |\n" for cells in lines)


def cells_of(quality: Quality) -> tuple[str, str, str, str]:
    """Return the text of four columns; a dash for values not measured."""
    distance, error = (
        "-" if value is None else f"{value:.4f}" for value in (quality.lpips, quality.alpha_error)
    )
    return f"{quality.psnr:.2f}", f"{quality.ssim:.4f}", distance, error


def powers(power: str) -> dict[str, str]:
    return {"cvt.area_power": power}


CHOICES: Mapping[str, Mapping[str, str]] = {
    "standard": {},
    "tessellation without colour": {"cvt.color": "0"},
    "colour as for 10,000 cells": {"cvt.color_power": "0"},
    "no perspective": {"cvt.perspective": "false"},
    "no ambient visibility": {"cvt.hidden_share": "1"},
    "weight by opacity (power 0)": powers("0"),
    "weight power 0.2": powers("0.2"),
    "weight power 0.7": powers("0.7"),
    "weight by mass (power 1)": powers("1"),
    "unbounded off": {"effects.unbounded": "off"},
    "seeds only, no Lloyd": {"cvt.iterations": "0"},
    "20 Lloyd iterations over all": {"cvt.iterations": "20", "cvt.samples_per_site": "0"},
    "cells of the tessellation": {"allocation.oversampling": "1", "allocation.reassign": "false"},
    "no reassignment": {"allocation.reassign": "false"},
    "pairs without colour": {"allocation.color": "0"},
    "no faint Gaussian left out": {"filter.max_mass_share": "0"},
    "1 % of the mass below 0.1 left out": {"filter.min_opacity": "0.1"},
    "paper's filter": {"filter.min_opacity": "0.1", "filter.max_mass_share": "1"},
    "members weigh by opacity": {"merge.area_power": "0"},
    "paper's opacity": {"merge.opacity": "union"},
    "moments of all members": {"merge.representatives": "false"},
    "no inflation": {"merge.inflation": "0", "merge.covered_inflation": "0"},
    "inflation without neighbours": {"merge.inflation": "0.3", "merge.covered_inflation": "0"},
    "paper": {"preset": "paper"},
}


def main() -> None:
    parser = scoring_parser(__doc__)
    parser.add_argument("--choices", action="store_true", help="one choice at a time")
    options = parser.parse_args()
    presets = {name: {"preset": name} for name in cvtgs.PRESETS}
    *_, table = measure(variants_of(options, CHOICES if options.choices else presets), options)
    print(markdown(table, options.rho, means_only=options.means))


if __name__ == "__main__":
    main()
