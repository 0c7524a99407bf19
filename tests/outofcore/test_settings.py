"""Every setting that changes a result in one piece changes one in several blocks, too."""

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch

import cvtgs
from cvtgs import Simplifier, SimplifyConfig, synthetic
from cvtgs.outofcore import simplify_file
from cvtgs.report import CellStatistics
from cvtgs.tags import ANTIALIASED

RHO, COUNT = 0.012, 2500

OTHERS = {
    "effects.sh": 0,
    "effects.mip": "off",
    "effects.unbounded": "off",
    "effects.haze": "off",
    "effects.clamping": "off",
    "filter.min_opacity": 0.0,
    "filter.max_mass_share": 0.2,
    "filter.max_flyaway_share": 0.0,
    "cvt.area_power": 1.0,
    "cvt.perspective": False,
    "cvt.hidden_share": 1.0,
    "cvt.weight_floor": 2.0,
    "cvt.color": 0.5,
    "cvt.color_power": 0.1,
    "cvt.seeding": "weighted",
    "cvt.iterations": 0,
    "cvt.tolerance": 0.5,
    "allocation.oversampling": 4.0,
    "allocation.neighbors": 2,
    "allocation.color": 1.0,
    "allocation.color_power": 0.0,
    "allocation.view_color": 0.0,
    "allocation.mass_power": 1.0,
    "allocation.far_relief": 1.0,
    "allocation.widest": 0.01,
    "allocation.heaviest": 0.1,
    "allocation.far_gain": 1.0,
    "allocation.reassign": False,
    "merge.area_power": 0.0,
    "merge.opacity": "union",
    "merge.representatives": False,
    "merge.inflation": 0.5,
    "merge.covered_inflation": 0.9,
    "merge.network": False,
    "merge.image_size": 100,
}
"""Another value of each setting, with another result."""

NOT_HERE = {
    "effects.flat": "needs a file of two scales",
    "effects.duplicates": "changes only the time",
    "effects.extras": "needs extra columns",
    "effects.visibility": "needs a preset with images",
    "cvt.samples_per_site": "needs more than 32,768 Gaussians",
    "merge.align_axes": "needs cells with axes of equal length",
}
IMAGES = ("visibility", "match", "refine")  # sections of stages on images


def settings() -> dict[str, object]:
    """Return the defaults of the stages without images, by dotted key."""
    sections = SimplifyConfig().model_dump(exclude={"preset", "seed", *IMAGES})
    return {
        f"{name}.{key}": value for name, keys in sections.items() for key, value in keys.items()
    }


def test_every_setting_has_another_value_to_test_in_blocks():
    defaults = settings()
    missing = sorted(defaults.keys() - OTHERS.keys() - NOT_HERE.keys())
    assert not missing, f"add another value to OTHERS in {__file__}, or a reason to NOT_HERE"
    assert sorted({*OTHERS, *NOT_HERE} - defaults.keys()) == []
    assert [key for key, value in OTHERS.items() if value == defaults[key]] == []


@pytest.fixture(scope="module")
def scene() -> cvtgs.GaussianScene:
    """Return a scene with all effects: sky, haze, flyaways, dark colours, highlights, a tag."""
    made = synthetic.scene("landscape", COUNT, sh_degree=1, seed=5)
    tensors = {name: values.clone() for name, values in made.tensors().items()}
    means, log_scales, logits, sh0, rest = (
        tensors[name] for name in ("means", "log_scales", "logit_opacities", "sh0", "shN")
    )
    rest[:, 0] = 0.3 * means.sign()
    logits[1::4], log_scales[1::4] = -5.4, log_scales[1::4] + 2.0
    sh0[::3] -= 1.5
    means[::200], logits[::200] = 1e4 * means[::200], -5.0
    return replace(made.with_tensors(tensors), comments=(ANTIALIASED.text,))


Results = Callable[[dict[str, object]], list[torch.Tensor]]


@pytest.fixture(scope="module")
def in_piece(scene: cvtgs.GaussianScene) -> Results:
    def run(values: dict[str, object]) -> list[torch.Tensor]:
        simplifier = Simplifier(config=SimplifyConfig.from_mapping(values), device="cpu")
        return [*simplifier.simplify(scene, RHO).tensors().values()]

    return run


@pytest.fixture(scope="module")
def in_blocks(scene: cvtgs.GaussianScene, tmp_path_factory: pytest.TempPathFactory) -> Results:
    folder = tmp_path_factory.mktemp("blocks")
    source, target = folder / "in.ply", folder / "out.ply"
    cvtgs.save(scene, source)

    def run(values: dict[str, object]) -> list[torch.Tensor]:
        simplifier = Simplifier(config=SimplifyConfig.from_mapping(values), device="cpu")
        simplify_file(source, target, RHO, blocks=3, simplifier=simplifier, overwrite=True)
        return [*cvtgs.load(target).tensors().values()]

    return run


@pytest.fixture(scope="module")
def usual(in_piece: Results, in_blocks: Results) -> dict[str, list[torch.Tensor]]:
    return {"piece": in_piece({}), "blocks": in_blocks({})}


@pytest.mark.slow
@pytest.mark.parametrize("key", OTHERS)
def test_a_setting_applies_in_blocks(key: str, usual, in_piece: Results, in_blocks: Results):
    section, name = key.split(".")
    values: dict[str, object] = {section: {name: OTHERS[key]}}
    if all(map(torch.equal, in_piece(values), usual["piece"])):
        pytest.fail(f"{key}: give a value in OTHERS that changes this scene in one piece")
    if all(map(torch.equal, in_blocks(values), usual["blocks"])):
        pytest.fail(f"{key}: changes a scene in one piece, but has no effect in several blocks")


@pytest.mark.slow
def test_every_statistic_of_cells_is_reported_of_blocks(scene, tmp_path):
    whole = Simplifier(device="cpu").run(scene, RHO).report
    cvtgs.save(scene, tmp_path / "in.ply")
    found = simplify_file(tmp_path / "in.ply", tmp_path / "out.ply", RHO, blocks=3)
    for name, field in CellStatistics.model_fields.items():
        if getattr(whole, name) != field.default:
            text = f"{name}: write it in outofcore/merge.py, add it up in report_blocks"
            assert getattr(found, name) != field.default, text
