"""TrainConfig: settings and errors of a TOML file."""

from pathlib import Path

import pydantic
import pytest

from cvtgs.errors import ConfigError
from cvtgs.train import DataConfig, TrainConfig

RECIPES = Path(__file__).parents[2] / "recipes"


def from_text(folder: Path, text: str) -> TrainConfig:
    path = folder / "training.toml"
    path.write_text(text, encoding="utf-8")
    return TrainConfig.from_toml(path)


def test_values_of_every_section(tmp_path):
    config = from_text(
        tmp_path,
        """
        kind = "local"
        preset = "paper"
        steps = 12
        learning_rate = 0.25
        note = "two scenes"
        [data]
        generated = 7
        ratios = [0.5, 0.25]
        validation = ["a", "b"]
        [views]
        sizes = [33]
        [loss]
        residual_weight = 0.125
        """,
    )
    assert (config.kind, config.preset, config.steps) == ("local", "paper", 12)
    assert (config.learning_rate, config.note) == (0.25, "two scenes")
    assert (config.data.generated, config.data.ratios) == (7, (0.5, 0.25))
    assert config.data.validation == ("a", "b")
    assert config.views.sizes == (33,)
    assert config.loss.residual_weight == 0.125


def test_an_empty_file_is_the_default(tmp_path):
    assert from_text(tmp_path, "") == TrainConfig()


def test_relative_paths_start_at_the_file(tmp_path):
    text = 'start = "first.safetensors"\n[data]\nfolders = ["scenes", "../more", "/far/away"]'
    config = from_text(tmp_path, text)
    assert config.start == tmp_path / "first.safetensors"
    assert from_text(tmp_path, 'start = "standard"').start == Path("standard")
    assert config.data.folders == (tmp_path / "scenes", tmp_path / "../more", Path("/far/away"))


def test_all_paths_may_be_strings(tmp_path):
    (tmp_path / "training.toml").write_text("steps = 3")
    assert TrainConfig.from_toml(str(tmp_path / "training.toml")).steps == 3


@pytest.mark.parametrize("recipe", sorted(RECIPES.glob("*.toml")), ids=lambda path: path.stem)
def test_each_recipe_is_for_the_preset_of_its_name(recipe):
    assert TrainConfig.from_toml(recipe).preset == recipe.stem.partition("-")[0]


def test_there_are_recipes():
    assert {path.stem for path in RECIPES.glob("*.toml")} == {
        "standard",
        "paper",
        "paper-gated",
        "paper-gated-local",
    }


def test_a_configuration_is_frozen():
    with pytest.raises(pydantic.ValidationError, match="frozen"):
        TrainConfig().steps = 3
    with pytest.raises(pydantic.ValidationError, match="frozen"):
        DataConfig().generated = 3


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("epochs = 3", "epochs: is not a known setting."),
        ("[data]\nfolder = 'x'", "data.folder: is not a known setting."),
        ("[view]\ncount = 3", "view: is not a known setting."),
        ("steps = 9\nrestart_step = 9", "restart_step must be below the 9 steps, found 9."),
        ("width = 1025", "width: input should be less than or equal to 1024, found 1025."),
        ("cell_width = 5000", "cell_width: input should be less than or equal to 4096"),
        ("steps = 0", "steps: input should be greater than or equal to 1, found 0."),
        ("kind = 'both'", "kind: input should be 'scene', 'local' or 'published', found 'both'."),
        ("preset = 'best'", "preset: input should be 'standard' or 'paper', found 'best'."),
        ("learning_rate = 0", "learning_rate: input should be greater than 0, found 0."),
        ("learning_rate = nan", "learning_rate: input should be a finite number, found nan."),
        ("[data]\nratios = [0.1, 1.0]", "data.ratios.1: input should be less than 1, found 1.0."),
        ("[data]\nratios = [2]", "data.ratios.0: input should be less than 1, found 2."),
        ("[views]\nsizes = [10]", "views.sizes.0: input should be greater than or equal to 11"),
        ("[views]\ncrop = 10", "views.crop: input should be greater than or equal to 11"),
        ("[data]\ngenerated_counts = []", "data.generated_counts: tuple should have at least 1"),
        ("[data]\nratios = []", "data.ratios: tuple should have at least 1 item"),
        ("[data]\nvalidation_ratios = []", "data.validation_ratios: tuple should have at least 1"),
        ("[views]\nsizes = []", "views.sizes: tuple should have at least 1 item"),
        (
            "[loss]\nmse_weight = 0\nimage_weight = 0",
            "loss: one of mse_weight, image_weight and ssim_weight must be above 0, found 0 for",
        ),
        (
            "[loss]\nimage_weight = -1",
            "loss.image_weight: input should be greater than or equal to 0, found -1.",
        ),
    ],
)
def test_a_bad_setting_is_named_with_its_file(tmp_path, text, problem):
    with pytest.raises(ConfigError) as caught:
        from_text(tmp_path, text)
    assert str(caught.value).startswith(f"{tmp_path / 'training.toml'}: {problem}")


def test_a_published_training_needs_no_weights(tmp_path):
    text = 'kind = "published"\n[loss]\nmse_weight = 0\nimage_weight = 0'
    assert from_text(tmp_path, text).loss.image_weight == 0


def test_every_problem_is_named(tmp_path):
    with pytest.raises(ConfigError) as caught:
        from_text(tmp_path, "steps = 0\nepochs = 3")
    assert "steps: " in str(caught.value)
    assert "epochs: " in str(caught.value)


@pytest.mark.parametrize("content", [b"steps: 3", b"\xff\xfe"])
def test_a_file_that_is_not_toml_is_an_error(tmp_path, content):
    path = tmp_path / "training.toml"
    path.write_bytes(content)
    with pytest.raises(ConfigError, match="is not a TOML file") as caught:
        TrainConfig.from_toml(path)
    assert str(caught.value).startswith(f"{path}: ")


def test_a_missing_file_is_an_error(tmp_path):
    with pytest.raises(ConfigError, match=r"cannot be read: No such file or directory\.") as caught:
        TrainConfig.from_toml(tmp_path / "none.toml")
    assert str(tmp_path / "none.toml") in str(caught.value)
