"""Cases: what a scene at a ratio holds, and what a network changes of it."""

import torch

from cvtgs.config import SimplifyConfig
from cvtgs.mergenet import correct_cells
from cvtgs.train.cases import refer_case
from cvtgs.train.merged import merge_scene
from mergenet_cases import fields_of, lively_net
from scenes import random_scene, same_bits
from train_cases import bits, bits_of_case, small_net, small_scene, some_case


def test_a_case_is_the_reference_and_its_cells_of_several():
    scene, config = random_scene(200), SimplifyConfig()
    case = refer_case("box", scene, 0.31, config)
    reference = merge_scene(scene, 62, config)
    counts = reference.partition.counts
    assert case.name == "box at 0.31"
    assert len(case.reference.merged) == 62
    assert same_bits(case.reference.merged, reference.merged)
    assert case.cells.tolist() == [cell for cell in range(62) if counts[cell] > 1]
    assert case.part.counts.tolist() == counts[case.cells].tolist()
    assert len(case.descriptors) == len(case.cells) < 62


def test_nothing_to_learn_is_no_case():
    scene, config = random_scene(20), SimplifyConfig()
    assert refer_case("box", scene, 0.99, config) is None
    assert refer_case("box", scene.select(torch.tensor([0])), 0.5, config) is None
    assert refer_case("box", scene.select(torch.zeros(0, dtype=torch.int64)), 0.5, config) is None


def test_cells_of_one_only_are_no_case():
    """The faint half is filtered, and as many are left as are kept."""
    scene = random_scene(40)
    logits = torch.where(torch.arange(40) < 20, 3.0, -9.0)
    scene = scene.with_tensors({"logit_opacities": logits}, {})
    config = SimplifyConfig.from_mapping({"filter": {"max_mass_share": 1.0}})
    assert refer_case("box", scene, 0.5, config) is None


def test_an_untrained_network_changes_no_bit():
    case = some_case()
    with torch.no_grad():
        residuals = small_net()(case.descriptors)
    assert same_bits(case.corrected(residuals), case.reference.merged)
    before = case.reference.merged.select(case.cells).tensors()
    for name, values in case.changed(residuals).items():
        assert bits(values) == bits(before[name])


def test_corrected_is_what_the_simplifier_does():
    case, net = some_case(), lively_net(torch.float32)
    reference = case.reference
    with torch.no_grad():
        corrected = case.corrected(net(case.descriptors))
    wanted = correct_cells(
        net,
        reference.scene,
        reference.merged,
        reference.partition,
        neighbors=reference.neighbors,
        visibility=reference.visibility,
    )
    for name, values in wanted.tensors().items():
        torch.testing.assert_close(getattr(corrected, name), values, rtol=1e-5, atol=1e-5)
    assert float((corrected.log_scales - reference.merged.log_scales).abs().amax()) > 0.1


def test_some_cells_are_seen_as_among_all():
    case, net = some_case(), lively_net(torch.float32)
    rows = torch.tensor([0, 3, 4, 11])
    some = case.select(rows)
    assert some.cells.tolist() == case.cells[rows].tolist()
    assert some.name == case.name
    every, few = net(case.descriptors), net(some.descriptors)
    for name in ("d_means", "d_log_scales", "d_rotvecs", "d_logit_opacities", "pair_colors"):
        torch.testing.assert_close(getattr(few, name), getattr(every, name)[rows])
    changed = case.changed(every)
    for name, values in some.changed(few).items():
        torch.testing.assert_close(values, changed[name][rows])


def test_no_cells_can_be_taken():
    some = some_case().select(torch.zeros(0, dtype=torch.int64))
    assert len(some.cells) == len(some.part) == len(some.descriptors) == 0


def test_gradients_flow_through_every_cell():
    case, net = some_case(), lively_net(torch.float32)
    residuals = net(case.descriptors)
    for values in fields_of(residuals).values():
        values.retain_grad()
    corrected = case.corrected(residuals)
    sum(values.sin().sum() for values in corrected.tensors().values()).backward()
    for values in fields_of(residuals).values():
        rows = values.grad.reshape(len(values), -1)
        assert bool(rows.isfinite().all())
        assert bool((rows != 0).any(dim=1).all())
    assert all(bool(values.grad.isfinite().all()) for values in net.parameters())


def test_moving_to_where_a_case_is_costs_nothing():
    case = some_case()
    assert case.to(torch.device("cpu")) is case


def test_moving_takes_everything_along():
    """``meta`` stands for another device: it has shapes and no values."""
    moved = some_case().to(torch.device("meta"))
    reference, seen = moved.reference, moved.descriptors
    tensors = [moved.cells, moved.part.order, moved.part.offsets, reference.neighbors]
    tensors += [reference.visibility, reference.partition.order, reference.partition.offsets]
    tensors += [*reference.scene.tensors().values(), *reference.merged.tensors().values()]
    tensors += [getattr(seen, name) for name in type(seen).__slots__]
    assert {tensor.device.type for tensor in tensors} == {"meta"}


def test_the_same_scene_gives_the_same_bits():
    scene = small_scene(300)
    first, again = (refer_case("one", scene, 0.1, SimplifyConfig()) for _ in range(2))
    assert bits_of_case(first) == bits_of_case(again)
