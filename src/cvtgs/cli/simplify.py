"""``cvtgs simplify``: a scene in, a smaller scene out."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from cvtgs.cli.display import (
    PRESET_NAMES,
    READABLE,
    WRITABLE,
    file_size,
    progress_bars,
    stage_seconds,
)
from cvtgs.cli.effects import add_effects_option, effect_settings, load_needed
from cvtgs.cli.goals import Goals, add_goal_options
from cvtgs.cli.large import add_large_options, block_memory, run_by_blocks
from cvtgs.errors import ConfigError

if TYPE_CHECKING:
    from cvtgs.report import SimplifyReport


def add_parser(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Describe the command."""
    parser = commands.add_parser(
        "simplify",
        help="make a scene smaller",
        description="Write a scene with exactly ceil(rho * N) of the N Gaussians of IN.",
    )
    parser.add_argument("input", metavar="IN", type=Path, help=f"scene to read ({READABLE})")
    parser.add_argument("output", metavar="OUT", type=Path, help=f"scene to write ({WRITABLE})")
    size = parser.add_mutually_exclusive_group(required=True)
    size.add_argument("--rho", type=float, metavar="R", help="ratio of Gaussians to keep, (0, 1]")
    size.add_argument("--count", type=int, metavar="M", help="number of Gaussians to keep")
    add_goal_options(parser, size)
    parser.add_argument(
        "--preset",
        metavar="NAME",
        help=f"{PRESET_NAMES} (default standard)",
    )
    parser.add_argument(
        "--ckpt",
        default="auto",
        metavar="NAME",
        help="MergeNet checkpoint: auto (default, that of the preset), standard, paper, a file, "
        "or none to merge by moments alone",
    )
    parser.add_argument("--config", type=Path, metavar="F.toml", help="configuration file")
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        dest="settings",
        help="change one setting, for example cvt.iterations=10; may be repeated",
    )
    add_effects_option(parser)
    parser.add_argument(
        "--refine",
        type=float,
        metavar="SECONDS",
        help="fine-tune the result against images of IN for so long at most, while views that "
        "are held out improve; 0 does not, whatever the preset",
    )
    parser.add_argument(
        "--refine-steps", type=int, metavar="N", help="fine-tune for N steps at most"
    )
    parser.add_argument(
        "--cameras",
        type=Path,
        metavar="F",
        help="from where to look, for presets that look and for --refine: transforms.json, a "
        "COLMAP model, cameras.json, or a folder of these (default: automatic views)",
    )
    add_large_options(parser)
    parser.add_argument("--report", type=Path, metavar="R.json", help="write what was done as JSON")
    parser.add_argument(
        "--device", default="auto", metavar="DEVICE", help="auto (default), cpu or cuda"
    )
    parser.add_argument("--overwrite", action="store_true", help="replace existing output files")
    parser.add_argument("--quiet", action="store_true", help="print errors and warnings only")
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> None:
    """Run the command."""
    from cvtgs.config import SimplifyConfig  # noqa: PLC0415 (keeps --help fast)
    from cvtgs.io import (  # noqa: PLC0415
        atomic_output,
        check_output,
        check_save,
        load_cameras,
        save,
    )
    from cvtgs.mergenet import load_checkpoint  # noqa: PLC0415
    from cvtgs.simplify import Simplifier, target_count  # noqa: PLC0415

    goals = Goals(options)
    checkpoint = None if options.ckpt == "none" else options.ckpt
    preset = options.preset
    if checkpoint not in (None, "auto") and preset is None and options.config is None:
        preset = load_checkpoint(checkpoint).info.preset
    settings = _refinement(options) | effect_settings(options.effects)
    settings |= read_settings(options.settings)
    config = SimplifyConfig.compose(file=options.config, preset=preset, settings=settings)
    if options.rho is not None:
        target_count(1, options.rho)
    check_save(options.output, overwrite=options.overwrite)
    if options.report is not None:
        check_output(options.report, overwrite=options.overwrite)
    with progress_bars(quiet=options.quiet) as listener:
        memory = block_memory(options, config)
        if memory is not None:
            report = run_by_blocks(options, checkpoint, config, memory=memory, listener=listener)
        else:
            scene = load_needed(options.input, config)
            cameras = None if options.cameras is None else load_cameras(options.cameras)
            chosen = goals.preset(scene, settings, listener)
            if chosen is not None:
                config = SimplifyConfig.compose(preset=chosen, settings=settings)
            simplifier = Simplifier(
                checkpoint,
                config=config,
                device=options.device,
                listener=goals.stage_listener(listener),
            )
            small, report = goals.run(simplifier, scene, cameras=cameras, listener=listener)
            save(small, options.output, overwrite=options.overwrite)
    if options.report is not None:
        with atomic_output(options.report, overwrite=options.overwrite) as file:
            file.write(report.to_json().encode())
    if not options.quiet:
        print(
            f"{report.input_count:,} -> {report.output_count:,} Gaussians, "
            f"{file_size(options.input)} -> {file_size(options.output)}, "
            f"{stage_seconds(report.stages)}"
        )
        _print_details(report)
        for sentence in goals.said:
            print(sentence)


def _print_details(report: "SimplifyReport") -> None:
    if report.blocks > 1:
        resumed = f", {report.resumed_blocks} of them done before" if report.resumed_blocks else ""
        print(f"In {report.blocks} blocks{resumed}.")
    if report.shortfall:
        print(f"Fewer than the {report.target_count:,} asked for: {report.shortfall}.")
    if report.refinement is not None:
        gained = report.refinement
        print(
            f"Refined in {gained.steps:,} {'step' if gained.steps == 1 else 'steps'}: "
            f"{gained.gain:+.2f} dB on views that were held out, "
            f"{gained.psnr_before:.2f} -> {gained.psnr_after:.2f}."
        )


def _refinement(options: argparse.Namespace) -> dict[str, str]:
    """Return the settings that the options of the refinement stand for; either replaces both."""
    if options.refine is None and options.refine_steps is None:
        return {}
    steps, seconds = options.refine_steps or 0, options.refine or 0.0
    return {"refine.steps": str(steps), "refine.seconds": str(seconds)}


def read_settings(words: list[str]) -> dict[str, str]:
    """Read what ``--set`` was given."""
    settings = {}
    for word in words:
        key, equals, value = word.partition("=")
        if not (key and equals):
            raise ConfigError(
                f"--set needs KEY=VALUE, for example cvt.iterations=10; found {word!r}."
            )
        settings[key.strip()] = value.strip()
    return settings
