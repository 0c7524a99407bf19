"""Large hard cases; their time is compared with that of an easy scene."""

import time
import warnings

import pytest
import torch

import cvtgs
from cvtgs import Simplifier
from cvtgs.cells import Partition, merge_cells
from cvtgs.cli.main import main
from cvtgs.config import SimplifyConfig
from hard_cases import CASES
from hard_scenes import ball, simplifier
from scenes import assert_standard, random_scene

LARGE = 100_000


def timed(run, scene, count):
    start = time.process_time()
    result = run(scene, count=count)
    return result, time.process_time() - start


@pytest.fixture(scope="module")
def easy():
    """Return the CPU seconds of the faster of two runs with an easy scene."""
    scene, runs = ball(LARGE, torch.float32), Simplifier(None, device="cpu")
    return min(timed(runs.run, scene, 10_000)[1] for _ in range(2))


@pytest.mark.slow
@pytest.mark.parametrize("preset", ["standard", "paper"])
@pytest.mark.parametrize("name", ["coincident", "far_flyaways", "duplicates"])
def test_hard_cases_take_at_most_ten_times_an_easy_scene(name, preset, easy):
    """Comparing all pairs takes 30 times and more; benchmarks/numerics.py measures times."""
    scene = CASES[name](LARGE, torch.float32)
    run = Simplifier(None, config=preset, device="cpu").run
    (small, report), seconds = timed(run, scene, 10_000)
    assert len(small) == report.output_count == 10_000
    assert_standard(small)
    assert seconds < 10 * easy + 1


@pytest.mark.slow
def test_a_hundred_thousand_equal_gaussians_are_simplified():
    """They are equal in every property, so nothing can separate them."""
    scene = ball(1, torch.float32).select(torch.zeros(LARGE, dtype=torch.int64))
    small, report = simplifier("paper").run(scene, count=1000)
    assert len(small) == 1000
    assert_standard(small)
    assert report.energy == 0
    torch.testing.assert_close(small.means, scene.means[:1000])


@pytest.mark.slow
def test_a_cell_of_a_million_members_is_merged_accurately():
    """Its moments match float64 sums; cells of one member keep it bit for bit."""
    million = 1_000_000
    scene = ball(1000, torch.float32)
    scene = scene.with_tensors({"shN": scene.shN[:, :0]}, {})
    g = torch.Generator().manual_seed(2)
    rows = torch.randint(0, 1000, (million,), generator=g)
    crowd = scene.select(torch.cat([rows, torch.arange(10)]))
    labels = torch.cat([torch.zeros(million, dtype=torch.int64), 1 + torch.arange(10)])
    config = SimplifyConfig.from_preset("standard").merge
    small = merge_cells(crowd, Partition.from_labels(labels, 11), config=config)
    assert torch.equal(small.means[1:], scene.means[:10])
    assert torch.equal(small.log_scales[1:], scene.log_scales[:10])
    weights = torch.bincount(rows, minlength=1000) * scene.masses
    weights = weights / weights.sum()
    mean = weights @ scene.means.double()
    torch.testing.assert_close(small.means[0].double(), mean, rtol=0, atol=1e-6)
    color = weights @ scene.sh0[:, 0].double()
    torch.testing.assert_close(small.sh0[0, 0].double(), color, rtol=1e-5, atol=1e-6)
    assert_standard(small.select(torch.tensor([0])))


@pytest.mark.long
def test_a_scene_with_one_huge_cell_is_simplified():
    scene = CASES["crowd_beside_loners"](1_000_000, torch.float32)
    scene = scene.with_tensors({"shN": scene.shN[:, :0]}, {})
    small, report = simplifier("standard").run(scene, count=11)
    assert len(small) == 11
    assert report.largest_cell > 100_000
    assert_standard(small)


def moved(shift: tuple[float, float, float], dtype: torch.dtype = torch.float32):
    tensors = random_scene(50, degree=0).tensors()
    tensors["means"] = tensors["means"].double() + torch.tensor(shift).double()
    return cvtgs.GaussianScene(**{name: values.to(dtype) for name, values in tensors.items()})


@pytest.mark.parametrize("where", [(0.0, 0.0, 0.0), (9e5, 0.0, -9e5)])
def test_scenes_near_the_origin_give_no_warning(where):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        cvtgs.validity.warn_of_lost_digits(moved(where))
        cvtgs.validity.warn_of_lost_digits(moved((0.0, 5e6, 0.0), torch.float64))
        cvtgs.validity.warn_of_lost_digits(moved(where)[:0])


def test_scenes_far_from_the_origin_are_warned_about(tmp_path, capsys):
    scene = moved((500_000.0, 5_400_000.0, 0.0))
    match = r"resolves steps of 0\.5: precision is already lost"
    with pytest.warns(UserWarning, match=match) as caught:
        cvtgs.validity.warn_of_lost_digits(scene)
    with pytest.warns(UserWarning, match=match):
        cvtgs.validity.warn_of_lost_digits(moved((0.0, -5_400_000.0, 0.0)))
    assert "shifted by -500000,-5400000," in str(caught[0].message).replace("-5399999", "-5400000")
    cvtgs.save(scene, tmp_path / "a.ply")
    assert main(["info", str(tmp_path / "a.ply")]) == 0
    assert "cvtgs: warning: positions lie 5.4e+06 from the origin" in capsys.readouterr().err


def test_a_few_flyaways_give_no_warning_of_a_far_scene():
    scene = moved((0.0, 0.0, 0.0))
    means = scene.means.clone()
    means[:5] = 1e9
    means[5:8] = torch.nan
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        cvtgs.validity.warn_of_lost_digits(scene.with_tensors({"means": means}, {}))


def test_the_largest_view_dependent_colours_of_a_sog_can_be_read_back(tmp_path):
    """The mean of two float32 values of 2e38 is finite, their sum is not."""
    scene = random_scene(2000, degree=1)
    signs = torch.where(torch.arange(scene.shN.numel()).view(scene.shN.shape) % 3 > 0, 2e38, -2e38)
    cvtgs.save(scene.with_tensors(shN=signs), tmp_path / "a.sog")
    assert len(cvtgs.load(tmp_path / "a.sog")) == 2000
