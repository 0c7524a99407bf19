"""PSNR and SSIM against the full scene, of presets and with single choices switched off.

``python -m benchmarks.quality`` scores generated scenes with cvtgs' own renderer and views.
Scenes of your own: name the files. Another judge: ``--scorer "python score.py --json {full}
{small}"``; it gets the full scene and the small ones, and prints a JSON list of objects with
``psnr`` and ``ssim``, in that order. ``--ablation`` switches choices off one by one.
"""

import argparse
import json
import shlex
import subprocess
import tempfile
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from statistics import mean

import cvtgs
from cvtgs.evaluate import EvaluationSettings, automatic_views, evaluate

Scores = list[tuple[float, float]]
Scorer = Callable[[cvtgs.GaussianScene, list[cvtgs.GaussianScene]], Scores]


def powers(power: str) -> dict[str, str]:
    return {"cvt.area_power": power, "cvt.unbounded_area_power": power}


ABLATION: Mapping[str, Mapping[str, str]] = {
    "standard": {},
    "by position only": {"cvt.color": "0"},
    "colour as for 10,000 cells": {"cvt.color_power": "0"},
    "no perspective": {"cvt.perspective": "false"},
    "enclosed count fully": {"cvt.hidden_share": "1"},
    "weight by opacity (power 0)": powers("0"),
    "weight power 0.5": powers("0.5"),
    "weight power 0.8": powers("0.8"),
    "weight power 1 everywhere": powers("1"),
    "unbounded not told": {"cvt.unbounded": "off"},
    "seeds only, no Lloyd": {"cvt.iterations": "0"},
    "20 Lloyd iterations over all": {"cvt.iterations": "20", "cvt.samples_per_site": "0"},
    "paper's filter": {"filter.max_mass_share": "1"},
    "no filter": {"filter.max_mass_share": "0"},
    "members weigh by opacity": {"merge.area_power": "0"},
    "paper's opacity": {"merge.opacity": "union"},
    "no widening": {"merge.widening": "0", "merge.covered_widening": "0"},
    "widening without neighbours": {"merge.widening": "0.3", "merge.covered_widening": "0"},
    "paper": {"preset": "paper"},
}
PRESETS: Mapping[str, Mapping[str, str]] = {name: {"preset": name} for name in cvtgs.PRESETS}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("files", nargs="*", type=Path)
    parser.add_argument("--scorer", help="command with {full} and {small}")
    parser.add_argument("--rho", type=float, nargs="+", default=[0.1, 0.01, 0.001])
    parser.add_argument("--ablation", action="store_true")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--count", type=int, default=100_000, help="size of generated scenes")
    parser.add_argument("--means", action="store_true", help="print means only")
    options = parser.parse_args()
    extra = dict(item.split("=", 1) for item in options.set)
    variants = ABLATION if options.ablation else PRESETS
    table: dict[str, dict[str, Scores]] = {name: {} for name in variants}
    for scene_name, scene in scenes(options):
        score = command_scorer(options.scorer) if options.scorer else own_scorer(scene)
        for name, settings in variants.items():
            simplifier = cvtgs.Simplifier(config=configuration({**extra, **settings}))
            small = [simplifier.simplify(scene, rho) for rho in options.rho]
            table[name][scene_name] = score(scene, small)
    show(table, options.rho, means_only=options.means or options.ablation)


def configuration(settings: Mapping[str, str]) -> cvtgs.SimplifyConfig:
    values = dict(settings)
    return cvtgs.SimplifyConfig.compose(preset=values.pop("preset", None), settings=values)


def scenes(options: argparse.Namespace) -> Iterator[tuple[str, cvtgs.GaussianScene]]:
    if options.files:
        yield from ((file.stem, cvtgs.load(file)) for file in options.files)
        return
    for seed, kind in enumerate(cvtgs.synthetic.KINDS):
        yield kind, cvtgs.synthetic.scene(kind, options.count, sh_degree=1, seed=seed)


def own_scorer(scene: cvtgs.GaussianScene) -> Scorer:
    cameras = automatic_views(scene, 8, width=400, height=400)
    settings = EvaluationSettings(lpips="off")

    def score(full: cvtgs.GaussianScene, small: list[cvtgs.GaussianScene]) -> Scores:
        named = {str(number): scene for number, scene in enumerate(small)}
        found = evaluate(full, named, cameras, settings=settings)
        return [(scores.psnr.mean, scores.ssim.mean) for scores in found.scenes]

    return score


def command_scorer(template: str) -> Scorer:
    def score(full: cvtgs.GaussianScene, small: list[cvtgs.GaussianScene]) -> Scores:
        with tempfile.TemporaryDirectory() as folder:
            paths = [Path(folder) / f"{number}.ply" for number in range(len(small) + 1)]
            for scene, path in zip([full, *small], paths, strict=True):
                cvtgs.save(scene, path)
            first, *others = (shlex.quote(str(path)) for path in paths)
            command = template.format(full=first, small=" ".join(others))
            output = subprocess.run(
                shlex.split(command), check=True, capture_output=True, text=True
            ).stdout
        return [(entry["psnr"], entry["ssim"]) for entry in json.loads(output)]

    return score


def show(table: dict[str, dict[str, Scores]], ratios: list[float], *, means_only: bool) -> None:
    print("| variant | scene | " + " | ".join(f"rho {rho:g}" for rho in ratios) + " |")
    print("|---|---|" + "---|" * len(ratios))
    for variant, rows in table.items():
        means = [
            (mean(psnr for psnr, _ in column), mean(ssim for _, ssim in column))
            for column in zip(*rows.values(), strict=True)
        ]
        shown = {"mean": means} if means_only else {**rows, "mean": means}
        for name, row in shown.items():
            cells = (f"{psnr:.2f} dB / {ssim:.4f}" for psnr, ssim in row)
            print(f"| {variant} | {name} | " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()
