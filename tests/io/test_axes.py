"""Conversion of scenes from and to the axes of files, colours included."""

import itertools
from pathlib import Path

import pytest
import torch

from cvtgs import GaussianScene, load, save
from cvtgs.errors import InvalidArgumentError
from cvtgs.io import change_axes
from cvtgs.io.axes import AXES
from cvtgs.math.parameters import build_covariances, normalize_quats
from cvtgs.math.spherical_harmonics import rest_basis
from scenes import moved, random_scene, same_bits

LETTERS = {"r": (0, 1), "l": (0, -1), "u": (1, 1), "d": (1, -1), "b": (2, 1), "f": (2, -1)}
HALF_TURNS = {"rub": (0, 1, 0, 0), "ldb": (0, 0, 1, 0), "luf": (0, 0, 0, 1)}
QUARTER_TURNS = {"rbd": (1, 1, 0, 0), "rfu": (1, -1, 0, 0)}


def matrix_of(source: str, target: str) -> torch.Tensor:
    """Return the matrix between axes, coordinate by coordinate."""
    matrix = torch.zeros(3, 3, dtype=torch.float64)
    for row, letter in enumerate(target):
        axis, sign = LETTERS[letter]
        for column, other in enumerate(source):
            if LETTERS[other][0] == axis:
                matrix[row, column] = sign * LETTERS[other][1]
    return matrix


def shapes_of(scene: GaussianScene) -> torch.Tensor:
    return build_covariances(scene.scales, normalize_quats(scene.quats))


@pytest.mark.parametrize(("axes", "quat"), [*(HALF_TURNS | QUARTER_TURNS).items()])
def test_changed_axes_match_the_oracle(axes: str, quat: tuple[int, ...]) -> None:
    scene = random_scene(40, degree=3)
    turned, oracle = change_axes(scene, "rdf", axes), moved(scene, quat=quat)
    for name in ("means", "log_scales", "sh0", "shN"):
        torch.testing.assert_close(getattr(turned, name), getattr(oracle, name))
    torch.testing.assert_close(shapes_of(turned), shapes_of(oracle))


@pytest.mark.parametrize(("source", "target"), [*itertools.product(("rdf", "lfu", "ruf"), AXES)])
def test_centres_shapes_and_colours_change_consistently(source: str, target: str) -> None:
    """For all 16 axes, also mirrored ones: the turned direction shows the same colour."""
    scene = random_scene(20, degree=3, dtype=torch.float64)
    turned, matrix = change_axes(scene, source, target), matrix_of(source, target)
    torch.testing.assert_close(turned.means, scene.means @ matrix.T, rtol=0, atol=0)
    torch.testing.assert_close(shapes_of(turned), matrix @ shapes_of(scene) @ matrix.T)
    directions = torch.nn.functional.normalize(scene.means, dim=1)
    before = (rest_basis(directions, 3)[:, :, None] * scene.shN).sum(dim=1)
    after = (rest_basis(directions @ matrix.T, 3)[:, :, None] * turned.shN).sum(dim=1)
    torch.testing.assert_close(after, before, rtol=1e-12, atol=1e-12)


def test_autocast_does_not_round_turned_scenes() -> None:
    scene = random_scene(20, degree=2)
    wanted = change_axes(scene, "rdf", "rfu")
    with torch.autocast("cpu", torch.bfloat16):
        assert same_bits(change_axes(scene, "rdf", "rfu"), wanted)


@pytest.mark.parametrize("axes", AXES[:8])
def test_only_signs_change_if_no_axes_are_swapped(axes: str) -> None:
    scene = random_scene(20, degree=2)
    turned = change_axes(scene, "rdf", axes)
    for name, tensor in scene.tensors().items():
        assert torch.equal(turned.tensors()[name].abs(), tensor.abs()), name
    assert same_bits(change_axes(turned, axes, "rdf"), scene)
    assert change_axes(scene, "rdf", "RDF") is scene


@pytest.mark.parametrize("end", ["ply", "compressed.ply", "spz", "splat", "sog"])
def test_every_format_accepts_axes(tmp_path: Path, end: str) -> None:
    scene = random_scene(50, degree=0)
    scene = scene.with_tensors({"sh0": scene.sh0.clamp(-1.7, 1.7)}, {})
    save(scene, tmp_path / f"a.{end}")
    save(scene, tmp_path / f"b.{end}", axes="rub")
    plain, other = load(tmp_path / f"a.{end}"), load(tmp_path / f"b.{end}", axes="rub")
    nearest = torch.cdist(plain.means, other.means).amin(dim=1)  # some formats sort
    assert float(nearest.max()) < 0.01
    stored = load(tmp_path / f"b.{end}", axes="rdf")
    assert torch.equal(stored.means, other.means * torch.tensor([1, -1, -1]))


def test_unknown_axes_are_refused_before_anything_is_read(tmp_path: Path) -> None:
    text = r"axes must be the directions of x, y and z, .* found 'xyz'"
    with pytest.raises(InvalidArgumentError, match=text):
        load(tmp_path / "missing.ply", axes="xyz")
    with pytest.raises(InvalidArgumentError, match=text):
        save(random_scene(2), tmp_path / "a.ply", axes="xyz")
    with pytest.raises(InvalidArgumentError, match="found ''"):
        save(random_scene(2), tmp_path / "a.ply", axes="")
    with pytest.raises(InvalidArgumentError, match=r"found 'rrf'"):
        change_axes(random_scene(2), "rrf", "rdf")
    assert not list(tmp_path.iterdir())
