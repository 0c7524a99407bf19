"""``cvtgs demo``: a generated scene, simplified and compared."""

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import cvtgs
from cvtgs.cli.display import file_size, progress_bars, say, say_wrapped
from cvtgs.cli.options import AddParser, add_options, count

if TYPE_CHECKING:
    from cvtgs.clock import StageCost
    from cvtgs.evaluation import SceneScores

RATIOS = (0.1, 0.01)
VIEWS, WIDTH, HEIGHT = 6, 480, 360


def add_demo(add_parser: AddParser) -> None:
    """Add the command and its options."""
    parser = add_parser(
        "demo",
        help="simplify a generated scene; needs no files",
        description="Generate a scene, simplify it to 10 % and 1 % of its Gaussians, and write all "
        "three scenes and a page that shows them side by side.",
    )
    parser.set_defaults(run=demo)
    parser.add_argument(
        "-o",
        "--output",
        type=Path,
        default=Path("cvtgs-demo"),
        metavar="DIR",
        help="directory to write to (default cvtgs-demo); the files of an earlier demo are "
        "replaced",
    )
    parser.add_argument(
        "--count",
        type=count,
        default=100_000,
        metavar="N",
        help="number of Gaussians to generate (default 100000)",
    )
    add_options(parser, "--preset")
    parser.add_argument(
        "--seed", type=int, default=0, metavar="N", help="seed of the generated scene (default 0)"
    )
    add_options(parser, "--device", "--quiet")


def demo(options: argparse.Namespace) -> None:
    """Run ``cvtgs demo``."""
    from cvtgs.io.atomic import make_folder

    make_folder(options.output)
    with progress_bars(quiet=options.quiet) as listener:
        simplifier = cvtgs.Simplifier(
            config=options.preset or "standard", device=options.device, listener=listener
        )
        scene = cvtgs.synthetic.demo_scene(options.count, seed=options.seed)
        path = options.output / "full.ply"
        cvtgs.save(scene, path, overwrite=True)
        columns = [_column(path, len(scene), ())]
        sizes, smaller = {path.name: path.stat().st_size}, {}
        for rho in RATIOS:
            small, report = simplifier.run(scene, rho)
            path = options.output / f"small_{rho:g}.ply"
            cvtgs.save(small, path, overwrite=True)
            columns.append(_column(path, len(small), report.stages))
            sizes[path.name], smaller[path.name] = path.stat().st_size, small
        comparison = cvtgs.evaluation.compare(
            scene,
            smaller,
            cvtgs.views.automatic_views(scene, VIEWS, width=WIDTH, height=HEIGHT),
            reference_name="full.ply",
            sizes=sizes,
            settings=cvtgs.evaluation.EvaluationSettings(lpips="off"),
            listener=listener,
        )
        cvtgs.evaluation.write_comparison(
            comparison, options.output, overwrite=True, listener=listener
        )
    if not options.quiet:
        scores = [{}, *map(_scores, comparison.evaluation.scenes)]
        _print_table([one | other for one, other in zip(columns, scores, strict=True)])
        _print_next_steps(options.output)


def _scores(scores: "SceneScores") -> dict[str, str]:
    alpha = {"alpha error": f"{scores.alpha_error.mean:.4f}"} if scores.alpha_error else {}
    return {"PSNR, dB": f"{scores.psnr.mean:.2f}", "SSIM": f"{scores.ssim.mean:.3f}"} | alpha


def _column(path: Path, count: int, stages: "Sequence[StageCost]") -> dict[str, str]:
    seconds = {f"{cost.stage}, s": f"{cost.seconds:.2f}" for cost in stages}
    total = {"all stages, s": f"{sum(cost.seconds for cost in stages):.2f}"} if stages else {}
    return {"file": path.name, "Gaussians": f"{count:,}", "size": file_size(path)} | seconds | total


def _print_table(columns: list[dict[str, str]]) -> None:
    from rich.box import SIMPLE_HEAD
    from rich.console import Console
    from rich.table import Table

    first, *other_rows = columns[-1]
    table = Table(first, *(column[first] for column in columns), box=SIMPLE_HEAD)
    for name in other_rows:
        table.add_row(name, *(column.get(name, "") for column in columns))
    for column in table.columns[1:]:
        column.justify = "right"
    Console().print(table)


def _print_next_steps(folder: Path) -> None:
    say("Compare them side by side: open this page in a browser (it works offline).")
    say(f"  {(folder / 'index.html').resolve().as_uri()}")
    say_wrapped(f"The scenes are in {folder}; any 3DGS viewer opens them.")
    say("With a scene of your own:")
    say("  cvtgs info scene.ply")
    say("  cvtgs simplify scene.ply small.ply --rho 0.01")
    say("  cvtgs compare scene.ply small.ply -o comparison")
