"""Which neighbours lend their colours to a cell."""

import math
from dataclasses import replace

import torch
from torch import Tensor

from cvtgs.cells.descriptors import AREA, AREA_SCALE, DISTANCE, DISTANCE_BACK
from cvtgs.mergenet import Architecture, MergeNet
from cvtgs.mergenet.model import LEAST_AREA
from mergenet_cases import some_case


def check_lent(pairs: Tensor, wanted: list[float]) -> None:
    """Check the shares of what the neighbours of every cell lend, with gates that are all equal."""
    seen, net = some_case().describe(), MergeNet(Architecture()).double()
    with torch.no_grad():
        net.pair_gates.gates.bias[:] = 1.0
        found = net(replace(seen, pairs=pairs))
    whole = 0.5 / 8 * math.tanh(1.0) * torch.tensor(wanted).double()
    torch.testing.assert_close(found.pair_colors, whole.expand(len(seen), 8))
    assert bool(found.d_means.any())  # they still move the cell


def test_neighbours_that_are_far_smaller_lend_no_colour():
    """What they lend fades out over a factor of e in area."""
    pairs = some_case().describe().pairs.clone()
    pairs[:, :4, AREA] = AREA_SCALE * (LEAST_AREA + torch.tensor([-5.0, 0.0, 0.25, 1.0]))
    pairs[:, 4:, AREA] = AREA_SCALE * torch.tensor([0.0, 3.0, 9.0, 14.0])
    check_lent(pairs, [0.0, 0.0, 0.25, 1.0, 1.0, 1.0, 1.0, 1.0])


def test_neighbours_that_are_far_away_lend_no_colour():
    """What they lend fades out over one standard deviation, of whichever Gaussian is larger."""
    pairs = some_case().describe().pairs.clone()
    pairs[:, :, AREA] = 0.0
    far = torch.tensor([50.0, 10.0, 9.75, 9.0, 50.0, 50.0, 2.0, 9.25])
    back = torch.tensor([50.0, 20.0, 50.0, 30.0, 9.5, 0.5, 50.0, 9.75])
    pairs[:, :, DISTANCE], pairs[:, :, DISTANCE_BACK] = far.log1p(), back.log1p()
    check_lent(pairs, [0.0, 0.0, 0.25, 1.0, 0.5, 1.0, 1.0, 0.75])


def test_distances_of_neighbours_are_where_the_network_looks_for_them():
    seen = some_case().describe()
    own = seen.pair_positions.norm(dim=2).clamp(max=50.0).log1p()
    torch.testing.assert_close(seen.pairs[:, :, DISTANCE], own)
