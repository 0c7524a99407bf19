"""SimplifyConfig, the configuration of a simplification, and the presets."""

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, Self

import pydantic

from cvtgs.config.base import Section, named, read_settings
from cvtgs.config.sections import (
    AllocationConfig,
    EffectsConfig,
    FilterConfig,
    MatchConfig,
    MergeConfig,
    RefineConfig,
    TessellationConfig,
    VisibilityConfig,
)
from cvtgs.errors import ConfigError, check_path
from cvtgs.text import shown, suggestion


def _frozen(values: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return a mapping that cannot be changed, nor those in it."""
    return MappingProxyType(
        {key: _frozen(value) if isinstance(value, dict) else value for key, value in values.items()}
    )


def unknown_preset(name: object) -> ConfigError:
    """Return the error for an unknown preset."""
    near = suggestion(name, PRESETS) if isinstance(name, str) else ""
    end = near or "."
    return ConfigError(f"preset must be one of {', '.join(PRESETS)}; found {shown(name, 120)}{end}")


IMAGES: Mapping[str, Any] = {"size": 400, "stride": 2, "fine_factor": 2}
"""Sizes of images, equal for matching and refinement, which share them."""

MATCHED: Mapping[str, Any] = {
    "visibility": {**IMAGES, "views": 32},
    "match": {"opacity_rounds": 1, "error_power": 1.0},
    "refine": {
        "steps": 45,
        "images_per_step": 2,
        "rates": {"means": 0.042, "quats": 0.017, "log_scales": 0.021},
        "half_after": 60,
        **IMAGES,
        "steps_per_image": 100,
        "check_every": 15,
        "lengthening": 4.0,
    },
}

THINNED: Mapping[str, Any] = {
    "steps": 120,
    "images_per_step": 4,
    "rates": {
        "means": 0.08,
        "quats": 0.032,
        "log_scales": 0.04,
        "logit_opacities": 0.2,
        "sh0": 0.08,
        "shN": 0.004,
    },
    "half_after": 115,
    "cooling": 0.3,
    **IMAGES,
    "first_images": 32,
    "steps_per_image": 1000,
    "check_every": 15,
    "lengthening": 4.0,
}

PRESETS: Mapping[str, Mapping[str, Any]] = _frozen(
    {
        "draft": {"cvt": {"iterations": 0}, "merge": {"network": False}},
        "fast": {"merge": {"network": False}},
        "standard": {},
        "matched": MATCHED,
        "high": {
            **MATCHED,
            "visibility": {**MATCHED["visibility"], "views": 72},
            "refine": THINNED,
        },
        "paper": {
            "effects": {"unbounded": "off", "duplicates": "off", "clamping": "off"},
            "filter": {"min_opacity": 0.1, "max_mass_share": 1.0, "max_flyaway_share": 0.0},
            "cvt": {
                "area_power": 0.0,
                "perspective": False,
                "hidden_share": 1.0,
                "weight_floor": 0.0,
                "color": 0.0,
                "seeding": "weighted",
                "iterations": 5,
                "tolerance": 0.0,
                "samples_per_site": 0,
            },
            "allocation": {"oversampling": 1.0, "reassign": False},
            "merge": {
                "area_power": 0.0,
                "opacity": "union",
                "representatives": False,
                "align_axes": False,
                "inflation": 0.0,
                "covered_inflation": 0.0,
            },
        },
    }
)
"""Changes of each preset to the defaults; ``standard`` has none.

They are in the order of time, from the fastest to the best, on which ``--time-budget`` relies.

``paper`` is CVT-GS (Li et al. 2026) as published, with a network that was trained here; the design
page lists the details that the publication leaves open.
"""


class SimplifyConfig(Section):
    """The configuration of a simplification; frozen, unknown keys are errors.

    Values that are not given are those of the preset, also within sections that are given as
    mappings: ``SimplifyConfig(preset="paper", cvt={"iterations": 10})``. Type checkers accept these
    in :meth:`from_mapping` only; a section that is given as an object has the defaults elsewhere.

    Attributes:
        preset: Name of the preset that the values start from.
        seed: Seed of all random draws.
        effects: Effects to force on or off, whatever the scene calls for.
        filter: Gaussians to drop before the tessellation.
        visibility: Images that measure the contribution of each Gaussian.
        cvt: Tessellation: how Gaussians are grouped into cells.
        allocation: How cells merge down to the target count.
        merge: How a cell becomes one Gaussian.
        match: How opacities and colours are matched to images of the scene, if at all.
        refine: How the result is refined by images of the scene, if at all.

    Raises:
        ConfigError: There is no such preset, a key is unknown, or a value is out of range.

    Example:
        >>> SimplifyConfig.from_preset("paper").filter.max_mass_share
        1.0
    """

    preset: str = "standard"
    seed: int = pydantic.Field(default=0, ge=0, lt=1 << 63)
    effects: EffectsConfig = EffectsConfig()
    filter: FilterConfig = FilterConfig()
    visibility: VisibilityConfig = VisibilityConfig()
    cvt: TessellationConfig = TessellationConfig()
    allocation: AllocationConfig = AllocationConfig()
    merge: MergeConfig = MergeConfig()
    match: MatchConfig = MatchConfig()
    refine: RefineConfig = RefineConfig()

    @pydantic.model_validator(mode="before")
    @classmethod
    def _start_from_preset(cls, values: Any) -> Any:
        if not isinstance(values, Mapping):
            return values
        name = values.get("preset", cls.model_fields["preset"].default)
        if not isinstance(name, str) or name not in PRESETS:
            raise unknown_preset(name)
        return _merged(PRESETS[name], values)

    @property
    def uses_renders(self) -> bool:
        """Whether images of the scene are rendered to measure contributions."""
        return self.visibility.views > 0 and self.effects.visibility != "off"

    @property
    def uses_images(self) -> bool:
        """Whether images of the scene are rendered at all, for contributions or a refinement."""
        return self.uses_renders or self.refine.enabled

    @property
    def shares_images(self) -> bool:
        """Whether a refinement trains on the images that opacities are matched to."""
        is_same = all(
            getattr(self.visibility, name) == getattr(self.refine, name) for name in IMAGES
        )
        return self.uses_renders and self.match.enabled and self.refine.enabled and is_same

    @classmethod
    def from_preset(cls, name: str) -> Self:
        """Return a preset.

        Args:
            name: One of :data:`cvtgs.config.PRESETS`.

        Returns:
            The configuration.

        Raises:
            ConfigError: There is no such preset.
        """
        return cls(preset=name)

    @classmethod
    def from_mapping(cls, values: Mapping[str, Any]) -> Self:
        """Build a configuration from nested values and the preset that they name.

        Args:
            values: For example ``{"preset": "paper", "cvt": {"iterations": 10}}``.

        Raises:
            ConfigError: The values are no mapping, a key is unknown or a value is out of range; the
                message names it.
        """
        if not isinstance(values, Mapping):
            raise ConfigError(f"a configuration must be a mapping, found {shown(values)}.")
        return cls(**{str(key): value for key, value in values.items()})

    @classmethod
    def from_toml(cls, path: str | Path) -> Self:
        """Read a configuration file.

        Args:
            path: A TOML file with the keys of this class; missing keys come from its preset.

        Returns:
            The configuration.

        Raises:
            ConfigError: The file cannot be read, is not TOML, or holds a bad key or value.
            InvalidArgumentError: The path is no path.
        """
        check_path(path)
        return cls.compose(file=path)

    @classmethod
    def compose(
        cls,
        *,
        file: str | Path | None = None,
        preset: str | None = None,
        settings: Mapping[str, str] | None = None,
    ) -> Self:
        """Compose a configuration from a file, a preset and single settings.

        Args:
            file: A TOML file, whose missing keys come from the preset, or a report of ``cvtgs
                simplify``, whose configuration is taken (``.json``).
            preset: Name of the preset; overrides the one in the file.
            settings: Texts by dotted key, for example ``{"cvt.iterations": "10"}``; they override
                all others.

        Raises:
            ConfigError: The file cannot be read, a key is unknown, or a value is out of range.
        """
        values = {} if file is None else read_settings(file)
        if not isinstance(settings, Mapping | None) or not all(
            isinstance(key, str) for key in settings or {}
        ):
            raise ConfigError(f"settings must be texts by dotted key, found {shown(settings)}.")
        if preset is not None:
            values["preset"] = preset
        try:
            for key, text in (settings or {}).items():
                *sections, name = key.split(".")
                target = values
                for section in sections:
                    target = target.setdefault(section, {})
                    if not isinstance(target, dict):
                        cls.from_mapping(values)  # the file may be wrong
                        raise ConfigError(f"{named(key)}: is not a known setting.")
                target[name] = text
            return cls.from_mapping(values)
        except ConfigError:
            if file is not None:
                try:
                    cls.from_mapping(read_settings(file))
                except ConfigError as error:  # the file alone is no configuration
                    raise ConfigError(f"{file}: {error}") from None
            raise

    def to_toml(self) -> str:
        """Return all keys of the configuration as TOML text, which :meth:`from_toml` reads."""
        import tomli_w  # noqa: PLC0415 (only those who write a file need it)

        return tomli_w.dumps(self.model_dump())


def _merged(base: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    result = dict(base)
    for key, value in changes.items():
        old = result.get(key)
        both = isinstance(old, Mapping) and isinstance(value, Mapping)
        result[key] = _merged(old, value) if both else value  # type: ignore[arg-type]
    return result
