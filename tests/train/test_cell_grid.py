"""Cell grids: cells side by side, each in a tile of its own."""

import random
from itertools import pairwise

import pytest
import torch
from torch import Tensor

from cvtgs import GaussianScene
from cvtgs.rendering import render
from cvtgs.train.cases import Case, MergedScene, describe_case
from cvtgs.train.losses import TILE, CellGrid, lay_out_cells
from mergenet_cases import Case as Cells, case_of, fields_of, lively_net
from scenes import covariances_of, random_scene
from train_cases import small_net, some_case

SIDE = 4


def as_case(cells: Cells) -> Case:
    light = cells.visibility.to(cells.scene.dtype)
    reference = MergedScene(
        cells.scene, cells.merged, cells.part, cells.neighbors, light, radius=4.0
    )
    return describe_case("made", 0.1, reference, cells.part.several())


def twins(cells: int = 16) -> Case:
    """Cells of two equal members of half the depth each; their moments are those of a member."""
    single = random_scene(cells, degree=0)
    opacities = single.opacities
    half = torch.logit(1 - (1 - opacities).sqrt())
    scene = single.select(torch.arange(cells).repeat(2))
    scene = scene.with_tensors({"logit_opacities": half.repeat(2)}, {})
    return as_case(case_of(scene, torch.arange(cells).repeat(2), near=4))


def grid_of(case: Case, *, seed: int = 0, changed: dict[str, Tensor] | None = None) -> CellGrid:
    same = case.reference.merged.select(case.cells).tensors()
    return lay_out_cells(
        case.reference, case.cells, case.part, changed or same, rng=random.Random(seed)
    )


def image(scene: GaussianScene, grid: CellGrid) -> Tensor:
    return render(scene, grid.camera, background=torch.zeros(3)).rgb[0]


def sixteen(case: Case) -> Case:
    return case.select(torch.arange(SIDE * SIDE))


def tile_of(number: int) -> tuple[slice, slice]:
    row, column = divmod(number, SIDE)
    return (
        slice(row * TILE, (row + 1) * TILE),
        slice(column * TILE, (column + 1) * TILE),
    )


def test_equal_members_and_their_cell_look_the_same():
    grid = grid_of(twins())
    members, merged = image(grid.members, grid), image(grid.corrected, grid)
    assert float(members.amax()) > 0.3
    assert float((members - merged).abs().mean()) < 0.01


@pytest.mark.parametrize("count", [1, 2, 4, 5, 9, 10])
@pytest.mark.slow
def test_there_is_a_tile_for_every_cell(count):
    case = some_case(1500, ratio=0.1).select(torch.arange(count))
    grid = grid_of(case)
    side = {1: 1, 2: 2, 4: 2, 5: 3, 9: 3, 10: 4}[count]
    assert (grid.camera.width, grid.camera.height) == (side * TILE, side * TILE)
    assert len(grid.corrected) == count
    assert len(grid.members) == len(case.part.order)


def test_cells_lie_in_their_tiles_of_comparable_size():
    grid = grid_of(sixteen(some_case(1500, ratio=0.1)))
    numbers = torch.arange(SIDE * SIDE)
    middles = torch.stack([numbers % SIDE, numbers // SIDE], dim=1) + 0.5 - SIDE / 2
    steps = grid.corrected.means[:, :2] - middles
    assert float(steps.abs().amax()) <= 0.15 + 1e-5
    assert len({tuple(step) for step in steps.tolist()}) == SIDE * SIDE
    largest = grid.corrected.scales.amax(dim=1)
    assert bool((largest > 0.7 / 7).all())
    assert bool((largest < 1.42 / 7).all())


def test_a_cell_paints_its_own_tile():
    """Each cell rendered by itself: hardly anything of it falls into the tiles of others."""
    grid = grid_of(sixteen(some_case(1500, ratio=0.1)))
    for number in range(SIDE * SIDE):
        light = image(grid.corrected.select(torch.tensor([number])), grid).sum(dim=2)
        assert float(light[tile_of(number)].sum()) > 0.95 * float(light.sum()) > 0


def test_members_stay_with_their_cell():
    case = sixteen(some_case(1500, ratio=0.1))
    grid = grid_of(case)
    for number, (first, last) in enumerate(pairwise(case.part.offsets.tolist())):
        steps = grid.members.means[first:last] - grid.corrected.means[number]
        reach = 4 * grid.corrected.scales[number].amax()
        assert float(torch.linalg.vector_norm(steps, dim=1).median()) < reach


def test_a_layout_turns_and_scales_and_nothing_else():
    """Distances relative to scales, relative shapes, opacities and colours stay the same."""
    case = sixteen(some_case(1500, ratio=0.1))
    grid, own = grid_of(case), case.reference.merged.select(case.cells)
    members = case.reference.scene.select(case.part.order)
    ids = torch.repeat_interleave(torch.arange(len(own)), case.part.counts)
    for before, after, rows in ((own, grid.corrected, slice(None)), (members, grid.members, ids)):
        zooms = (grid.corrected.scales / own.scales)[:, 0][rows]
        torch.testing.assert_close(after.scales, before.scales * zooms[:, None])
        old = (before.means - own.means[rows]) * zooms[:, None]
        new = after.means - grid.corrected.means[rows]
        lengths = [torch.linalg.vector_norm(steps, dim=1) for steps in (old, new)]
        torch.testing.assert_close(*lengths, rtol=1e-3, atol=1e-4)
        seen = [
            torch.einsum("ni,nij,nj->n", steps.double(), covariances_of(shapes), steps.double())
            for steps, shapes in ((old, before), (new, after))
        ]
        torch.testing.assert_close(seen[1], seen[0] * zooms.double() ** 2, rtol=1e-2, atol=1e-6)
        assert torch.equal(after.logit_opacities, before.logit_opacities)
        assert torch.equal(after.sh0, before.sh0)
        assert after.sh_degree == 0


def test_the_seed_decides_the_grid():
    case = twins()
    first, again, other = (grid_of(case, seed=seed) for seed in (0, 0, 1))
    assert torch.equal(first.members.means, again.members.means)
    assert not torch.equal(first.members.means, other.members.means)
    assert not torch.equal(first.members.log_scales, other.members.log_scales)


@pytest.mark.parametrize("net", [small_net(), lively_net(torch.float32)], ids=["new", "lively"])
def test_gradients_flow_into_the_corrected_tensors(net):
    case = sixteen(some_case(1500, ratio=0.1))
    changed = {
        name: values.detach().requires_grad_()
        for name, values in case.correct_cells(net(case.descriptors)).items()
    }
    grid = grid_of(case, changed=changed)
    (image(grid.corrected, grid) - image(grid.members, grid)).square().sum().backward()
    for name in ("means", "quats", "log_scales", "logit_opacities", "sh0"):
        grad = changed[name].grad
        assert bool(grad.isfinite().all())
        assert float((grad.reshape(len(grad), -1) != 0).any(dim=1).double().mean()) > 0.9
    assert not grid.members.means.requires_grad


def test_gradients_flow_into_the_residuals():
    case, net = sixteen(some_case(1500, ratio=0.1)), small_net()
    residuals = net(case.descriptors)
    for values in fields_of(residuals).values():
        values.retain_grad()
    grid = grid_of(case, changed=case.correct_cells(residuals))
    (image(grid.corrected, grid) - image(grid.members, grid)).square().sum().backward()
    assert all(bool((values.grad != 0).any()) for values in fields_of(residuals).values())


@pytest.mark.parametrize("log_scale", [-80.0, -40.0, 20.0, 40.0])
def test_cells_of_any_size(log_scale):
    """Everything scaled, so the images are those of the cells of size 1."""
    scene = random_scene(12, degree=0, size=0.5)
    factor = torch.exp(torch.tensor(log_scale))
    far = scene.with_tensors(
        {"means": scene.means * factor, "log_scales": scene.log_scales + log_scale}, {}
    )
    grids = [grid_of(as_case(case_of(one, torch.arange(12) % 4, near=3))) for one in (scene, far)]
    images = [image(some.members, some) for some in grids]
    torch.testing.assert_close(images[1], images[0], rtol=0, atol=2e-2)
