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
from cvtgs.io.atomic import make_folder
from cvtgs.text import size_text

FULL, SMALL = "full.ply", {"small_0.1.ply": 0.1, "small_0.01.ply": 0.01}  # ratios
VIEWS, WIDTH, HEIGHT = 6, 480, 360
OWN_SCENE = """With a scene of your own:
  cvtgs info scene.ply
  cvtgs simplify scene.ply small.ply --rho 0.01
  cvtgs compare scene.ply small.ply -o comparison"""

_MADE_BY = "written by cvtgs demo"


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
    make_folder(options.output)
    _check_folder(options.output)
    columns, sizes, smaller = list[dict[str, str]](), dict[str, int](), {}

    def write(
        scene: "cvtgs.GaussianScene", name: str, stages: "Sequence[cvtgs.clock.StageCost]" = ()
    ) -> None:
        path = options.output / name
        cvtgs.save(scene, path, overwrite=True)
        sizes[name] = path.stat().st_size
        columns.append(
            {"file": name, "Gaussians": f"{len(scene):,}", "size": size_text(sizes[name])}
        )
        columns[-1] |= {f"{cost.stage}, s": f"{cost.seconds:.2f}" for cost in stages}
        if stages:
            columns[-1]["all stages, s"] = f"{sum(cost.seconds for cost in stages):.2f}"

    with progress_bars(quiet=options.quiet) as listener:
        simplifier = cvtgs.Simplifier(
            config=options.preset or "standard", device=options.device, listener=listener
        )
        scene = cvtgs.synthetic.demo_scene(options.count, seed=options.seed)
        scene = replace(scene, comments=(*scene.comments, _MADE_BY))
        write(scene, FULL)
        for name, rho in SMALL.items():
            smaller[name], report = simplifier.run(scene, rho)
            write(smaller[name], name, report.stages)
        comparison = cvtgs.evaluation.compare(
            scene,
            smaller,
            cvtgs.views.automatic_views(scene, VIEWS, width=WIDTH, height=HEIGHT),
            reference_name=FULL,
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
        say("Compare them side by side: open this page in a browser (it works offline).")
        say(f"  {(options.output / 'index.html').resolve().as_uri()}")
        say_wrapped(f"The scenes are in {options.output}; any 3DGS viewer opens them.")
        say(OWN_SCENE)


def _check_folder(folder: Path) -> None:
    """Raise if a folder holds other files than those of an earlier demo."""
    from cvtgs.evaluation.comparison_files import ERRORS, PAGE, SHEET

    start = b""
    with suppress(OSError), (folder / FULL).open("rb") as file:
        start = file.read(4096)  # the header
    names = (FULL, PAGE, SHEET, ERRORS, *SMALL)
    found = next((name for name in names if (folder / name).exists()), None)
    if found is not None and f"comment {_MADE_BY}\n".encode() not in start:
        raise OutputExistsError(
            f"{folder}: must be a new folder or that of an earlier demo, found {found}."
        )
