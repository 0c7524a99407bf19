"""Training on a pretended CUDA device: the CPU's gains, and resumed bit for bit."""

from itertools import pairwise

import pytest
import torch

from cvtgs import SimplifyConfig
from cvtgs.progress import ProgressEvent
from cvtgs.train import History
from cvtgs.train.cases import Case, DeviceCopies, make_case
from pretended_device import DeviceTensor, pretended_cuda
from train_cases import bits_of_state, run, small_scene, tiny_config, tiny_data, write_scenes

SCENE_COPIES = 14


@pytest.fixture
def _quick_curves(monkeypatch) -> None:
    monkeypatch.setattr(History, "curves", lambda history: b"an image")


@pytest.fixture
def case() -> Case:
    made = make_case("made", small_scene(300), 0.1, SimplifyConfig())
    assert made is not None
    return made


def test_cases_stay_on_a_device(case):
    with pretended_cuda() as traffic:
        copies = DeviceCopies(torch.device("cuda"))
        first = copies.get(case)
        assert isinstance(first.reference.scene.means, DeviceTensor)
        once = traffic.copies.total()
        assert copies.get(case) is first
        assert traffic.copies.total() == once
        size = sum(tensor.nbytes for tensor in case.reference.scene.tensors().values())
        tight = DeviceCopies(torch.device("cuda"), room=2 * size)  # each is larger than its scene
        kept = tight.get(case)
        tight.get(case.select(torch.arange(5)))
        assert tight.get(case) is not kept
    assert DeviceCopies(torch.device("cpu")).get(case) is case


class PowerCutError(Exception):
    """Stands for anything that ends a process."""


def stop_after_three(event: ProgressEvent) -> None:
    if event.stage == "train" and event.done == 3:
        raise PowerCutError


@pytest.mark.long
@pytest.mark.usefixtures("_quick_curves")
@pytest.mark.parametrize(
    ("kind", "copies"), [("scene", SCENE_COPIES), ("local", 10), ("published", 11)]
)
def test_copies_to_the_device_in_a_step(kind, copies, tmp_path):
    """An image takes 2 copies, and 6 to find the cells in it; its loss and background 2.

    Places of cells take 3, their numbers 1.
    """
    scenes = write_scenes(tmp_path / "scenes", ["exam", "lesson"], 300)
    changes = {"preset": "paper"} if kind == "published" else {}
    config = tiny_config(tiny_data(scenes), kind=kind, steps=6, validate_every=6, **changes)
    with pretended_cuda() as traffic:
        seen: list[int] = []

        def listen(event: ProgressEvent) -> None:
            if event.stage == "train":
                seen.append(traffic.copies.total())

        run(config, tmp_path / "net.safetensors", device="cuda", listener=listen)
    steps = [after - before for before, after in pairwise(seen)]
    assert steps[-1] == min(steps) <= copies, traffic.copies


@pytest.mark.long
@pytest.mark.usefixtures("_quick_curves")
@pytest.mark.parametrize("kind", ["scene", "local"])
def test_training_and_resuming(kind, tmp_path):
    scenes = write_scenes(tmp_path / "scenes", ["exam", "lesson"], 300)
    config, cache = tiny_config(tiny_data(scenes), kind=kind, steps=5), tmp_path / "cache"
    names = [tmp_path / f"{name}.safetensors" for name in ("cpu", "whole", "cut")]
    wanted = run(config, names[0], cache)
    with pretended_cuda() as traffic:
        whole = run(config, names[1], cache, device="cuda")
        assert traffic.copies
        with pytest.raises(PowerCutError):
            run(config, names[2], cache, device="cuda", listener=stop_after_three)
        cut = run(config, names[2], cache, device="cuda", resume=True)
    assert repr(cut.validations) == repr(whole.validations)
    assert bits_of_state(names[2].with_suffix(".state")) == bits_of_state(
        names[1].with_suffix(".state")
    )
    for found, same in zip(whole.validations, wanted.validations, strict=True):
        assert found.mean_gain == pytest.approx(same.mean_gain, abs=1e-3)
        assert found.loss == pytest.approx(same.loss, rel=1e-3, nan_ok=True)
