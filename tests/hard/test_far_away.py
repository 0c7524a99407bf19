"""Geo-referenced scenes in float32: what is lost is said, with the shift that would keep it."""

import warnings

import pytest
import torch

import cvtgs
from cvtgs.cli.main import main
from scenes import random_scene


def moved(shift: tuple[float, float, float], dtype: torch.dtype = torch.float32):
    tensors = random_scene(50, degree=0).tensors()
    tensors["means"] = tensors["means"].double() + torch.tensor(shift).double()
    return cvtgs.GaussianScene(**{name: values.to(dtype) for name, values in tensors.items()})


@pytest.mark.parametrize("where", [(0.0, 0.0, 0.0), (9e5, 0.0, -9e5)])
def test_near_scenes_are_not_warned_of(where):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        cvtgs.validity.warn_of_lost_digits(moved(where))
        cvtgs.validity.warn_of_lost_digits(moved((0.0, 5e6, 0.0), torch.float64))
        cvtgs.validity.warn_of_lost_digits(moved(where)[:0])


def test_far_scenes_are(tmp_path, capsys):
    scene = moved((500_000.0, 5_400_000.0, 0.0))
    with pytest.warns(UserWarning, match=r"keeps steps of 0\.5 only: digits are lost") as caught:
        cvtgs.validity.warn_of_lost_digits(scene)
    assert "shifted by -500000,-5400000," in str(caught[0].message).replace("-5399999", "-5400000")
    cvtgs.save(scene, tmp_path / "a.ply")
    assert main(["info", str(tmp_path / "a.ply")]) == 0
    assert "cvtgs: warning: positions lie 5.4e+06 from the origin" in capsys.readouterr().err


def test_a_few_flyaways_are_no_far_scene():
    scene = moved((0.0, 0.0, 0.0))
    means = scene.means.clone()
    means[:5] = 1e9
    means[5:8] = torch.nan
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        cvtgs.validity.warn_of_lost_digits(scene.with_tensors({"means": means}, {}))
