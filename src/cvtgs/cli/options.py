"""Options that several commands share, and functions that read their values."""

import argparse
import math
import re
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import pairwise, takewhile
from typing import TYPE_CHECKING, Any, NamedTuple, NoReturn

import cvtgs
from cvtgs.cli.display import say
from cvtgs.cli.paths import any_path, new_folder
from cvtgs.errors import ConfigError, InvalidArgumentError
from cvtgs.text import SETTING_LIKENESS, suggestion

if TYPE_CHECKING:
    import pydantic

READABLE = (
    ".ply, .compressed.ply, .spz, .splat, .ksplat, .sog, meta.json or lod-meta.json of one, .glb, "
    ".gltf, .ckpt, .pt or the folder of a trained model"
)
WRITABLE = ".ply, .compressed.ply, .spz, .splat, .sog, .glb, .gltf, .spz.glb or .usda"
PRESET_NAMES = "draft, fast, standard, matched, high (from the fastest to the best) or paper"
CAMERA_FILES = "transforms.json, a COLMAP model, cameras.json, or a folder of these"
_UNITS = {"ms": 1e-3, "": 1.0, "s": 1.0, "m": 60.0, "min": 60.0, "h": 3600.0}  # in seconds


def read_words(text: str) -> list[str]:
    """Read comma-separated words."""
    return [word.strip() for word in text.split(",") if word.strip()]


def ratios(text: str) -> list[float]:
    """Read a list of ratios, for argparse."""
    numbers = [ratio(word) for word in read_words(text)]
    if not numbers or len(set(numbers)) < len(numbers):
        raise argparse.ArgumentTypeError(
            f"must be different numbers separated by commas, for example 0.1,0.01 or 10%,1%; "
            f"found {text!r}"
        )
    return numbers


def ratio(text: str) -> float:
    """Read a ratio, for argparse."""
    from cvtgs.counts import read_ratio

    with _usage_errors():
        number = read_ratio(text)
        if not 0 < number <= 1:
            raise InvalidArgumentError(f"rho must be above 0 and at most 1 (100%), found {text!r}.")
        return number


def count(text: str) -> int:
    """Read a number of Gaussians, for argparse."""
    from cvtgs.counts import read_count

    with _usage_errors():
        return read_count(text)


def seconds(text: str) -> float:
    """Read a time in seconds, for argparse."""
    found = re.fullmatch(r"([\d.]+(?:e[+-]?\d+)?)\s*([a-z]*)", text.strip().lower())
    try:
        return float(found[1]) * _UNITS[found[2]]  # type: ignore[index]
    except (TypeError, ValueError, KeyError):
        raise argparse.ArgumentTypeError(
            f"must be a time in ms, s, min or h, for example 20s or 2m, found {text!r}"
        ) from None


@contextmanager
def _usage_errors() -> Iterator[None]:
    """Raise invalid values as usage errors of argparse."""
    try:
        yield
    except InvalidArgumentError as error:
        raise argparse.ArgumentTypeError(str(error).rstrip(".")) from error


# Keys are option names, with both spellings where there are two. Help texts of values are noun
# phrases; those of flags begin with a verb.
_SHARED: Mapping[str, Mapping[str, Any]] = {
    "input": {"metavar": "IN", "type": any_path, "help": f"scene to read ({READABLE})"},
    "reference": {"metavar": "REF", "type": any_path, "help": f"full scene ({READABLE})"},
    "small": {"metavar": "SMALL", "type": any_path, "nargs": "+", "help": "simplified scenes"},
    "-o/--output": {
        "metavar": "DIR",
        "type": new_folder,
        "required": True,
        "help": "directory to write to",
    },
    "--rho": {
        "metavar": "R,R",
        "type": ratios,
        "default": "0.1,0.01,0.001",
        "help": "ratios of Gaussians to keep (default 0.1,0.01,0.001)",
    },
    "--preset": {"metavar": "NAME", "help": f"preset: {PRESET_NAMES} (default standard)"},
    "--ckpt": {
        "metavar": "NAME",
        "default": "auto",
        "help": "MergeNet checkpoint: auto (default: that of the preset), standard, paper or a "
        "file, which also set the preset if none is given, or none to merge by moments alone",
    },
    "--config": {"metavar": "FILE", "type": any_path, "help": "settings, or an earlier report"},
    "--set": {
        "metavar": "KEY=VALUE",
        "action": "append",
        "default": [],
        "dest": "settings",
        "help": "setting to change, for example cvt.iterations=10; can be repeated",
    },
    "--effects": {
        "metavar": "NAME=VALUE,...",
        "help": "effects to force, for example sh=1,mip=off, instead of choosing them by the "
        "scene: sh (0 to 3, on or off); mip, unbounded, haze, duplicates, clamping (on or "
        "off); flat, extras, visibility (off); auto is the default of each",
    },
    "--lpips": {
        "default": "auto",
        "choices": ("auto", "vgg", "alex", "off"),
        "help": "network of LPIPS (default auto: VGG or Alex, if weights are installed)",
    },
    "--cameras": {
        "metavar": "F",
        "type": any_path,
        "help": f"cameras to render from: {CAMERA_FILES} (default: those "
        "beside REF or IN or in its folder, if they show the scene, else automatic views)",
    },
    "--images": {
        "metavar": "DIR",
        "type": any_path,
        "help": "photographs of --cameras, matched by name, to score against as well; images have "
        "their size if it is smaller than that of --cameras, unless --size is given",
    },
    "--split": {"choices": ("train", "test"), "help": "split of --cameras to use"},
    "--views": {
        "metavar": "N",
        "type": int,
        "help": "number of views, spread evenly over those of --cameras or found beside the scene "
        "(default 8, or all of --cameras)",
    },
    "--background": {
        "metavar": "COLOR",
        "default": "black",
        "help": "background colour: black (default), gray, white, or red,green,blue from 0 to 1",
    },
    "--backend": {
        "default": "auto",
        "choices": ("auto", "torch", "numba", "gsplat"),
        "help": "renderer (default auto: the fastest available)",
    },
    "--device": {
        "metavar": "DEVICE",
        "default": "auto",
        "help": "device to compute on: auto (default), cpu or cuda",
    },
    "--sh-degree": {
        "metavar": "D",
        "type": int,
        "choices": range(4),
        "help": "drop the SH bands of IN above this degree, 0 to 3, which makes OUT smaller",
    },
    "--axes": {
        "metavar": "IN[:OUT]",
        "help": "axes of the files: where x, y and z point, for example rub (right, up, back) or "
        "rub:rub (default: rdf, that is right, down, forward; luf for glTF, rub for .usda; unless "
        "IN states its own)",
    },
    "--lod": {
        "metavar": "N",
        "type": int,
        "help": "level of a streamed SOG (lod-meta.json) to read, 0 (default) for the finest",
    },
    "--overwrite": {"action": "store_true", "help": "replace existing files"},
    "--quiet": {"action": "store_true", "help": "print only errors and warnings"},
    "--trust-sizes": {
        "action": "store_true",
        "help": "read compressed files that claim far more Gaussians than their bytes can hold",
    },
    "--json": {"action": "store_true", "help": "print JSON"},
    "--viewer": {
        "action": "store_true",
        "help": "also write viewer.html, one file with the scenes in 3D (needs the extra view)",
    },
}


class CommandParser(argparse.ArgumentParser):
    """Argument parser that suggests the nearest known command, option or choice."""

    check: "Callable[[CommandParser, argparse.Namespace], None] | None" = None
    """For commands with any number of paths: exits if paths and options do not fit together."""

    _words: Sequence[str] = ()
    """The words that are parsed, for messages."""

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Parse the words; report an unknown option even if a required one is missing, too."""
        self._words = args or ()
        options, of_all = self._option_string_actions, self._subparsers is not None
        for word in takewhile(lambda word: word != "--", self._words):
            if of_all and not word.startswith("-"):  # the command
                break
            name = word.partition("=")[0]
            if name.startswith("--") and not any(one.startswith(name) for one in options):
                hint = suggestion(name, options, likeness=0.7)
                hint = hint or "; options come after the command" * of_all
                self.error(f"unrecognized argument: {name}{hint}")
            if name.startswith("-") and f"-{name}" in options:  # else -output means -o utput
                self.error(f"unrecognized argument: {name}; did you mean -{name}?")
        known, rest = super().parse_known_args(args, namespace)
        if self.check is not None:  # allows paths between options
            known.paths += [word for word in rest if word == "-" or not word.startswith("-")]
            rest = [word for word in rest if word != "-" and word.startswith("-")]
        if rest and self._subparsers is None:
            self.error(f"unrecognized arguments: {' '.join(rest)}{self._ratios_hint(rest)}")
        if self.check is not None:
            self.check(self, known)
        return known, rest

    def _ratios_hint(self, rest: Sequence[str]) -> str:
        """Return a hint if ratios that are left over belong into the list of ``--rho``."""
        rho = self._option_string_actions.get("--rho")
        takes_list = rho is not None and rho.metavar == "R,R"
        are_ratios = all(re.fullmatch(r"[\d.]+%?,?", word) for word in rest)
        return "; separate ratios by commas: --rho 0.1,0.01" if takes_list and are_ratios else ""

    def _print_message(self, message: str, file: Any = None) -> None:
        """Print with :func:`say`; argparse has no public hook for this."""
        say(message, file=file or sys.stderr, end="")

    def error(self, message: str) -> NoReturn:
        """Print the usage and the message, if possible with a suggestion; exit with status 2."""
        wrong = re.search(r"invalid choice: '(.*?)' \(choose from (.*)\)", message)
        if wrong:
            message += suggestion(wrong[1], re.findall(r"[\w-]+", wrong[2]))
        message = message.replace("invalid int value: ", "must be a whole number, found ")
        message = message.replace("invalid float value: ", "must be a number, found ")
        lacks = re.fullmatch(r"argument (?:.*/)?(--[\w-]+): expected one argument", message)
        for option, value in pairwise(self._words):
            is_value = re.match(r"-[^-]", value) and value not in self._option_string_actions
            if lacks and option == lacks[1] and is_value:
                message += f"; with a minus sign, write {option}={value}"
        super().error(message)


AddParser = Callable[..., CommandParser]  # argparse's method that makes the parser of a command


def add_options(parser: argparse.ArgumentParser, *names: str, **helps: str) -> None:
    """Add shared options to a command; ``helps`` has other help texts for some, by bare name."""
    for name in names:
        bare = name.lstrip("-")
        texts = {"help": helps[bare]} if bare in helps else {}
        parser.add_argument(*name.split("/"), **{**_SHARED[name], **texts})


def read_numbers(name: str, text: str, *counts: int, of: str = "") -> list[float]:
    """Read as many finite numbers as one of counts from an option; ``of`` says what they are."""
    try:
        numbers = [float(word) for word in text.replace(",", " ").split()]
    except ValueError:
        numbers = []
    if len(numbers) not in counts or not all(map(math.isfinite, numbers)):
        wanted = f"{' or '.join(map(str, counts))} numbers {of or 'separated by commas'}"
        raise InvalidArgumentError(f"{name} must be {wanted}, found {text!r}.")
    return numbers


def dotted(text: str) -> str:
    """Read ``--suffix``, for argparse: spz means .spz, and _small.ply itself."""
    return f".{text}" if text[:1].isalnum() else text


class FileAxes(NamedTuple):
    """The axes of a file to read and of files to write; None if they were not given."""

    source: str | None
    target: str | None


def read_axes(text: str | None) -> FileAxes:
    """Read ``--axes``."""
    from cvtgs.io.axes import checked_axes

    source, _, target = (text or "").partition(":")
    return FileAxes(
        checked_axes(source) if source else None, checked_axes(target) if target else None
    )


def read_settings(words: Sequence[str] = (), effects: str | None = None) -> dict[str, str]:
    """Read ``--set`` and ``--effects`` as settings by dotted key; ``--set`` takes precedence."""
    forced = _assignments(
        [] if effects is None else effects.split(","),
        "--effects needs NAME=VALUE, for example sh=1,mip=off",
    )
    settings = {f"effects.{name}": value for name, value in forced.items()}
    settings |= _assignments(words, "--set needs KEY=VALUE, for example cvt.iterations=10")
    known = list(_setting_names(cvtgs.SimplifyConfig))
    for key in (key for key in settings if key not in known):
        nearest = suggestion(key, known, likeness=SETTING_LIKENESS)
        if key.startswith("effects.") and not nearest:
            nearest = f"; there are {', '.join(cvtgs.config.EffectsConfig.model_fields)}."
        if nearest:  # otherwise the configuration reports the unknown key
            raise ConfigError(f"{key}: is not a known setting{nearest}")
    return settings


def _assignments(words: Sequence[str], example: str) -> dict[str, str]:
    assignments = {}
    for word in words:
        key, equals, value = (part.strip() for part in word.partition("="))
        if not (key and equals and value):
            raise ConfigError(f"{example}; found {word!r}.")
        assignments[key] = value
    return assignments


def _setting_names(section: "type[pydantic.BaseModel]", prefix: str = "") -> Iterator[str]:
    """List the dotted keys of a configuration."""
    for name, field in section.model_fields.items():
        if isinstance(field.annotation, type) and hasattr(field.annotation, "model_fields"):
            yield from _setting_names(field.annotation, f"{prefix}{name}.")
        else:
            yield prefix + name


def checkpoint_of(options: argparse.Namespace) -> str | None:
    """Return ``--ckpt``; None for no network."""
    return None if options.ckpt == "none" else options.ckpt


def read_config(options: argparse.Namespace, settings: Mapping[str, str]) -> "cvtgs.SimplifyConfig":
    """Compose the settings with ``--config`` and ``--preset``, or else the preset of ``--ckpt``."""
    preset: str | None = options.preset
    if preset is None and options.config is None and options.ckpt not in ("auto", "none"):
        preset = cvtgs.mergenet.load_checkpoint(options.ckpt).info.preset
    return cvtgs.SimplifyConfig.compose(file=options.config, preset=preset, settings=settings)


def read_scene(
    options: argparse.Namespace, config: "cvtgs.SimplifyConfig", *, axes: str | None = None,
    all_bands: bool = False,
) -> "cvtgs.GaussianScene":  # fmt: skip
    """Read ``IN`` without what ``--effects`` and ``--sh-degree`` exclude, or with all bands."""
    kept = None if all_bands else getattr(options, "sh_degree", None)
    limits = [limit for limit in (config.effects.sh, kept) if isinstance(limit, int)]
    scene = cvtgs.io.load(
        options.input,
        sh_degree=None if all_bands else min(limits, default=None),
        extras=config.effects.extras != "off",
        axes=axes,
        trust_sizes=options.trust_sizes,
        lod=options.lod,
    )
    cvtgs.validity.warn_of_lost_digits(scene)
    return scene if kept is None else scene.with_sh_degree(kept)
