"""Simplification on a pretended CUDA device: devices are not mixed, the CPU's bits, few waits."""

from importlib import import_module

import pytest
import torch

from cvtgs import Simplifier
from cvtgs.cvt import nearest_neighbors, nearest_scipy
from cvtgs.cvt.nearest import nearest_several
from cvtgs.devices import one_thread
from cvtgs.errors import OutOfMemoryError
from cvtgs.evaluation import psnr
from cvtgs.math.frames import morton_order
from cvtgs.math.segments import running_sums
from cvtgs.rendering import render
from cvtgs.synthetic import scene as make
from cvtgs.views import automatic_views
from pretended_device import CUDA, DeviceTensor, pretended_cuda
from scenes import random_scene, same_bits

PRESETS = ["draft", "fast", "standard", "paper"]
WAITS, COPIES = 120, 4
"""Largest numbers of host waits and of copies in one simplification.

Most waits are for the sizes of lists: each search for nearest sites waits 5 to 15 times, each
round of merging pairs 3 times. One copy is for the network; a scene outside the device adds 6.
Neither number grows with the scene, except by chunks, which are large on a device, and by the
depth of the tree of sites.
"""


def by_tree(points, sites, count=1):
    """Search as on a CPU, where ties are resolved in another way than in tiles."""
    if count == 1:
        labels, squared = nearest_scipy(points, sites)
        return labels[:, None], squared[:, None]
    rows, distances = nearest_several(points.cpu(), sites.cpu(), count)
    return rows.to(points.device), distances.square().to(points.device)


@pytest.fixture
def computed_as_on_the_cpu(monkeypatch):
    """Use the CPU's search and its eigenvectors, so that everything else gives the same bits."""
    monkeypatch.setattr("cvtgs.cvt.nearest.nearest_in_tiles", by_tree)
    for user in ("math.parameters", "cells.inflate"):
        monkeypatch.setattr(f"cvtgs.{user}.symmetric_eigen", torch.linalg.eigh)


def on_device(scene):
    """Check that a scene is on the device, and bring it back."""
    assert all(isinstance(tensor, DeviceTensor) for tensor in scene.tensors().values())
    return scene.to("cpu")


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.slow
def test_a_device_gives_the_bits_of_the_cpu(preset, dtype, computed_as_on_the_cpu):
    scene = random_scene(600, degree=1, dtype=dtype)
    wanted = Simplifier(config=preset, device="cpu").simplify(scene, 0.1)
    with pretended_cuda():
        small = Simplifier(config=preset, device="cuda").simplify(scene.to("cuda"), 0.1)
        assert same_bits(on_device(small), wanted)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.slow
def test_a_device_gives_the_image_of_the_cpu_with_few_waits(preset, dtype):
    scene = random_scene(600, degree=1, dtype=dtype)
    wanted = Simplifier(config=preset, device="cpu").simplify(scene, 0.1)
    with pretended_cuda() as traffic:
        there = scene.to("cuda")
        traffic.copies.clear()
        small, report = Simplifier(config=preset, device="cuda").run(there, 0.1)
        assert traffic.waits.total() <= WAITS, traffic.waits
        assert traffic.copies.total() <= COPIES, traffic.copies
        found = on_device(small)
    assert report.backend == "tiles"
    cameras = automatic_views(wanted, 2, width=48, height=32)
    images = [render(one, cameras).rgb for one in (found, wanted)]
    assert psnr(*images).amin() > 45


@pytest.mark.slow
def test_a_larger_scene_causes_no_more_waits():
    scene = random_scene(6000, degree=0, size=0.02)
    with pretended_cuda() as traffic:
        there = scene.to("cuda")
        traffic.copies.clear()
        Simplifier(device="cuda").simplify(there, 0.02)
    assert traffic.waits.total() <= WAITS, traffic.waits
    assert traffic.copies.total() <= COPIES, traffic.copies


@pytest.mark.slow
@pytest.mark.parametrize("rho", [0.1, 0.02])
def test_view_dependent_colour_gives_the_bits_of_the_cpu(rho, computed_as_on_the_cpu):
    scene = make("object", 3000, sh_degree=3, seed=0)
    wanted = Simplifier(device="cpu").simplify(scene, rho)
    with pretended_cuda():
        small = Simplifier(device="cuda").simplify(scene.to("cuda"), rho)
        assert same_bits(on_device(small), wanted)


@pytest.mark.slow
def test_auto_uses_the_device_for_a_scene_on_the_cpu(computed_as_on_the_cpu):
    scene = random_scene(300)
    wanted = Simplifier(device="cpu").simplify(scene, 0.1)
    with pretended_cuda() as traffic:
        assert same_bits(Simplifier().simplify(scene, 0.1).to("cpu"), wanted)
    assert traffic.copies


@pytest.mark.slow
def test_auto_falls_back_to_the_cpu_if_memory_runs_out():
    scene = random_scene(300)
    prepared = Simplifier(device="cpu").prepare(scene)
    with pretended_cuda(largest=1000):
        elsewhere = Simplifier().prepare(scene)
        for count in (30, 20):
            small, report = elsewhere.run(count=count)
            assert same_bits(small, prepared.run(count=count).scene)
            assert report.device == "cpu"
            assert report.device_note == "cuda:0 ran out of memory; computed on the CPU"
        (level,) = Simplifier().levels(scene, [0.1])
        assert level.report.device == "cpu"


@pytest.mark.slow
def test_a_named_device_without_enough_memory_is_an_error():
    with pretended_cuda(largest=1000), pytest.raises(OutOfMemoryError) as caught:
        Simplifier(device="cuda").simplify(random_scene(300), 0.1)
    assert str(caught.value) == (
        "simplifying 300 Gaussians needs more memory than cuda:0 has, even in short chunks; free "
        "some of it, or compute with device='cpu' (--device cpu)."
    )


@pytest.mark.long
@one_thread()  # two threads of a CPU round another way
def test_short_chunks_are_used_where_long_ones_do_not_fit(monkeypatch, computed_as_on_the_cpu):
    for name in ("mergenet.apply", "cells.merge"):
        monkeypatch.setattr(f"cvtgs.{name}.CHUNK_MEMBERS", 64)
    monkeypatch.setattr(import_module("cvtgs.analysis.analyze"), "HALF_GRID", 8)
    monkeypatch.setattr("cvtgs.cells.allocate.CHUNK", 1024)
    monkeypatch.setattr("cvtgs.math.frames.GROUPED", 64)  # of a table of at most 2 MB otherwise
    scene = random_scene(3000, degree=0, size=0.02)
    wanted = Simplifier(device="cpu").simplify(scene, 0.02)
    # The weights of the network, 299,172 bytes, are copied at once and just fit.
    with pretended_cuda(largest=302_000):
        prepared = Simplifier(device="cuda").prepare(scene.to("cuda"))
        small, report = prepared.run(0.02)
        assert same_bits(on_device(small), wanted)
        assert report.device_note == "cuda:0 ran out of memory; computed there in short chunks"
    with pretended_cuda():
        assert Simplifier(device="cuda").run(scene.to("cuda"), 0.02).report.device_note == ""


@pytest.mark.long
@pytest.mark.parametrize("preset", ["standard", "paper"])
@pytest.mark.slow
def test_levels_on_a_device(preset, computed_as_on_the_cpu):
    scene, rhos = random_scene(2000, degree=1), [0.2, 0.04, 0.01]
    wanted = Simplifier(config=preset, device="cpu").levels(scene, rhos)
    with pretended_cuda():
        found = Simplifier(config=preset, device="cuda").levels(scene.to("cuda"), rhos)
        for level, same in zip(found, wanted, strict=True):
            assert same_bits(on_device(level.scene), same.scene)
            assert level.geometric_error == same.geometric_error


@pytest.mark.parametrize("preset", ["draft", "standard"])
@pytest.mark.slow
def test_protected_regions_on_a_device(preset, computed_as_on_the_cpu):
    scene = random_scene(500, degree=1)
    keep = torch.arange(500) % 25 == 0
    wanted = Simplifier(config=preset, device="cpu").simplify(scene, 0.1, keep=keep)
    with pretended_cuda():
        simplifier = Simplifier(config=preset, device="cuda")
        for mask in (keep, keep.to("cuda")):
            assert same_bits(
                on_device(simplifier.simplify(scene.to("cuda"), 0.1, keep=mask)), wanted
            )


def test_nearest_sites_of_points_on_a_device():
    points = torch.randn(300, 3, generator=torch.Generator().manual_seed(0))
    sites = torch.cat([points[::7], points[:3]])  # some twice
    wanted = nearest_scipy(points, sites)
    with pretended_cuda():
        found = nearest_scipy(points.to("cuda"), sites.to("cuda"))
        for one, same in zip(found, wanted, strict=True):
            assert one.device == CUDA
            assert torch.equal(one.cpu(), same)


def test_ties_on_a_curve_on_a_device():
    generator = torch.Generator().manual_seed(0)
    points = torch.randint(0, 3, (400, 3), generator=generator).double()  # 27 places
    masses = torch.randint(0, 5, (400,), generator=generator).float()
    wanted = morton_order(points, ties=masses)
    with pretended_cuda() as traffic:
        found = morton_order(points.to("cuda"), ties=masses.to("cuda"))
        assert not traffic.waits
        assert torch.equal(found.cpu(), wanted)


@pytest.mark.parametrize("count", [0, 1, 2, 1000])
def test_running_sums_on_a_device(count):
    values = torch.rand(count, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    with pretended_cuda():
        found = running_sums(values.to("cuda")).cpu()
    torch.testing.assert_close(found, values.cumsum(0))


def test_neighbours_on_a_device():
    sites = torch.randn(100, 3, generator=torch.Generator().manual_seed(0)).repeat(2, 1)
    wanted = nearest_neighbors(sites, 5), *nearest_several(sites, sites[:50], 4)
    with pretended_cuda():
        there = sites.to("cuda")
        found = nearest_neighbors(there, 5), *nearest_several(there, there[:50], 4)
        assert all(one.device == CUDA for one in found)
        near, rows, distances = (one.cpu() for one in found)
    own = torch.arange(200)[:, None]
    assert not (near == own).any()  # of two at the same place, only the site itself is left out
    for rows_found, rows_wanted, of, to in (
        (near, wanted[0], sites, sites),
        (rows, wanted[1], sites, sites[:50]),
    ):
        lengths = [(of[:, None] - to[some]).norm(dim=2) for some in (rows_found, rows_wanted)]
        torch.testing.assert_close(*lengths)
    torch.testing.assert_close(distances, wanted[2])


def test_the_pretended_device_refuses_and_counts():
    host = torch.arange(6.0).reshape(2, 3)
    with pretended_cuda() as traffic:
        there = host.to("cuda")
        assert there.device == (there + 1).device == torch.zeros(2, device="cuda").device == CUDA
        for mix in (
            lambda: there + host,
            lambda: host[there.long()],
            lambda: torch.cat([there, host]),
        ):
            with pytest.raises(RuntimeError, match="on the same device"):
                mix()
        with pytest.raises(TypeError, match="numpy"):
            there.numpy()
        with pytest.raises(RuntimeError, match="generator"):
            torch.rand(2, device="cuda", generator=torch.Generator())
        for add in (
            lambda: there.cumsum(1),
            lambda: torch.bincount(there[0].long(), there[0]),
            lambda: there.index_add(0, there[:, 0].long(), there),
            lambda: there.scatter_reduce(0, there.long(), there, "sum"),
            lambda: there.index_put_((there[:, 0].long(),), there, accumulate=True),
        ):
            with pytest.raises(RuntimeError, match="in any order"):
                add()
        leaf = there.clone().requires_grad_()
        leaf[torch.zeros(2, dtype=torch.int64, device="cuda")].sum().backward()
        assert leaf.grad.tolist() == [[2, 2, 2], [0, 0, 0]]
        assert there.long().cumsum(1).tolist() == [[0, 1, 3], [3, 7, 12]]
        traffic.waits.clear()
        assert (traffic.waits.total(), traffic.copies.total()) == (0, 1)
        assert float(there.sum()) == 15
        assert there[there > 2].tolist() == [3, 4, 5]
        assert there[:, [2, 0]].cpu().tolist() == [[2, 0], [5, 3]]
        assert (traffic.waits.total(), traffic.copies.total()) == (3, 3)
        there[0] += 1
        assert torch.equal(there[:1].cpu(), host[:1] + 1)
    with pytest.raises(RuntimeError, match="no device outside"):
        there + 1


@pytest.mark.long
def test_a_prepared_scene_runs_again_on_a_device():
    scene = random_scene(300)
    wanted = Simplifier(device="cpu").prepare(scene)
    with pretended_cuda():
        prepared = Simplifier(device="cuda").prepare(scene)
        for count in (40, 50, 2):
            small = prepared.run(count=count).scene
            assert same_bits(small.to("cpu"), wanted.run(count=count).scene)


@pytest.mark.slow
@pytest.mark.parametrize("preset", ["draft", "standard"])
@one_thread()
def test_two_gaussians_on_a_device(preset):
    scene = random_scene(100)
    wanted = Simplifier(config=preset, device="cpu").simplify(scene, count=2)
    with pretended_cuda():
        small = Simplifier(config=preset, device="cuda").simplify(scene, count=2)
        assert same_bits(small.to("cpu"), wanted)


def test_axes_of_many_equal_spheres_are_found_on_a_device():
    """Neighbours turn axes of equal length: one more problem of eigenvectors per cell."""
    steps = torch.arange(14, dtype=torch.float32)
    means = torch.cartesian_prod(steps, steps, steps)
    sphere = random_scene(1).select(torch.zeros(len(means), dtype=torch.int64))
    spheres = sphere.with_tensors({"means": means, "log_scales": torch.full_like(means, -1.0)}, {})
    with pretended_cuda():
        small = Simplifier(None, config="fast", device="cuda").simplify(spheres.to("cuda"), 0.5)
        assert len(on_device(small)) == 14**3 // 2
