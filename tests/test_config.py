"""SimplifyConfig: frozen, with presets; unknown keys and values are errors."""

import pickle

import pydantic
import pytest

from cvtgs import PRESETS, SimplifyConfig
from cvtgs.config import FilterConfig, MergeConfig, RefineConfig, TessellationConfig
from cvtgs.errors import ConfigError, InvalidArgumentError


def error_of(values: dict[str, object]) -> str:
    with pytest.raises(ConfigError) as caught:
        SimplifyConfig.from_mapping(values)
    return str(caught.value)


def compose_error(**arguments: object) -> str:
    with pytest.raises(ConfigError) as caught:
        SimplifyConfig.compose(**arguments)
    return str(caught.value)


def test_standard_is_the_default():
    assert SimplifyConfig.from_preset("standard") == SimplifyConfig()
    assert SimplifyConfig.from_mapping({}) == SimplifyConfig()


def test_the_paper_preset_is_cvt_gs():
    paper = SimplifyConfig.from_preset("paper")
    assert paper.preset == "paper"
    assert paper.filter == FilterConfig(min_opacity=0.1, max_mass_share=1.0, max_flyaway_share=0.0)
    assert paper.cvt.area_power == paper.merge.area_power == 0.0
    assert not paper.cvt.perspective
    assert (paper.cvt.color, paper.effects.unbounded, paper.cvt.iterations) == (0.0, "off", 5)
    assert (paper.cvt.seeding, paper.cvt.samples_per_site) == ("weighted", 0)
    assert (paper.merge.opacity, paper.merge.inflation) == ("union", 0.0)


def test_standard_is_mass_everywhere():
    standard = SimplifyConfig()
    assert standard.filter == FilterConfig(min_opacity=0.005, max_mass_share=0.01)
    assert (standard.cvt.area_power, standard.merge.area_power) == (0.4, 1.0)
    assert standard.cvt.perspective
    assert standard.cvt.seeding == "stratified"
    assert standard.merge.opacity == "saturating"


@pytest.mark.parametrize("name", PRESETS)
def test_every_preset_is_valid_and_keeps_its_name(name):
    assert SimplifyConfig.from_preset(name).preset == name


def test_values_override_their_preset():
    config = SimplifyConfig.from_mapping({"preset": "paper", "cvt": {"iterations": 9}})
    assert config.cvt.iterations == 9
    assert config.cvt.area_power == 0.0
    assert SimplifyConfig.from_preset("paper").cvt.iterations == 5


@pytest.mark.parametrize("name", PRESETS)
def test_toml_round_trip(name, tmp_path):
    config = SimplifyConfig.from_mapping(
        {"preset": name, "seed": 7, "merge": {"inflation": 0.125}, "cvt": {"iterations": 3}}
    )
    path = tmp_path / "config.toml"
    path.write_text(config.to_toml(), encoding="utf-8")
    assert SimplifyConfig.from_toml(path) == config


def test_a_byte_order_mark_before_toml_is_skipped(tmp_path):
    path = tmp_path / "config.toml"
    path.write_text('preset = "paper"\n', encoding="utf-8-sig")  # as Notepad may save it
    assert SimplifyConfig.from_toml(path).preset == "paper"


def test_a_partial_file_takes_the_rest_from_its_preset(tmp_path):
    path = tmp_path / "config.toml"
    path.write_text('preset = "paper"\n[merge]\ninflation = 0.5\n', encoding="utf-8")
    config = SimplifyConfig.from_toml(path)
    assert config.merge == MergeConfig(
        area_power=0.0,
        opacity="union",
        representatives=False,
        align_axes=False,
        inflation=0.5,
        covered_inflation=0.0,
    )
    assert config.cvt == SimplifyConfig.from_preset("paper").cvt


def test_settings_override_the_preset_and_the_preset_the_file(tmp_path):
    path = tmp_path / "config.toml"
    path.write_text('preset = "standard"\n[cvt]\niterations = 3\ncolor = 0.5\n', encoding="utf-8")
    config = SimplifyConfig.compose(
        file=path, preset="paper", settings={"cvt.iterations": "10", "seed": "4"}
    )
    assert config.preset == "paper"
    assert config.seed == 4
    assert (config.cvt.iterations, config.cvt.color, config.cvt.area_power) == (10, 0.5, 0.0)


@pytest.mark.parametrize(
    ("key", "text", "value"),
    [
        ("cvt.color", "0.25", 0.25),
        ("cvt.seeding", "weighted", "weighted"),
        ("effects.unbounded", "on", "on"),
        ("effects.sh", "1", 1),
        ("effects.sh", "off", 0),
        ("merge.inflation", "0", 0.0),
        ("filter.max_mass_share", "1e-3", 1e-3),
    ],
)
def test_settings_are_parsed_from_text(key, text, value):
    config = SimplifyConfig.compose(settings={key: text})
    section, name = key.split(".")
    assert getattr(getattr(config, section), name) == value


def test_configurations_are_frozen():
    config = SimplifyConfig()
    with pytest.raises(pydantic.ValidationError):
        config.seed = 1
    with pytest.raises(pydantic.ValidationError):
        config.cvt.iterations = 1


def test_sections_can_be_used_on_their_own():
    assert TessellationConfig(iterations=0).iterations == 0
    with pytest.raises(ConfigError, match=r"^iteration: is not .*; did you mean iterations\?$"):
        TessellationConfig(iteration=0)


@pytest.mark.parametrize("name", PRESETS)
def test_the_constructor_starts_from_the_preset(name):
    preset = SimplifyConfig.from_preset(name)
    assert SimplifyConfig(preset=name) == SimplifyConfig.model_validate({"preset": name}) == preset
    changed = SimplifyConfig(preset=name, cvt={"iterations": 9})
    cvt = preset.cvt.model_copy(update={"iterations": 9})
    assert changed == preset.model_copy(update={"cvt": cvt})
    # a dump holds all values, so those of the preset do not return
    edited = preset.model_copy(update={"filter": FilterConfig(), "refine": RefineConfig()})
    assert SimplifyConfig(**edited.model_dump()) == edited
    assert SimplifyConfig.model_validate_json(edited.model_dump_json()) == edited
    assert pickle.loads(pickle.dumps(edited)) == edited


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"rho": 0.1}, "rho: is not a known setting."),
        (
            {"cvt": {"itertions": 3}},
            "cvt.itertions: is not a known setting; did you mean cvt.iterations?",
        ),
        (
            {"cvt": {"iterations": -1}},
            "cvt.iterations: input should be greater than or equal to 0, found -1.",
        ),
        (
            {"match": {"color_ridge": 1e39}},
            "match.color_ridge: input should be less than or equal to 1000000000, found 1e+39.",
        ),
        (
            {"match": {"band_ridge": 1e-45}},
            "match.band_ridge: input should be greater than or equal to 0.000000001, found 1e-45.",
        ),
        (
            {"refine": {"mse_weight": 0, "image_weight": 0.0}},
            "one of refine.mse_weight and refine.image_weight must be above 0.",
        ),
        (
            {"allocation": {"widest": 1e300}},
            "allocation.widest: input should be less than or equal to 1000000000, found 1e+300.",
        ),
        (
            {"filter": {"min_opacity": 1.5}},
            "filter.min_opacity: input should be less than or equal to 1, found 1.5.",
        ),
        (
            {"cvt": {"seeding": "grid"}},
            "cvt.seeding: input should be 'stratified' or 'weighted', found 'grid'.",
        ),
        (
            {"merge": {"x": 1}, "y": 2},
            "merge.x: is not a known setting; y: is not a known setting.",
        ),
    ],
)
def test_unknown_keys_and_values_are_errors(values, message):
    assert error_of(values) == message
    with pytest.raises(ConfigError) as caught:
        SimplifyConfig(**values)
    assert str(caught.value) == message


def test_keys_that_are_no_text_are_errors():
    assert error_of({1: 2}) == "1: is not a known setting."


@pytest.mark.parametrize("value", [True, False])
@pytest.mark.parametrize(
    ("section", "key", "kind"),
    [
        ("cvt", "iterations", "integer"),
        ("cvt", "color", "number"),
        ("refine", "steps", "integer"),
        ("filter", "min_opacity", "number"),
    ],
)
def test_truth_values_are_no_numbers(section, key, kind, value):
    wanted = f"{section}.{key}: input should be a valid {kind}, unable to parse string as a"
    assert error_of({section: {key: value}}).startswith(wanted)
    assert SimplifyConfig(cvt={"perspective": value}).cvt.perspective is value


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
@pytest.mark.parametrize("key", ["color", "weight_floor", "tolerance"])
def test_numbers_that_are_not_finite_are_errors(key, value):
    message = f"cvt.{key}: input should be a finite number, found {value!r}."
    assert error_of({"cvt": {key: value}}) == message


@pytest.mark.parametrize("name", ["best", "", None, 3, ["paper"]])
def test_unknown_presets_are_errors(name):
    wanted = f"preset must be one of {', '.join(PRESETS)}; found {name!r}."
    assert error_of({"preset": name}) == wanted
    with pytest.raises(pydantic.ValidationError, match="preset must be one of"):
        SimplifyConfig.model_validate({"preset": name})


def test_a_mistyped_preset_gets_a_suggestion():
    assert error_of({"preset": "standart"}).endswith("; found 'standart'; did you mean standard?")


def test_an_unknown_preset_by_name_is_an_error():
    with pytest.raises(ConfigError) as caught:
        SimplifyConfig.from_preset("best")
    assert str(caught.value) == f"preset must be one of {', '.join(PRESETS)}; found 'best'."


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"cvt.speed": "1"}, "cvt.speed: is not a known setting."),
        ({"speed": "1"}, "speed: is not a known setting; did you mean seed?"),
        ({"a.b.c": "1"}, "a: is not a known setting."),
        ({"seed": "2", "seed.x": "1"}, "seed.x: is not a known setting."),
    ],
)
def test_unknown_settings_are_errors(settings, message):
    assert compose_error(settings=settings) == message


def test_a_setting_of_the_wrong_type_is_an_error():
    assert compose_error(settings={"cvt.iterations": "many"}) == (
        "cvt.iterations: input should be a valid integer, unable to parse string as an integer, "
        "found 'many'."
    )


def test_errors_in_a_file_name_the_file(tmp_path):
    path = tmp_path / "config.toml"
    path.write_text("[cvt]\nspeed = 1\n", encoding="utf-8")
    assert compose_error(file=path) == f"{path}: cvt.speed: is not a known setting."


ENDLESS = {
    "a key": ("x" * 1_000_000 + " = 1", "xxx...: is not a known setting."),
    "a key of many lines": ('"' + 9999 * "a\\n" + '" = 1', "...: is not a known setting."),
    "a section": ("[" + ".".join(3000 * "x") + "]", "x: is not a known setting."),
    "a value": (f'seed = "{"x" * 1_000_000}"', "xxx...."),
    "a list": (f"seed = [{'1, ' * 100_000}]", ", 1,...."),
    "a number": ("seed = " + "9" * 5000, "to increase the limit."),
    "a hexadecimal number": ("seed = 0x" + "f" * 9000, "found a number of thousands of digits."),
    "a preset": (f'preset = "{"x" * 1_000_000}"', "xxx...."),
    "a list as preset": (f"preset = [{'1, ' * 100_000}]", ", 1,...."),
    "a key twice": (f"a = {{{2 * ('x' * 100_000 + ' = 1, ')}}}", "xxx...."),
    "nested brackets": ("seed = " + 3000 * "[" + 3000 * "]", "its values are nested too deeply."),
    "many keys": ("\n".join(f"k{i} = 1" for i in range(2000)), "; and 1,996 more."),
}


@pytest.mark.parametrize(("text", "end"), ENDLESS.values(), ids=ENDLESS)
@pytest.mark.long
def test_errors_about_huge_files_are_short(tmp_path, text, end):
    path = tmp_path / "config.toml"
    path.write_text(text, encoding="utf-8")
    message = compose_error(file=path)
    assert message.startswith(f"{path}: ")
    assert message.endswith((end, "its values are nested too deeply."))  # dots in Python 3.14
    assert "\n" not in message
    assert len(message) < len(str(path)) + 400


def test_errors_about_huge_settings_are_short():
    long = "x" * 1_000_000
    messages = [compose_error(settings={key: long}) for key in (long, "seed", "seed." + long)]
    assert all(len(message) < 400 for message in messages)


def test_a_section_of_a_file_that_is_none_is_named(tmp_path):
    path = tmp_path / "a.toml"
    path.write_text("cvt = 3\n")
    with pytest.raises(ConfigError, match=r"a\.toml: cvt: holds settings, found 3"):
        SimplifyConfig.compose(file=path, settings={"cvt.iterations": "4"})


@pytest.mark.parametrize(
    "key", ["visibility.size", "visibility.views", "refine.steps", "refine.heldout"]
)
def test_numbers_that_no_machine_can_do_are_refused(key):
    for text in (str(10**19), "9" * 400):
        assert compose_error(settings={key: text}).startswith(f"{key}: ")


def test_errors_of_the_command_line_do_not_blame_the_file(tmp_path):
    path = tmp_path / "a.toml"
    path.write_text("[cvt]\ncolor = 0.1\n")
    assert compose_error(file=path, preset="nope").startswith("preset must be one of ")
    assert compose_error(file=path, settings={"cvt.iterations": "-1"}).startswith(
        "cvt.iterations: "
    )
    path.write_text("[cvt]\ncolor = -1\n")
    assert compose_error(file=path, preset="fast").startswith(f"{path}: cvt.color: ")


@pytest.mark.parametrize("value", [True, False])
def test_a_truth_value_is_no_sh_degree(value):
    assert error_of({"effects": {"sh": value}}).startswith("effects.sh: input should be 'auto', ")


def test_settings_reach_nested_sections():
    config = SimplifyConfig.compose(settings={"refine.rates.sh0": "0.5", "refine.steps": "3"})
    assert (config.refine.rates.sh0, config.refine.steps) == (0.5, 3)
    with pytest.raises(ConfigError, match=r"refine\.rates\.colour: is not a known setting"):
        SimplifyConfig.compose(settings={"refine.rates.colour": "1"})
    with pytest.raises(ConfigError, match=r"refine\.steps\.most: is not a known setting"):
        SimplifyConfig.compose(settings={"refine.steps": "3", "refine.steps.most": "1"})


@pytest.mark.parametrize("values", [None, [1], "x"])
def test_what_is_no_mapping_is_refused(values):
    with pytest.raises(ConfigError, match="a configuration must be a mapping, found"):
        SimplifyConfig.from_mapping(values)


@pytest.mark.parametrize("settings", [["cvt.iterations=10"], {5: "10"}, "cvt.iterations=10"])
def test_settings_must_be_texts_by_key(settings):
    with pytest.raises(ConfigError, match="settings must be texts by dotted key, found"):
        SimplifyConfig.compose(settings=settings)


@pytest.mark.parametrize("path", [None, 5, b"x", {}, ""])
def test_a_file_must_be_a_path(path):
    with pytest.raises(InvalidArgumentError, match="a path must"):
        SimplifyConfig.from_toml(path)


def test_presets_cannot_be_changed():
    with pytest.raises(TypeError, match="does not support item assignment"):
        PRESETS["fast"]["seed"] = 5
    with pytest.raises(TypeError, match="does not support item assignment"):
        PRESETS["matched"]["refine"]["rates"]["means"] = 1.0


@pytest.mark.parametrize(
    ("changes", "renders", "shares"),
    [
        ({}, True, True),
        ({"match": {"opacity_rounds": 0}}, True, False),
        ({"effects": {"visibility": "off"}}, False, False),
    ],
)
def test_what_images_are_rendered_for(
    changes: dict[str, dict[str, object]], renders: bool, shares: bool
) -> None:
    config = SimplifyConfig.from_mapping({"preset": "matched", **changes})
    assert (config.uses_renders, config.shares_images) == (renders, shares)
    assert config.uses_images
