"""``cvtgs demo``: a generated scene, simplified and compared."""

import argparse
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import cvtgs
from cvtgs.cli.display import progress_bars, say, say_table, say_wrapped
from cvtgs.cli.options import AddParser, add_options, count
from cvtgs.cli.paths import new_folder
from cvtgs.errors import OutputExistsError
from cvtgs.text import size_text

RATIOS = (0.1, 0.01)
VIEWS, WIDTH, HEIGHT = 6, 480, 360

_MADE_BY = "written by cvtgs demo"
_HEADER = 4096


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
        type=new_folder,
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
    _check_folder(options.output)
    with progress_bars(quiet=options.quiet) as listener:
        simplifier = cvtgs.Simplifier(
            config=options.preset or "standard", device=options.device, listener=listener
        )
        scene = cvtgs.synthetic.demo_scene(options.count, seed=options.seed)
        scene = replace(scene, comments=(*scene.comments, _MADE_BY))
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
        for column, scores in zip(columns[1:], comparison.evaluation.scenes, strict=True):
            column["PSNR, dB"] = f"{scores.psnr.mean:.2f}"
            column["SSIM"] = f"{scores.ssim.mean:.3f}"
            if scores.alpha_error:
                column["alpha error"] = f"{scores.alpha_error.mean:.4f}"
        names = columns[-1]  # the full scene lacks some
        say_table([[name, *(column.get(name, "") for column in columns)] for name in names])
        _print_next_steps(options.output)


def _check_folder(folder: Path) -> None:
    """Raise if a folder holds other files than those of an earlier demo."""
    from cvtgs.evaluation.comparison_files import ERRORS, PAGE, SHEET

    full = folder / "full.ply"
    start = b""
    with suppress(OSError), full.open("rb") as file:
        start = file.read(_HEADER)
    names = ["full.ply", PAGE, SHEET, ERRORS, *(f"small_{rho:g}.ply" for rho in RATIOS)]
    found = next((name for name in names if (folder / name).exists()), None)
    if found is not None and f"comment {_MADE_BY}\n".encode() not in start:
        raise OutputExistsError(
            f"{folder}: must be a new folder or that of an earlier demo, found {found}."
        )


def _column(path: Path, count: int, stages: "Sequence[cvtgs.clock.StageCost]") -> dict[str, str]:
    size = size_text(path.stat().st_size)
    column = {"file": path.name, "Gaussians": f"{count:,}", "size": size}
    column |= {f"{cost.stage}, s": f"{cost.seconds:.2f}" for cost in stages}
    if stages:
        column["all stages, s"] = f"{sum(cost.seconds for cost in stages):.2f}"
    return column


def _print_next_steps(folder: Path) -> None:
    say("Compare them side by side: open this page in a browser (it works offline).")
    say(f"  {(folder / 'index.html').resolve().as_uri()}")
    say_wrapped(f"The scenes are in {folder}; any 3DGS viewer opens them.")
    say("With a scene of your own:")
    say("  cvtgs info scene.ply")
    say("  cvtgs simplify scene.ply small.ply --rho 0.01")
    say("  cvtgs compare scene.ply small.ply -o comparison")
