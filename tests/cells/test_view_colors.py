"""View-dependent colours in the costs of pairs: only what neighbours have in common counts."""

import math

import pytest
import torch

from block_jobs import unfinished_job
from cvtgs import SimplifyConfig
from cvtgs.analysis import analyze
from cvtgs.cells import gaussian_moments, merge_pairs, view_components
from cvtgs.cells.moments import MAX_COMPONENTS, view_colors
from cvtgs.config import AllocationConfig
from cvtgs.math.spherical_harmonics import LARGEST_COLOR, rest_basis
from scenes import moved, random_scene

COUNT = 2000


def with_bands(bands):
    """A row of Gaussians with these bands."""
    scene = random_scene(len(bands), degree=math.isqrt(bands.shape[1] + 1) - 1)
    places = torch.linspace(0, 1, len(bands))[:, None].expand(-1, 3)
    return scene.with_tensors({"shN": bands.float(), "means": places.contiguous()})


def smooth_bands(count=COUNT):
    """Two coefficients that vary slowly along the row."""
    bands, phase = torch.zeros(count, 15, 3), torch.linspace(0, 6, count)
    bands[:, 1, 0], bands[:, 7, 2] = torch.sin(phase), 0.5 * torch.cos(phase)
    return bands


def noisy_bands(count=COUNT):
    """All coefficients are drawn independently."""
    return 0.5 * torch.randn(count, 15, 3, generator=torch.Generator().manual_seed(0))


def components_of(bands, masses=None):
    scene = with_bands(bands)
    masses = torch.ones(len(bands)) if masses is None else masses
    return scene, view_components(scene, torch.arange(len(bands)), masses)


def test_components_keep_what_neighbours_share():
    scene, components = components_of(smooth_bands())
    assert components.shape == (45, 2)
    found = view_colors(scene.shN[[0, COUNT // 2]], components)
    exact = scene.shN[[0, COUNT // 2]].double().flatten(1) / math.sqrt(4 * math.pi)
    assert torch.allclose((found[0] - found[1]).norm(), (exact[0] - exact[1]).norm(), rtol=1e-3)


def test_squared_distances_are_means_over_all_directions():
    scene, components = components_of(smooth_bands())
    found = view_colors(scene.shN[[10, 900]], components)
    directions = torch.randn(200_000, 3, generator=torch.Generator().manual_seed(1)).double()
    basis = rest_basis(torch.nn.functional.normalize(directions, dim=1), 3)
    difference = basis @ (scene.shN[10] - scene.shN[900]).double()
    mean = difference.square().sum(dim=1).mean()
    assert torch.allclose((found[0] - found[1]).square().sum(), mean, rtol=0.02)


def test_noise_has_no_components():
    assert components_of(noisy_bands())[1].shape[1] == 0


def test_noise_does_not_hide_what_neighbours_share():
    scene, components = components_of(smooth_bands() + 0.2 * noisy_bands())
    found = view_colors(scene.shN, components)
    slow = (found[COUNT // 4] - found[3 * COUNT // 4]).norm()
    fast = (found[1:] - found[:-1]).norm(dim=1).mean()
    assert slow > 3 * fast


def test_there_are_at_most_twelve_components():
    shifts = torch.linspace(0, 40, COUNT)[:, None, None] * torch.rand(1, 15, 3)
    components = components_of(torch.sin(shifts))[1]
    assert components.shape[1] == MAX_COMPONENTS


def test_a_turn_does_not_change_distances():
    scene, components = components_of(smooth_bands() + 0.2 * noisy_bands())
    turned = moved(scene, quat=(0.9, 0.1, -0.3, 0.2))
    rows = torch.arange(COUNT)
    found = view_components(turned, rows, torch.ones(COUNT))
    first = torch.pdist(view_colors(scene.shN[rows[::50]], components))
    second = torch.pdist(view_colors(turned.shN[rows[::50]], found))
    assert torch.allclose(first, second, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("width", [0, 3, 8, 15])
def test_scenes_without_common_bands_have_no_components(width):
    bands = torch.full((50, width, 3), 0.3)
    assert components_of(bands)[1].shape == (3 * width, 0)


def test_hard_values_give_finite_components():
    bands = smooth_bands(300)
    bands[::7] = 1e30
    bands[::11] = -3e38
    masses = torch.zeros(300)
    masses[5:9] = 1e30
    for weights in (torch.ones(300), masses, torch.zeros(300)):
        scene, components = components_of(bands, weights)
        assert bool(components.isfinite().all())
        for directions in (components, torch.eye(45)):
            colors = view_colors(scene.shN[:300], directions)
            assert bool(colors.isfinite().all())
            assert float(colors.norm(dim=1).amax()) < LARGEST_COLOR + 1e-6
    assert components_of(bands[:1])[1].shape == (45, 0)


@pytest.mark.parametrize(("weight", "together"), [(2.0, [0, 0, 1]), (0.0, [0, 1, 1])])
def test_pairs_with_like_view_dependent_colours_merge_first(weight, together):
    """The middle one is a little nearer to the last one, but reflects light as the first does."""
    bands = smooth_bands()
    scene, components = components_of(bands)
    rows = torch.tensor([0, 20, COUNT - 1])
    places = torch.tensor([[0.0, 0, 0], [1.0, 0, 0], [1.99, 0, 0]])
    three = scene.select(rows).with_tensors({
        "means": places,
        "sh0": torch.zeros(3, 1, 3),
        "log_scales": torch.full((3, 3), -4.0),
        "logit_opacities": torch.zeros(3),
    })  # fmt: skip
    moments = gaussian_moments(
        three,
        torch.arange(3),
        analyze(three, SimplifyConfig()).frame,
        masses=torch.ones(3),
        apparent_masses=torch.ones(3),
        components=components,
    )
    others = torch.tensor([[1, 2], [0, 2], [0, 1]])
    labels = merge_pairs(moments, others, 2, AllocationConfig(view_color=weight))
    assert labels.tolist() == together


def test_blocks_compare_the_same_components(tmp_path):
    job = unfinished_job(with_bands(smooth_bands()), tmp_path, count=200, blocks=4)
    assert job.read_scan().view_components.shape == (45, 2)


def test_the_variance_that_neighbours_have_in_common_by_hand():
    """Variance 2.5 / 5 = 0.5; half the mean squared step, (0.25 + 1 + 0.25) / 6 = 0.25."""
    bands = torch.zeros(4, 3, 3)
    bands[:, 0, 0] = torch.tensor([-1.0, -0.5, 0.5, 1.0])
    scene = random_scene(4, degree=1).with_tensors({"shN": bands}, {})
    found = view_components(scene, torch.arange(4), torch.ones(4))
    assert found.shape == (9, 1)
    assert float(found.abs().amax()) == pytest.approx(math.sqrt(0.5))
