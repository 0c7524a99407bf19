"""``cvtgs train``: scenes in, a MergeNet checkpoint out."""

import argparse
import math
from pathlib import Path
from typing import TYPE_CHECKING

from cvtgs.cli.display import progress_bars
from cvtgs.errors import OutputError

if TYPE_CHECKING:
    from cvtgs.train import History, TrainConfig

WITHOUT_CURVES = "no image of its curves: that needs pip install 'cvtgs[plots]'"


def add_parser(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Describe the command."""
    parser = commands.add_parser(
        "train",
        help="train the network that merges Gaussians",
        description="Train a MergeNet as CONFIG.toml says, and write the best one to NAME, its "
        "curves and the state to resume from beside it.",
    )
    parser.add_argument("config", metavar="CONFIG.toml", type=Path, help="choices of the training")
    parser.add_argument(
        "-o", "--output", required=True, type=Path, metavar="NAME.safetensors", help="checkpoint"
    )
    parser.add_argument(
        "--scenes",
        action="append",
        default=[],
        type=Path,
        metavar="DIR",
        help="folder of PLY files to learn from, besides those of CONFIG.toml; may be repeated",
    )
    parser.add_argument(
        "--cache", type=Path, metavar="DIR", help="folder of prepared scenes (default: NAME.cache)"
    )
    parser.add_argument("--resume", action="store_true", help="go on where a training stopped")
    parser.add_argument(
        "--device", default="auto", metavar="DEVICE", help="auto (default), cpu or cuda"
    )
    parser.add_argument("--overwrite", action="store_true", help="replace an existing checkpoint")
    parser.add_argument("--quiet", action="store_true", help="print errors and warnings only")
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> None:
    """Run the command."""
    from cvtgs.devices import chosen_device  # noqa: PLC0415
    from cvtgs.io import check_output  # noqa: PLC0415
    from cvtgs.train import TrainConfig, TrainFiles, train  # noqa: PLC0415

    config = _with_scenes(TrainConfig.from_toml(options.config), options.scenes)
    if options.output.suffix != ".safetensors":
        raise OutputError(f"{options.output}: the name must end in .safetensors.")
    files = TrainFiles.beside(options.output, options.cache)
    goes_on = options.resume and files.state.is_file()
    check_output(options.output, overwrite=options.overwrite or goes_on)
    device = chosen_device(options.device)
    with progress_bars(quiet=options.quiet) as listener:
        history = train(
            config,
            files,
            resume=options.resume,
            device=device,
            listener=listener,
            on_validation=lambda history: None if options.quiet else _show(history),
        )
    best = history.best()
    if best is not None and not options.quiet:
        print(f"best at step {best.step}: {best.score:+.2f} dB on scenes it never learned from")
        drawn = f"curves in {files.curves}" if files.curves.is_file() else WITHOUT_CURVES
        print(f"{files.checkpoint}, {drawn}")


def _with_scenes(config: "TrainConfig", folders: list[Path]) -> "TrainConfig":
    data = config.data.model_copy(update={"folders": (*config.data.folders, *folders)})
    return config.model_copy(update={"data": data})


def _show(history: "History") -> None:
    """Print one line for the last validation."""
    last = history.validations[-1]
    gains = ", ".join(
        f"{sum(row) / len(row):+.2f} (least {min(row):+.2f}) at {ratio:g}"
        for ratio, row in last.by_ratio().items()
    )
    loss = "-" if math.isnan(last.loss) else f"{last.loss:.3f}"
    print(f"step {last.step}: loss {loss}, dB gained: {gains}")
