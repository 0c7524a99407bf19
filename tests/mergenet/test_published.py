"""The network of CVT-GS as published: descriptor by hand, pooling, residuals, checkpoints."""

import json
import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch

import cvtgs
from cvtgs.cells import Partition
from cvtgs.config import SimplifyConfig
from cvtgs.devices import one_thread
from cvtgs.errors import CheckpointError
from cvtgs.mergenet import (
    Architecture,
    CheckpointInfo,
    PublishedArchitecture,
    PublishedMergeNet,
    correct_cells,
    encode_checkpoint,
    load_checkpoint,
)
from cvtgs.mergenet.apply import compose_published
from cvtgs.mergenet.published import describe_published
from mergenet_cases import Case, lively_net, some_case
from scenes import random_scene, same_bits

SMALL = PublishedArchitecture(width=5, cell_width=7)
INFO = CheckpointInfo(architecture=SMALL, preset="paper")


def lively(dtype: torch.dtype = torch.float64, *, scale: float = 0.3) -> PublishedMergeNet:
    """A network that changes everything a little."""
    net, g = PublishedMergeNet(SMALL), torch.Generator().manual_seed(0)
    with torch.no_grad():
        for values in net.parameters():
            values.copy_(scale * torch.randn(values.shape, generator=g, dtype=torch.float64))
    return net.to(dtype)


def described(case: Case):
    cells = torch.arange(len(case.part))
    return describe_published(case.scene, case.merged, case.part, cells=cells)


def hamilton(a, b) -> list[float]:
    (w, x, y, z), (p, q, r, s) = a, b
    return [
        w * p - x * q - y * r - z * s,
        w * q + x * p + y * s - z * r,
        w * r - x * s + y * p + z * q,
        w * s + x * r - y * q + z * p,
    ]


def rotated(quat, vector) -> np.ndarray:
    w, x, y, z = quat
    return np.array(hamilton(hamilton(quat, [0, *vector]), [w, -x, -y, -z])[1:])


def member_by_hand(scene, row: int, merged, cell: int, opacity_sum: float) -> list[float]:
    """Compute the features of a member one number at a time."""
    quats = [np.array(s.quats[i].tolist()) for s, i in ((merged, cell), (scene, row))]
    own, other = (quat / np.linalg.norm(quat) for quat in quats)
    back = [own[0], *(-own[1:])]
    shift = np.array(scene.means[row].tolist()) - np.array(merged.means[cell].tolist())
    scales = np.array(merged.log_scales[cell].tolist())
    relative = np.array(hamilton(back, other))
    opacity = 1 / (1 + math.exp(-float(scene.logit_opacities[row])))
    colors = [
        np.array(one[row].tolist()).reshape(-1, 3) - np.array(two[cell].tolist()).reshape(-1, 3)
        for one, two in ((scene.sh0, merged.sh0), (scene.shN, merged.shN))
    ]
    values = [
        *(rotated(back, shift) / np.exp(scales)),
        *(np.array(scene.log_scales[row].tolist()) - scales),
        *(relative if relative[0] >= 0 else -relative),
        opacity,
        opacity / opacity_sum,
        *np.concatenate(colors).flatten(),
    ]
    return [float(value) for value in values] + [0.0] * (60 - len(values))


@pytest.mark.parametrize("degree", [0, 2, 3])
def test_members_are_described_as_published(degree):
    case = some_case(20, 4, degree=degree)
    found, offsets = described(case), case.part.offsets.tolist()
    opacities = torch.sigmoid(case.scene.logit_opacities)
    for cell in range(4):
        rows = case.part.order[offsets[cell] : offsets[cell + 1]]
        total = float(opacities[rows].sum())
        for place, row in enumerate(rows.tolist(), start=offsets[cell]):
            wanted = member_by_hand(case.scene, row, case.merged, cell, total)
            assert found.members[place].tolist() == pytest.approx(wanted, abs=1e-9)
            assert float(found.shares[place]) == pytest.approx(wanted[11])


def test_members_are_pooled_by_mean_maximum_and_opacity():
    case, net = some_case(20, 4), lively()
    found = described(case)
    hidden = net.member_layers(found.members)
    pooled = []
    for start, end in zip(found.offsets[:-1].tolist(), found.offsets[1:].tolist(), strict=True):
        part, shares = hidden[start:end], found.shares[start:end, None]
        pooled.append(torch.cat([part.mean(0), part.amax(0), (part * shares).sum(0)]))
    changes = net.residuals(net.decoder(torch.stack(pooled)))
    residuals = net(found)
    torch.testing.assert_close(residuals.d_means, changes[:, :3])
    torch.testing.assert_close(residuals.d_logit_opacities, changes[:, 9])
    torch.testing.assert_close(residuals.d_sh.flatten(1), changes[:, 10:])


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_an_untrained_network_returns_the_merged_gaussians(degree):
    case = some_case(degree=degree)
    net = PublishedMergeNet(PublishedArchitecture()).double()
    small = corrected(case, net)
    for name, values in case.merged.tensors().items():
        torch.testing.assert_close(getattr(small, name), values, rtol=0, atol=0)


def corrected(case: Case, net: PublishedMergeNet) -> cvtgs.GaussianScene:
    return correct_cells(
        net,
        case.scene,
        case.merged,
        case.part,
        neighbors=case.neighbors[:, :0],
        visibility=case.visibility[:0],
        pixel_size=case.pixel_size,
    )


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_one_network_corrects_every_degree_and_all_its_bands(degree):
    case = some_case(degree=degree)
    small = corrected(case, lively())
    several = case.part.counts > 1
    for name, values in case.merged.tensors().items():
        if values.numel():
            changed = (getattr(small, name) != values).reshape(len(values), -1)
            assert bool(changed[several].all())
            assert not bool(changed[~several].any())


def test_residuals_are_not_limited():
    """Twice the last layer gives twice the residuals, however large."""
    case, net = some_case(), lively()
    once = net(described(case))
    with torch.no_grad():
        net.residuals.weight *= 1000
        net.residuals.bias *= 1000
    more = net(described(case))
    torch.testing.assert_close(more.d_log_scales, 1000 * once.d_log_scales)
    torch.testing.assert_close(more.d_sh, 1000 * once.d_sh)


def test_coefficients_are_added_band_by_band():
    case = some_case(degree=1)
    residuals = lively()(described(case))
    tensors = compose_published(
        case.merged, cells=torch.arange(len(case.part)), residuals=residuals
    )
    torch.testing.assert_close(tensors["sh0"], case.merged.sh0 + residuals.d_sh[:, :1])
    torch.testing.assert_close(tensors["shN"], case.merged.shN + residuals.d_sh[:, 1:4])


def test_chunks_do_not_change_the_result(monkeypatch):
    case = some_case()
    whole = corrected(case, lively())
    monkeypatch.setattr("cvtgs.mergenet.apply.CHUNK_MEMBERS", 7)
    for name, values in corrected(case, lively()).tensors().items():
        torch.testing.assert_close(values, getattr(whole, name))


def test_far_members_and_huge_differences_stay_finite():
    case = some_case()
    far = case.scene.with_tensors({"means": case.scene.means * 1e30}, {})
    needle = case.merged.with_tensors({"log_scales": case.merged.log_scales - 80}, {})
    cells = torch.arange(len(case.part))
    found = describe_published(far, needle, case.part, cells=cells)
    assert float(found.members.abs().amax()) <= 50.0


def test_coincident_members_of_a_tiny_cell_are_in_its_middle():
    case = some_case()
    point = {
        "means": torch.zeros_like(case.merged.means),
        "log_scales": case.merged.log_scales - 400,
    }
    scene = case.scene.with_tensors(means=torch.zeros_like(case.scene.means))
    cells = torch.arange(len(case.part))
    dtype = torch.float32
    scene, merged = (
        each.with_tensors({name: values.to(dtype) for name, values in each.tensors().items()})
        for each in (scene, case.merged.with_tensors(point))
    )
    found = describe_published(scene, merged, case.part, cells=cells)
    assert float(found.members[:, :3].abs().amax()) == 0.0
    assert bool(found.members.isfinite().all())


def test_saving_and_loading_keeps_the_kind(tmp_path):
    path, net = tmp_path / "net.safetensors", lively(torch.float32)
    path.write_bytes(encode_checkpoint(net, INFO))
    found = load_checkpoint(path)
    assert isinstance(found.net, PublishedMergeNet)
    assert found.info == INFO
    for name, values in net.state_dict().items():
        assert torch.equal(found.net.state_dict()[name], values)


def refusal(tmp_path, net: torch.nn.Module, info: CheckpointInfo) -> str:
    path = tmp_path / "net.safetensors"
    path.write_bytes(encode_checkpoint(net, info))
    with pytest.raises(CheckpointError) as caught:
        load_checkpoint(path)
    return str(caught.value).removeprefix(f"{path}: ")


def test_another_descriptor_is_refused_in_one_sentence(tmp_path):
    shape = SMALL.model_copy(update={"member_features": 59})
    info = INFO.model_copy(update={"architecture": shape})
    assert refusal(tmp_path, PublishedMergeNet(shape), info) == (
        "the checkpoint has a different architecture: member_features must be 60, found 59."
    )


def test_an_unknown_kind_is_refused_in_one_sentence(tmp_path):
    told = INFO.model_dump_json().replace('"published"', '"graph"')
    info = SimpleNamespace(model_dump_json=lambda: told)
    assert refusal(tmp_path, lively(torch.float32), info) == (
        "the checkpoint's description is missing or invalid: "
        "architecture.Architecture.kind: input should be 'gated', found 'graph'; "
        "architecture.PublishedArchitecture.kind: input should be 'published', found 'graph'."
    )


@pytest.mark.parametrize("kind", ["gated", "published"])
def test_weights_of_the_other_kind_are_refused_in_one_sentence(tmp_path, kind):
    gated = lively_net(torch.float32, architecture=Architecture(width=2, cell_width=3))
    net, info = (
        (gated, INFO)
        if kind == "published"
        else (lively(torch.float32), INFO.model_copy(update={"architecture": gated.architecture}))
    )
    text = refusal(tmp_path, net, info)
    assert text.startswith("the checkpoint has a different architecture: ")
    assert text.endswith(" do not fit.")


def test_files_of_the_first_release_are_of_the_gated_kind(tmp_path):
    """Their descriptions name no kind."""
    path = tmp_path / "net.safetensors"
    gated = lively_net(torch.float32, architecture=Architecture(width=2, cell_width=3))
    info = CheckpointInfo(architecture=gated.architecture, preset="standard")
    told = json.loads(info.model_dump_json())
    del told["architecture"]["kind"]
    assert CheckpointInfo.model_validate(told) == info
    path.write_bytes(encode_checkpoint(gated, info))
    assert load_checkpoint(path).info.architecture.kind == "gated"


def test_a_simplified_scene_keeps_its_count(tmp_path):
    path = tmp_path / "net.safetensors"
    path.write_bytes(encode_checkpoint(lively(torch.float32, scale=0.1), INFO))
    scene = cvtgs.synthetic.scene("object", 400, sh_degree=1, seed=0)
    simplified = cvtgs.Simplifier(path, config="paper").simplify(scene, 0.1)
    merged = cvtgs.Simplifier(None, config="paper").simplify(scene, 0.1)
    assert len(simplified) == len(merged) == 40
    assert not torch.equal(simplified.shN, merged.shN)


def test_the_paper_preset_does_not_align_axes():
    assert not SimplifyConfig.from_preset("paper").merge.align_axes
    assert SimplifyConfig.from_preset("standard").merge.align_axes


def test_no_neighbours_are_searched(tmp_path, monkeypatch):
    path = tmp_path / "net.safetensors"
    path.write_bytes(encode_checkpoint(lively(torch.float32, scale=0.1), INFO))
    asked = []
    nearest = cvtgs.pipeline.cvt.nearest_neighbors
    monkeypatch.setattr(
        "cvtgs.cvt.nearest_neighbors", lambda means, k: asked.append(k) or nearest(means, k)
    )
    scene = cvtgs.synthetic.scene("object", 200, sh_degree=0, seed=0)
    cvtgs.Simplifier(path, config="paper").simplify(scene, 0.1)
    assert asked == [0]


def test_the_order_of_members_does_not_matter():
    case, net = some_case(), lively()
    turned = Partition.from_labels(case.part.labels(len(case.scene)).flip(0), len(case.part))
    flipped = case.scene.select(torch.arange(len(case.scene)).flip(0))
    cells = torch.arange(len(case.part))
    found = net(describe_published(flipped, case.merged, turned, cells=cells))
    torch.testing.assert_close(found.d_sh, net(described(case)).d_sh)


@pytest.mark.parametrize("factor", [1e12, 1e22, 1e37])
def test_huge_colours_give_finite_gaussians(factor):
    """Unlimited residuals grow with them, beyond the root of the largest float32."""
    scene = random_scene(100)
    scene = scene.with_tensors({"sh0": scene.sh0 * factor}, {})
    small = cvtgs.Simplifier("paper", device="cpu").simplify(scene, 0.1)
    for name, values in small.tensors().items():
        assert bool(values.isfinite().all()), name
    assert small.quats.norm(dim=1).tolist() == pytest.approx([1.0] * 10)


def test_one_cell_has_the_same_bits_in_two_threads(two_threads):
    scene = cvtgs.synthetic.scene("object", 8, sh_degree=2, seed=1)
    simplifier = cvtgs.Simplifier("paper", device="cpu")
    two = simplifier.simplify(scene, count=1)
    with one_thread():
        assert same_bits(two, simplifier.simplify(scene, count=1))
