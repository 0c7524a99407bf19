r"""Measure the gain of choices of ``simplify``, seen from hand-picked cameras.

Every ``--set`` is one configuration: a list of settings that differ from the base; ``preset``
and ``ckpt`` (a checkpoint) are among the settings:

    python -m benchmarks.choices a.ply b.ply --rho 0.1 0.01 \
        --set cvt.color=0.1 --set cvt.color=0.1 merge.network=false --set preset=high \
        --set ckpt=mine.safetensors

Cameras are read from a file beside each scene (see ``benchmarks.cameras``), or are automatic views
with ``--automatic``. ``--ignore-tag`` renders scenes tagged ``SplatRenderMode: mip`` as viewers do
that do not know the tag. Every line has PSNR, SSIM, the mean absolute error of alpha, its bias
(negative: more of the background shows through than in the full scene), each with its difference
to the base, and CPU seconds of the simplification alone, in one process. Means over the scenes
come last. ``--base merge.network=false`` changes the base. Images of full scenes are cached in
``--cache``, so that a second run starts at once. ``--pages DIR`` writes a page per scene and ratio
with maps of the colour and alpha errors. ``--fit 48`` gives presets with images that many cameras
around the scene, none of which score, as if they were those of the capture.
"""

import argparse
import json
import math
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from statistics import fmean

import cvtgs
from benchmarks.cameras import CACHE, FullImages, cameras_beside, spread_cameras
from benchmarks.measuring import difference, names_of, settings_of, warm_up, write_file
from benchmarks.quality import mean_or_none
from cvtgs.cameras import Cameras
from cvtgs.evaluation import EvaluationSettings, compare, write_comparison
from cvtgs.evaluation.scorer import (
    BLACK,
    ImageScores,
    Metrics,
    chosen_metrics,
    render_views,
    scene_scores,
)
from cvtgs.views import automatic_views

RATIOS = (0.1, 0.01)
BASE, MEAN = "base", "mean"
AUTOMATIC_VIEWS, AUTOMATIC_SIZE = 8, 400

Settings = Mapping[str, str]


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """Scores and time of one configuration on one scene at one ratio.

    Attributes:
        scene: Name of the scene, or ``mean``.
        rho: Share of Gaussians kept.
        name: Settings of the configuration, or ``base``.
        psnr: dB.
        ssim: At most 1.
        lpips: None if it was not measured.
        alpha_error: Mean absolute difference of alpha.
        alpha_bias: Mean of alpha minus that of the full scene.
        seconds: CPU time of the simplification.
    """

    scene: str
    rho: float
    name: str
    psnr: float
    ssim: float
    lpips: float | None
    alpha_error: float
    alpha_bias: float
    seconds: float


def main(arguments: Sequence[str] | None = None) -> None:
    options = parser().parse_args(arguments)
    base = settings_of(options.base)
    configurations = {BASE: {"preset": "standard", **base}}
    for words in options.set:
        name = " ".join(words)
        if name in configurations:
            raise SystemExit(f"--set: {name!r} is given twice.")
        configurations[name] = {**configurations[BASE], **settings_of(words)}
    names = names_of(options.files)
    try:
        simplifiers = {name: simplifier_of(values) for name, values in configurations.items()}
        for rho in options.rho:
            cvtgs.target_count(1, rho)
        for file in options.files:
            cvtgs.io.scene_file(file).stat()
    except (cvtgs.CvtgsError, OSError) as error:
        raise SystemExit(str(error)) from None
    rows: list[Row] = []
    warm_up()
    print(heads(options), flush=True)
    for name, file in zip(names, options.files, strict=True):
        for row in measure(name, file, simplifiers, options):
            rows.append(row)
            print(line(row, rows, options), flush=True)
        save(rows, options.json)
    if len(options.files) > 1:
        averages: list[Row] = []
        for row in means(rows):
            averages.append(row)
            print(line(row, averages, options))
        save([*rows, *averages], options.json)


def parser() -> argparse.ArgumentParser:
    found = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    found.add_argument("files", nargs="+", type=Path, help="full scenes")
    found.add_argument("--rho", type=float, nargs="+", default=list(RATIOS))
    found.add_argument(
        "--set", action="append", nargs="+", default=[], metavar="KEY=VALUE",
        help="one configuration; may be repeated",
    )  # fmt: skip
    found.add_argument(
        "--base", nargs="+", default=[], metavar="KEY=VALUE", help="settings of all configurations"
    )
    found.add_argument("--automatic", action="store_true", help="use automatic views")
    found.add_argument(
        "--fit", type=int, metavar="COUNT", help="number of cameras to give to the simplification"
    )
    found.add_argument("--size", type=int, help="longer side of the images, pixels")
    found.add_argument("--ignore-tag", action="store_true", help="ignore the tag mip in images")
    found.add_argument(
        "--lpips", default="off", choices=("off", "auto", "vgg", "alex"), help="also measure LPIPS"
    )
    found.add_argument("--cache", type=Path, default=CACHE, help=f"cache of images ({CACHE})")
    found.add_argument("--json", type=Path, help="also write the rows to this file")
    found.add_argument("--pages", type=Path, metavar="DIR", help="also write pages of images")
    return found


def simplifier_of(settings: Settings) -> cvtgs.Simplifier:
    """Return the simplifier of a configuration."""
    values = dict(settings)
    preset, checkpoint = values.pop("preset"), values.pop("ckpt", "auto")
    config = cvtgs.SimplifyConfig.compose(preset=preset, settings=values)
    return cvtgs.Simplifier(checkpoint, config=config)


def measure(
    scene_name: str,
    file: Path,
    simplifiers: Mapping[str, cvtgs.Simplifier],
    options: argparse.Namespace,
) -> Iterator[Row]:
    """Score all configurations on one scene, ratio by ratio."""
    scene = cvtgs.load(file)
    cameras = views_of(file, scene, options)
    metrics = chosen_metrics(options.lpips, (cameras.width, cameras.height))
    full = FullImages(scene=scene, cameras=cameras, folder=options.cache)
    given = spread_cameras(scene, options.fit) if options.fit else None
    for rho in options.rho:
        kept: dict[str, cvtgs.GaussianScene] = {}
        for name, simplifier in simplifiers.items():
            start = time.process_time()
            small = simplifier.simplify(scene, rho, cameras=given)
            seconds = time.process_time() - start
            scores = scene_scores(name, len(small), list(score(small, full, metrics)))
            yield Row(
                scene=scene_name,
                rho=rho,
                name=name,
                seconds=seconds,
                **scores.means(),
            )
            if options.pages:
                kept[name] = small
        if options.pages:
            settings_off = EvaluationSettings(lpips="off")
            comparison = compare(
                scene, kept, cameras, reference_name=scene_name, settings=settings_off
            )
            folder = options.pages / f"{scene_name}-{rho:g}"
            write_comparison(comparison, folder, overwrite=True)


def views_of(file: Path, scene: cvtgs.GaussianScene, options: argparse.Namespace) -> Cameras:
    """Return the cameras beside a scene, or automatic ones."""
    if options.automatic:
        size = options.size or AUTOMATIC_SIZE
        cameras = automatic_views(scene, AUTOMATIC_VIEWS, width=size, height=size)
    else:
        cameras = cameras_beside(file, size=options.size).to(scene.device)
    return replace(cameras, ignores_tag=(options.ignore_tag,) * len(cameras))


def score(small: cvtgs.GaussianScene, full: FullImages, metrics: Metrics) -> Iterator[ImageScores]:
    """Score a simplified scene view by view, over black."""
    background = small.means.new_tensor(BLACK)
    for truth in full.images():
        image = render_views(small, truth.cameras)
        pair = [one.over(background).clamp(0, 1) for one in (image, truth)]
        yield metrics.compare(*pair, alphas=(image.alpha, truth.alpha))


def means(rows: Sequence[Row]) -> Iterator[Row]:
    """Average over the scenes, for every ratio and configuration in their order."""
    for rho, name in dict.fromkeys((row.rho, row.name) for row in rows):
        some = [row for row in rows if (row.rho, row.name) == (rho, name)]
        yield Row(
            scene=MEAN,
            rho=rho,
            name=name,
            psnr=fmean(row.psnr for row in some),
            ssim=fmean(row.ssim for row in some),
            lpips=mean_or_none([row.lpips for row in some]),
            alpha_error=fmean(row.alpha_error for row in some),
            alpha_bias=fmean(row.alpha_bias for row in some),
            seconds=fmean(row.seconds for row in some),
        )


COLUMNS = {
    "psnr": ("PSNR", 6, 2),
    "ssim": ("SSIM", 6, 4),
    "lpips": ("LPIPS", 6, 4),
    "alpha_error": ("alpha error", 6, 4),
    "alpha_bias": ("alpha bias", 7, 4),
}
"""Heading, column width and decimals of each score."""


def columns(options: argparse.Namespace) -> dict[str, tuple[str, int, int]]:
    """Return the columns that the options ask for."""
    return {
        key: column for key, column in COLUMNS.items() if key != "lpips" or options.lpips != "off"
    }


def heads(options: argparse.Namespace) -> str:
    """Return the header line."""
    cells = [f"{'scene':16}", f"{'rho':>6}"]
    cells += [
        f"{title:>{width + digits + 4}}" for title, width, digits in columns(options).values()
    ]
    return "  ".join([*cells, f"{'CPU s':>6}", "configuration"])


def line(row: Row, rows: Sequence[Row], options: argparse.Namespace) -> str:
    """Format a row, each score with its difference to the base; a dash if not measured."""
    base = next(
        each for each in rows if (each.scene, each.rho, each.name) == (row.scene, row.rho, BASE)
    )
    cells = [f"{row.scene[:16]:16}", f"{row.rho:>6g}"]
    for key, (_, width, digits) in columns(options).items():
        value, before = getattr(row, key), getattr(base, key)
        if value is None:
            cells.append(f"{'-':>{width}} {'':{digits + 3}}")
        else:
            change = "" if row is base else f"{difference(value, before):+.{digits}f}"
            cells.append(f"{value:{width}.{digits}f} {change:>{digits + 3}}")
    return "  ".join([*cells, f"{row.seconds:6.2f}", row.name])


def save(rows: Sequence[Row], path: Path | None) -> None:
    """Write all rows as JSON, if a file is given; infinite values, which JSON lacks, as null."""
    if path is not None:
        records = [
            {key: None if value in (math.inf, -math.inf) else value for key, value in found.items()}
            for found in map(asdict, rows)
        ]
        write_file(path, (json.dumps(records, indent=1) + "\n").encode())


if __name__ == "__main__":
    main()
