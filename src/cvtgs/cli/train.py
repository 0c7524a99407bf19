"""``cvtgs train``: train a MergeNet checkpoint on scenes."""

import argparse
import math

import cvtgs
from cvtgs.cli.display import progress_bars, say
from cvtgs.cli.options import AddParser, add_options
from cvtgs.cli.paths import any_path
from cvtgs.errors import how_to_install, warn

WITHOUT_CURVES = f"no image of its curves, which needs matplotlib; {how_to_install('cvtgs[plots]')}"


def add_train(add_parser: AddParser) -> None:
    """Add the command and its options."""
    parser = add_parser(
        "train",
        help="train a network that corrects merged Gaussians",
        description="Train a MergeNet with the configuration CONFIG.toml. Writes the network "
        "to NAME.safetensors, and its curves and the state to resume from beside it.",
    )
    parser.set_defaults(run=train)
    parser.add_argument(
        "config", metavar="CONFIG.toml", type=any_path, help="configuration of the training"
    )
    parser.add_argument(
        "-o",
        "--output",
        required=True,
        type=any_path,
        metavar="NAME.safetensors",
        help="checkpoint to write",
    )
    parser.add_argument(
        "--scenes",
        action="append",
        default=[],
        type=any_path,
        metavar="DIR",
        help="directory of PLY files to train on, besides those of CONFIG.toml; can be repeated",
    )
    parser.add_argument(
        "--validation",
        nargs="+",
        default=[],
        metavar="NAME",
        help="scenes for validation only, by file name without .ply (default: those of "
        "CONFIG.toml, or every fifth)",
    )
    parser.add_argument(
        "--cache",
        type=any_path,
        metavar="DIR",
        help="directory of prepared scenes (default: NAME.cache)",
    )
    parser.add_argument(
        "--resume",
        action="store_true",
        help="resume an interrupted training, or extend a finished one (restart_step)",
    )
    add_options(parser, "--device", "--overwrite", "--quiet")


def train(options: argparse.Namespace) -> None:
    """Run ``cvtgs train``."""
    config = cvtgs.train.TrainConfig.from_toml(options.config)
    data = config.data.model_copy(
        update={
            "folders": (*config.data.folders, *options.scenes),
            "validation": tuple(options.validation) or config.data.validation,
        }
    )
    config = config.model_copy(update={"data": data})
    files = cvtgs.train.TrainFiles.beside(options.output, options.cache)
    if options.resume and not files.state.is_file():
        warn(f"{files.state}: there is no such state, so the training starts from the beginning.")
    with progress_bars(quiet=options.quiet) as listener:
        history = cvtgs.train.train(
            config,
            files,
            resume=options.resume,
            overwrite=options.overwrite,
            device=options.device,
            listener=listener,
            on_validation=lambda history: None if options.quiet else print_validation(history),
        )
    kept = history.best() if config.keep == "best" else history.validations[-1]
    if kept is not None and not options.quiet:
        say(f"{config.keep} at step {kept.step}: {kept.mean_gain:+.2f} dB on held-out scenes")
        curves = f"curves in {files.curves}" if files.curves.is_file() else WITHOUT_CURVES
        say(f"{files.checkpoint}, {curves}")


def print_validation(history: "cvtgs.train.History") -> None:
    """Print one line about the last validation."""
    last = history.validations[-1]
    gains = ", ".join(
        f"{sum(row) / len(row):+.2f} (lowest {min(row):+.2f}) at {ratio:g}"
        for ratio, row in last.by_ratio().items()
    )
    loss = "-" if math.isnan(last.loss) else f"{last.loss:.3f}"
    say(f"step {last.step}: loss {loss}, gain in dB: {gains}")
