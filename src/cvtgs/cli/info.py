"""``cvtgs info``: facts about a scene."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from cvtgs.cli.display import READABLE, file_size
from cvtgs.cli.effects import add_effects_option, effect_settings, load_needed

if TYPE_CHECKING:
    from cvtgs.effects import Effect
    from cvtgs.info import SceneInfo


def add_parser(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Describe the command."""
    parser = commands.add_parser(
        "info", help="show facts about a scene", description="Show facts about a scene."
    )
    parser.add_argument("input", metavar="IN", type=Path, help=f"scene to read ({READABLE})")
    parser.add_argument("--json", action="store_true", help="print JSON")
    add_effects_option(parser)
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> None:
    """Run the command."""
    from cvtgs.config import SimplifyConfig  # noqa: PLC0415 (keeps --help fast)
    from cvtgs.info import describe  # noqa: PLC0415

    config = SimplifyConfig.compose(settings=effect_settings(options.effects))
    facts = describe(load_needed(options.input, config), config)
    if options.json:
        print(facts.model_dump_json(indent=2))
    else:
        for label, text in _rows(facts, options.input):
            print(f"{label:<16} {text}")


def _rows(facts: "SceneInfo", path: Path) -> list[tuple[str, str]]:
    from cvtgs.info import HEAVIEST, QUANTILES  # noqa: PLC0415 (keeps --help fast)

    invalid = ", ".join(f"{name} {number:,}" for name, number in facts.invalid_rows.items())
    rows = [
        ("file", f"{path}, {file_size(path)}"),
        ("Gaussians", f"{facts.count:,}"),
        ("SH degree", f"{facts.sh_degree}"),
        ("bounds", f"{_vector(facts.bounds[0])} to {_vector(facts.bounds[1])}"),
        ("robust radius", f"{facts.robust_radius:.4g} around {_vector(facts.robust_center)}"),
        ("opacity at", _labelled(QUANTILES, facts.opacity_quantiles, "{:.0%} {:.3f}")),
        ("mass", f"{facts.mass:.4g} square units"),
        ("heaviest hold", _labelled(HEAVIEST, facts.mass_shares, "{:.1%} {:.1%}")),
        (
            "opacity < 0.1",
            f"{facts.faint_share:.1%} of the Gaussians, {facts.faint_mass_share:.1%} of the mass",
        ),
        ("invalid rows", f"{facts.invalid_count:,}" + (f" ({invalid})" if invalid else "")),
        ("tags", "anti-aliased (mip)" if facts.antialiased else "none"),
        ("comments", "; ".join(facts.comments) or "none"),
        ("extra columns", ", ".join(facts.extra_columns) or "none"),
    ]
    return rows + [(name, _evidence(effect)) for name, effect in facts.plan]


def _evidence(effect: "Effect") -> str:
    from cvtgs.effects import BandsEffect  # noqa: PLC0415 (keeps --help fast)

    state, figures = "on " if effect.active else "off", f"{effect.figure:.3g}"
    if isinstance(effect, BandsEffect) and effect.bands:
        state += f" up to degree {effect.degree}" if effect.active else ""
        figures = ", ".join(f"{loss:.3g}" for loss in effect.bands)
    return f"{state} {figures} ({effect.meaning}{'; forced' if effect.forced else ''})"


def _labelled(shares: tuple[float, ...], values: tuple[float, ...], form: str) -> str:
    return "   ".join(form.format(*pair) for pair in zip(shares, values, strict=True))


def _vector(values: tuple[float, ...]) -> str:
    return "(" + ", ".join(f"{value:.4g}" for value in values) + ")"
