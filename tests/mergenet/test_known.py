"""The known range: hand-computed shares, and no correction where a network cannot know."""

import math
from dataclasses import replace

import pytest
import torch

from cvtgs import GaussianScene
from cvtgs.mergenet import KnownRange, summarize
from cvtgs.mergenet.known import MARGIN, MEMBERS, NARROWEST, SUMMARY_FEATURES
from mergenet_cases import case_of, fields_of, lively_net, some_case, some_labels
from scenes import random_scene


def rows(*values: float) -> torch.Tensor:
    return torch.tensor(values)[:, None].repeat(1, SUMMARY_FEATURES)


def fitted(*cases: torch.Tensor) -> KnownRange:
    known = KnownRange()
    known.fit(cases)
    return known


def test_shares_by_hand():
    known = fitted(rows(0.0, 0.3, 0.5, 1.0))
    assert float(known.margin[0]) == pytest.approx(MARGIN)
    found = known(rows(-1.0, -0.1, -0.025, 0.0, 0.5, 1.0, 1.05, 1.1, 1e9)).tolist()
    assert found == pytest.approx([0, 0, 0.75, 1, 1, 1, 0.5, 0, 0], abs=1e-5)
    assert found[0] == found[-1] == 0.0
    assert found[3:6] == [1.0, 1.0, 1.0]


def test_the_farthest_feature_decides():
    known = fitted(rows(0.0, 1.0))
    one = rows(0.5)
    one[0, 3], one[0, 5] = 1.0 + MARGIN / 2, -MARGIN / 4
    assert known(one).tolist() == pytest.approx([0.5], abs=1e-5)


def test_a_feature_that_never_varied_has_a_margin():
    known = fitted(rows(1.5, 1.5))
    found = known(rows(1.5, 1.5 + NARROWEST / 2, 1.6)).tolist()
    assert found == pytest.approx([1.0, 0.5, 0.0], abs=1e-4)


def test_tails_of_a_case_do_not_count_but_a_small_case_does():
    """200 cells: two at each end are its tails. A case of one cell has a say all the same."""
    large = rows(*[-90.0, -80.0], *torch.linspace(0, 1, 196).tolist(), *[80.0, 90.0])
    known = fitted(large, rows(3.0))
    assert (float(known.low[0]), float(known.high[0])) == (0.0, 3.0)


def test_cells_of_thousands_of_members_are_never_known():
    """The range ends at 2000 members; corrections vanish over a tenth of its logarithm."""
    learned = rows(0.0, 0.1 * math.log(2000), 9.0)
    learned[:, :MEMBERS], learned[:, MEMBERS + 1 :] = 0.0, 0.0
    known = fitted(learned)
    seen = torch.zeros(5, SUMMARY_FEATURES)
    counts = torch.tensor([2.0, 2000.0, 2000.0**1.05, 2000.0**1.11, 1e6])
    seen[:, MEMBERS] = 0.2 * counts.log()
    assert known(seen).tolist() == pytest.approx([1.0, 1.0, 0.5, 0.0, 0.0], abs=1e-3)


def test_that_feature_is_the_number_of_members():
    scene = random_scene(60, degree=0, dtype=torch.float64, seed=0, size=0.4)
    seen = case_of(scene, torch.arange(60) % 2).describe()
    assert seen.cells[:, MEMBERS].tolist() == pytest.approx([0.2 * math.log(30)] * 2)


def test_nothing_is_unknown_before_a_training():
    assert KnownRange()(rows(-1e9, 0.0, 1e9)).tolist() == [1.0, 1.0, 1.0]


@pytest.mark.parametrize("near", [0, 8])
def test_summaries_are_those_of_the_cell_and_weighted_means(near):
    seen = some_case(near=near).describe()
    found = summarize(seen)
    assert found.shape == (len(seen), SUMMARY_FEATURES)
    start, end = seen.offsets[3:5].tolist()
    members = (seen.members[start:end] * seen.weights[start:end, None]).sum(dim=0)
    others = seen.pairs[3].mean(dim=0) if near else torch.zeros(seen.pairs.shape[2])
    wanted = torch.cat([seen.cells[3], members, others])
    torch.testing.assert_close(found[3], wanted, atol=1e-12, rtol=1e-12)


def yard(huge: bool) -> GaussianScene:
    """Small Gaussians; with ``huge``, the first is a faint one of a far sky."""
    scene = random_scene(60, degree=1, dtype=torch.float64, seed=0, size=0.4)
    if not huge:
        return scene
    means, logs, logits = (
        values.clone() for values in (scene.means, scene.log_scales, scene.logit_opacities)
    )
    means[0] = torch.tensor([300.0, -200.0, 100.0])
    logs[0], logits[0] = 5.0, -4.0
    return replace(scene, means=means, log_scales=logs, logit_opacities=logits)


def test_no_residual_for_a_cell_with_a_huge_far_faint_member():
    labels, net = some_labels(60, 12), lively_net()
    usual, odd = (case_of(yard(huge), labels, near=0) for huge in (False, True))
    before = fields_of(net(odd.describe()))
    net.known.fit([summarize(usual.describe())])
    cell = int(labels[0])
    after = fields_of(net(odd.describe()))
    members = slice(*odd.part.offsets[cell : cell + 2].tolist())
    for name, values in after.items():
        if values.numel():
            own = members if name == "member_colors" else cell
            assert not bool(values[own].any())
            assert bool(before[name][own].any())
    corrected = odd.correct(net)
    for name, values in odd.merged.tensors().items():
        assert torch.equal(getattr(corrected, name)[cell], values[cell])
    others = torch.arange(12) != cell
    assert not torch.equal(corrected.means[others], odd.merged.means[others])


def test_cells_that_it_learned_from_keep_their_residuals():
    case, net = some_case(), lively_net()
    before = fields_of(net(case.describe()))
    net.known.fit([summarize(case.describe())])
    after = fields_of(net(case.describe()))
    assert all(torch.equal(before[name], after[name]) for name in before)
