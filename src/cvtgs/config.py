"""SimplifyConfig: every choice that a simplification makes, with named presets."""

import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import pydantic

from cvtgs.errors import ConfigError

Share = Annotated[float, pydantic.Field(ge=0.0, le=1.0)]


class Section(pydantic.BaseModel):
    """Some settings: frozen, unknown keys and numbers that are not finite are errors."""

    model_config = pydantic.ConfigDict(
        frozen=True, extra="forbid", validate_default=True, allow_inf_nan=False
    )


class FilterConfig(Section):
    """Which faint Gaussians are left out before the tessellation.

    Attributes:
        min_opacity: Only Gaussians fainter than this may be left out.
        max_mass_share: They are left out, faintest first, while they hold at most this share of
            the scene's mass; 1 leaves all of them out.
        max_flyaway_share: Gaussians beyond 100 robust radii are left out, the least first, while
            they hold at most this share of the mass as seen from the middle.
    """

    min_opacity: Share = 0.1
    max_mass_share: Share = 0.01
    max_flyaway_share: Share = 1e-3


class TessellationConfig(Section):
    """How Gaussians are grouped into cells.

    Attributes:
        area_power: A Gaussian weighs its opacity times its mean projected area to this power: 0
            is the opacity alone, 1 the mass.
        unbounded_area_power: The same in unbounded scenes, where the few huge and smooth Gaussians
            of a sky would take too many cells.
        perspective: Whether areas count as they look from the middle of the scene, smaller when
            far.
        hidden_share: What an enclosed Gaussian counts, as a share of a free one; 1 does not look at
            what is enclosed.
        weight_floor: No Gaussian weighs less than this share of the mean weight.
        color: Length of one unit of colour for 10,000 cells, in robust radii; 0 groups by position
            alone.
        color_power: The length grows with the number of cells to this power; with few cells,
            colour counts more.
        unbounded: Whether far positions are pulled in; ``auto`` decides by the scene.
        seeding: Deterministic strata of equal weight, or weighted random draws.
        iterations: Lloyd iterations, at most.
        tolerance: Lloyd stops when an iteration lowers the energy by less than this share.
        samples_per_site: Lloyd looks at this many Gaussians per cell at most; 0 looks at all.
        backend: What searches the nearest site; ``auto`` takes scipy on a CPU, else torch.
    """

    area_power: float = pydantic.Field(default=1.0, ge=0.0, le=2.0)
    unbounded_area_power: float = pydantic.Field(default=0.8, ge=0.0, le=2.0)
    perspective: bool = True
    hidden_share: Share = 0.1
    weight_floor: float = pydantic.Field(default=1e-3, ge=0.0)
    color: float = pydantic.Field(default=0.05, ge=0.0)
    color_power: float = pydantic.Field(default=-0.25, ge=-1.0, le=1.0)
    unbounded: Literal["auto", "on", "off"] = "auto"
    seeding: Literal["stratified", "weighted"] = "stratified"
    iterations: int = pydantic.Field(default=4, ge=0)
    tolerance: float = pydantic.Field(default=1e-3, ge=0.0)
    samples_per_site: int = pydantic.Field(default=12, ge=0)
    backend: Literal["auto", "scipy", "torch"] = "auto"


class MergeConfig(Section):
    """How a cell becomes one Gaussian.

    Attributes:
        area_power: A member weighs its opacity times its mean projected area to this power: 0 is
            the opacity alone, 1 the mass.
        opacity: ``saturating`` conserves mass, ``1 - exp(-tau)``; ``union`` is the opacity of
            members that lie exactly behind one another, ``1 - prod(1 - a)``.
        widening: How much wider than its moments an opaque cell of many members becomes, along
            every axis.
        covered_widening: How much more it becomes so along an axis on which other cells paint at
            both its ends.
        network: Whether MergeNet corrects the merged Gaussians.
    """

    area_power: float = pydantic.Field(default=1.0, ge=0.0, le=2.0)
    opacity: Literal["saturating", "union"] = "saturating"
    widening: float = pydantic.Field(default=0.1, ge=0.0, le=2.0)
    covered_widening: float = pydantic.Field(default=0.4, ge=0.0, le=2.0)
    network: bool = True


class SimplifyConfig(Section):
    """Every choice of a simplification; frozen, unknown keys are errors.

    Attributes:
        preset: Name of the preset that the values started from.
        seed: Seed of whatever is drawn at random.
        filter: Which Gaussians are left out.
        cvt: How Gaussians are grouped.
        merge: How a group becomes one Gaussian.

    Example:
        >>> SimplifyConfig.from_preset("paper").filter.max_mass_share
        1.0
    """

    preset: str = "standard"
    seed: int = pydantic.Field(default=0, ge=0)
    filter: FilterConfig = FilterConfig()
    cvt: TessellationConfig = TessellationConfig()
    merge: MergeConfig = MergeConfig()

    @classmethod
    def from_preset(cls, name: str) -> Self:
        """Give a preset.

        Args:
            name: One of :data:`PRESETS`.

        Returns:
            The configuration.

        Raises:
            ConfigError: There is no such preset.
        """
        if name not in PRESETS:
            raise ConfigError(f"preset must be one of {', '.join(PRESETS)}; found {name!r}.")
        return cls.from_mapping({"preset": name})

    @classmethod
    def from_mapping(cls, values: Mapping[str, Any]) -> Self:
        """Build a configuration from nested values on top of the preset that they name.

        Args:
            values: For example ``{"preset": "paper", "cvt": {"iterations": 10}}``.

        Returns:
            The configuration.

        Raises:
            ConfigError: A key is unknown or a value out of range; the text names it.
        """
        name = values.get("preset", "standard")
        if not isinstance(name, str) or name not in PRESETS:
            raise ConfigError(f"preset must be one of {', '.join(PRESETS)}; found {name!r}.")
        try:
            return cls.model_validate(_merged(PRESETS[name], values))
        except pydantic.ValidationError as error:
            raise ConfigError(explain(error)) from None

    @classmethod
    def from_toml(cls, path: str | Path) -> Self:
        """Read a configuration file.

        Args:
            path: A TOML file with the keys of this class; missing keys come from its preset.

        Returns:
            The configuration.

        Raises:
            ConfigError: The file cannot be read, is not TOML, or holds a bad key or value.
        """
        return cls.compose(file=path)

    @classmethod
    def compose(
        cls,
        *,
        file: str | Path | None = None,
        preset: str | None = None,
        settings: Mapping[str, str] | None = None,
    ) -> Self:
        """Put a configuration together, as the command line does.

        Args:
            file: A TOML file; what it leaves open comes from the preset.
            preset: Name of the preset, instead of the one that the file names.
            settings: Texts by dotted key, for example ``{"cvt.iterations": "10"}``; they win.

        Returns:
            The configuration.

        Raises:
            ConfigError: The file cannot be read, or a key is unknown or a value out of range.
        """
        values = {} if file is None else read_toml(Path(file))
        if preset is not None:
            values["preset"] = preset
        for key, text in (settings or {}).items():
            section, _, name = key.rpartition(".")
            target = values.setdefault(section, {}) if section else values
            if not isinstance(target, dict):
                raise ConfigError(f"{key}: is not a known setting.")
            target[name] = text
        try:
            return cls.from_mapping(values)
        except ConfigError as error:
            raise ConfigError(str(error) if file is None else f"{file}: {error}") from None

    def to_toml(self) -> str:
        """Write the configuration as TOML text that :meth:`from_toml` reads back.

        Returns:
            TOML text, all keys included.
        """
        import tomli_w  # noqa: PLC0415 (only those who write a file need it)

        return tomli_w.dumps(self.model_dump())


PRESETS: Mapping[str, Mapping[str, Any]] = {
    "standard": {},
    "paper": {
        "filter": {"max_mass_share": 1.0, "max_flyaway_share": 0.0},
        "cvt": {
            "area_power": 0.0,
            "unbounded_area_power": 0.0,
            "perspective": False,
            "hidden_share": 1.0,
            "weight_floor": 0.0,
            "color": 0.0,
            "unbounded": "off",
            "seeding": "weighted",
            "iterations": 5,
            "tolerance": 0.0,
            "samples_per_site": 0,
        },
        "merge": {
            "area_power": 0.0,
            "opacity": "union",
            "widening": 0.0,
            "covered_widening": 0.0,
        },
    },
}
"""What each preset changes of the defaults: ``standard`` nothing, ``paper`` is CVT-GS."""


def read_toml(path: Path) -> dict[str, Any]:
    """Read a TOML file.

    Args:
        path: The file.

    Returns:
        Its tables.

    Raises:
        ConfigError: It cannot be read, or is not TOML.
    """
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}.") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: is not a TOML file: {error}.") from None


def _merged(base: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    result = dict(base)
    for key, value in changes.items():
        old = result.get(key)
        both = isinstance(old, Mapping) and isinstance(value, Mapping)
        result[key] = _merged(old, value) if both else value  # type: ignore[arg-type]
    return result


def explain(error: pydantic.ValidationError) -> str:
    """Say in one sentence what is wrong with some settings.

    Args:
        error: What pydantic found.

    Returns:
        Every problem, with key and value.
    """
    problems = []
    for problem in error.errors():
        key = ".".join(str(part) for part in problem["loc"])
        if problem["type"] == "extra_forbidden":
            problems.append(f"{key}: is not a known setting")
        else:
            problems.append(f"{key}: {problem['msg'].lower()}, found {problem['input']!r}")
    return "; ".join(problems) + "."
