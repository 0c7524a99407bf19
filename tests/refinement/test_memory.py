"""A refinement that does not fit into a device: short chunks, then the CPU or an error."""

from importlib import import_module

import pytest
import torch

from cvtgs import Simplifier, SimplifyConfig
from cvtgs.errors import OutOfMemoryError
from cvtgs.refinement import optimize, refine
from pretended_device import pretended_cuda
from refine_cases import discolored, full_scene, quick, ring
from scenes import same_bits


@pytest.mark.slow
def test_auto_refines_on_the_cpu_if_a_device_lacks_memory() -> None:
    full = full_scene(200)
    small, options = discolored(full), {"cameras": ring(4), "config": quick()}
    wanted = refine(small, full, steps=3, device="cpu", **options)
    with pretended_cuda(largest=1000):
        found = refine(small, full, steps=3, **options)
    assert same_bits(found.scene, wanted.scene)
    assert (found.report.device, wanted.report.device_note) == ("cpu", "")
    assert found.report.device_note == "cuda:0 ran out of memory; computed on the CPU"
    assert found.report.steps == 3


@pytest.mark.long
def test_steps_of_a_failed_attempt_do_not_count(monkeypatch) -> None:
    full, step = full_scene(200), optimize.optimize

    def fails_at_the_end(scene, *args, limits, **options):
        found = step(scene, *args, limits=limits, **options)
        if scene.device.type != "cpu":
            raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2 GiB")
        return found

    monkeypatch.setattr(import_module("cvtgs.refinement.refine"), "optimize", fails_at_the_end)
    options = {"steps": 8, "cameras": ring(4), "config": quick()}
    wanted = refine(discolored(full), full, device="cpu", **options)
    with pretended_cuda():
        found = refine(discolored(full), full, **options)
    assert same_bits(found.scene, wanted.scene)
    assert (found.report.steps, found.report.gain > 0) == (8, True)


def test_a_second_attempt_takes_all_steps_again(monkeypatch) -> None:
    monkeypatch.setattr(
        import_module("cvtgs.refinement.refine"),
        "within_memory",
        lambda compute, place, **_: [compute(place, note) for note in ("", "again")][1],
    )
    full = full_scene(50)
    options = {"cameras": ring(4), "config": quick(), "device": "cpu"}
    report = refine(discolored(full), full, steps=1, **options).report
    assert (report.device_note, report.steps, report.images > 0) == ("again", 1, True)


def test_a_named_device_is_not_left() -> None:
    full = full_scene(200)
    with pretended_cuda(largest=1000), pytest.raises(OutOfMemoryError) as caught:
        refine(discolored(full), full, steps=1, device="cuda", config=quick())
    assert str(caught.value) == (
        "refining 200 Gaussians needs more memory than cuda:0 has, even in short chunks; free "
        "some of it, or compute with device='cpu' (--device cpu)."
    )


def test_a_full_host_is_one_sentence(monkeypatch) -> None:
    def fail(*_: object, **__: object) -> None:
        raise MemoryError

    monkeypatch.setattr(optimize, "render", fail)
    full = full_scene(200)
    with pytest.raises(OutOfMemoryError, match=r"^refining 200 Gaussians needs .* smaller images"):
        refine(discolored(full), full, steps=1, device="cpu", config=quick())


@pytest.mark.long
def test_the_refinement_of_a_simplifier_takes_the_whole_run_to_the_cpu(monkeypatch) -> None:
    """The steps alone do not fit; the report says where everything was computed."""
    config = SimplifyConfig.from_mapping({"refine": {"steps": 2, "size": 32, "heldout": 2}})
    full = full_scene(300)
    wanted, _ = Simplifier(config=config, device="cpu").run(full, 0.1)
    step = optimize.optimize

    def fails_elsewhere(scene, *args, **options):
        if scene.device.type != "cpu":
            raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2 GiB")
        return step(scene, *args, **options)

    monkeypatch.setattr(import_module("cvtgs.refinement.refine"), "optimize", fails_elsewhere)
    with pretended_cuda():
        small, report = Simplifier(config=config).run(full, 0.1)
    assert same_bits(small, wanted)
    assert report.refinement is not None
    assert (report.device, report.refinement.device) == ("cpu", "cpu")
    assert report.device_note == "cuda:0 ran out of memory; computed on the CPU"
    assert report.refinement.device_note == ""
