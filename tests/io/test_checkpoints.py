"""Checkpoints of nerfstudio and gsplat."""

import math
import pickle
import random
import warnings
from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from cvtgs import GaussianScene, from_dict, load, to_dict
from cvtgs.errors import FileFormatError, InvalidSceneError
from scenes import random_scene, same_bits

NEWER, OLDER = "_model.gauss_params.", "_model."


def splatfacto(scene: GaussianScene, prefix: str = NEWER) -> dict[str, Any]:
    """Return a checkpoint as nerfstudio saves it, including data besides the scene."""
    state: OrderedDict[str, Tensor] = OrderedDict()
    state["datamanager.dummy"] = torch.zeros(0)
    state["_model.device_indicator_param"] = torch.empty(0)
    state["_model.camera_optimizer.pose_adjustment"] = torch.zeros(5, 6)
    state[prefix + "means"] = scene.means
    state[prefix + "scales"] = scene.log_scales
    state[prefix + "quats"] = scene.quats
    state[prefix + "features_dc"] = scene.sh0[:, 0]
    state[prefix + "features_rest"] = scene.shN
    state[prefix + "opacities"] = scene.logit_opacities[:, None]
    rate = np.float64(1.6e-6)
    group = {"lr": rate, "betas": (0.9, 0.999), "params": [0], "foreach": None}
    moments = {0: {"step": torch.tensor(3.0), "exp_avg": torch.zeros(4)}}
    return {
        "step": 29999,
        "pipeline": state,
        "optimizers": {"means": {"state": moments, "param_groups": [group]}},
        "schedulers": {"means": {"base_lrs": [1e-4], "last_epoch": 3, "_last_lr": [rate]}},
        "scalers": {},
    }


@pytest.mark.parametrize("prefix", [NEWER, OLDER, "module._model.gauss_params."])
@pytest.mark.parametrize("degree", [1, 3])
def test_splatfacto_checkpoints_are_read(tmp_path: Path, prefix: str, degree: int) -> None:
    scene = random_scene(7, degree=degree)
    torch.save(splatfacto(scene, prefix), tmp_path / "step-000029999.ckpt")
    assert same_bits(load(tmp_path / "step-000029999.ckpt"), scene)


def test_colours_of_degree_0_are_read_through_a_sigmoid(tmp_path: Path) -> None:
    scene = random_scene(5, degree=0)
    path = tmp_path / "a.ckpt"
    torch.save(splatfacto(scene), path)
    shown = 0.5 + 0.28209479177387814 * load(path).sh0
    torch.testing.assert_close(shown, torch.sigmoid(scene.sh0))


@pytest.mark.parametrize("suffix", ["pt", "ckpt"])
def test_gsplat_checkpoints_are_read_as_copies(tmp_path: Path, suffix: str) -> None:
    scene = random_scene(7, degree=2)
    path = tmp_path / f"ckpt_29999_rank0.{suffix}"
    torch.save({"step": 29999, "splats": OrderedDict(to_dict(scene))}, path)
    again = load(path)
    assert same_bits(again, scene)
    path.write_bytes(b"")  # the scene is a copy, not a map of the file
    assert same_bits(again, scene)


def test_a_checkpoint_of_one_of_several_gpus_is_warned_about(tmp_path: Path) -> None:
    for rank in range(2):
        splats = OrderedDict(to_dict(random_scene(7, seed=rank)))
        torch.save({"step": 1, "splats": splats}, tmp_path / f"ckpt_1_rank{rank}.pt")
    with pytest.warns(UserWarning, match=r"holds the Gaussians of one GPU; ckpt_1_rank1\.pt and"):
        assert len(load(tmp_path / "ckpt_1_rank0.pt")) == 7


def test_reading_leaves_torch_safe_globals_unchanged(tmp_path: Path) -> None:
    before = set(torch.serialization.get_safe_globals())
    torch.save(splatfacto(random_scene(2)), tmp_path / "a.ckpt")
    load(tmp_path / "a.ckpt")
    assert set(torch.serialization.get_safe_globals()) == before


def test_names_that_the_program_declares_safe_meanwhile_stay(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before, true = [*torch.serialization.get_safe_globals()], torch.load

    def reading(*args: Any, **values: Any) -> Any:
        assert "scalar" in {item.__name__ for item in torch.serialization.get_safe_globals()}
        torch.serialization.add_safe_globals([random.Random])
        return true(*args, **values)

    monkeypatch.setattr(torch, "load", reading)
    torch.save(splatfacto(random_scene(2)), tmp_path / "a.ckpt")
    try:
        load(tmp_path / "a.ckpt")
        assert set(torch.serialization.get_safe_globals()) == {*before, random.Random}
    finally:
        torch.serialization.clear_safe_globals()
        torch.serialization.add_safe_globals(before)


class Evil:
    def __reduce__(self) -> tuple[Any, ...]:
        return (Path.touch, (Path("evil"),))


def test_code_in_a_checkpoint_is_not_executed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "a.ckpt"
    torch.save({**splatfacto(random_scene(2)), "config": Evil()}, path)
    with pytest.raises(FileFormatError, match="must be an intact checkpoint of tensors and plain"):
        load(path)
    assert not (tmp_path / "evil").exists()


class Storage:
    """A storage that the file does not hold: reading makes one of memory as it is."""

    def __init__(self, kind: type, count: int) -> None:
        self.kind, self.count = kind, count

    def __reduce__(self) -> tuple[Any, ...]:
        return self.kind, (self.count,)


class Unstored:
    """A tensor of such a storage."""

    def __init__(self, kind: type, tensor: Tensor) -> None:
        self.kind, self.shape, self.strides = kind, tuple(tensor.shape), tensor.stride()

    def __reduce__(self) -> tuple[Any, ...]:
        storage = Storage(self.kind, math.prod(self.shape))
        more = storage, 0, self.shape, self.strides, False, OrderedDict()
        return torch._utils._rebuild_tensor_v2, more


@pytest.mark.parametrize("kind", [torch.storage.TypedStorage, torch.storage.UntypedStorage])
def test_tensors_that_are_not_in_the_file_are_refused(tmp_path: Path, kind: type) -> None:
    """Otherwise a scene would show what the process had in its memory before."""
    path = tmp_path / "a.pt"
    state = {name: Unstored(kind, values) for name, values in to_dict(random_scene(100)).items()}
    torch.save({"splats": state}, path)
    with pytest.raises(FileFormatError, match=f"numbers, found 'torch.storage.{kind.__name__}'"):
        load(path)


def test_a_dictionary_of_tensors_alone_is_read(tmp_path: Path) -> None:
    scene, path = random_scene(7, degree=1), tmp_path / "a.pt"
    torch.save(to_dict(scene) | {"step": 3}, path)
    assert same_bits(load(path), scene)


def test_checkpoints_without_a_whole_scene_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.ckpt"
    torch.save({"step": 1, "model": {"means": torch.zeros(2, 3)}}, path)
    with pytest.raises(FileFormatError) as caught:
        load(path)
    assert str(caught.value) == (
        f"{path}: a checkpoint must hold a scene (means, quats and so on) under 'splats' (gsplat) "
        f"or 'pipeline' (nerfstudio's Splatfacto), found 'step', 'model'."
    )
    torch.save([1, 2], path)
    with pytest.raises(FileFormatError, match="found nothing of it"):
        load(path)
    torch.save({"splats": {"other": torch.zeros(2, 3)}}, path)
    with pytest.raises(FileFormatError, match="found 'other' under 'splats'"):
        load(path)
    torch.save({"splats": None, "step": 1}, path)
    with pytest.raises(FileFormatError, match="found nothing of it under 'splats'"):
        load(path)
    torch.save({"splats": {"means": torch.zeros(2, 3)}}, path)
    with pytest.raises(FileFormatError, match="found no quats, scales, opacities, sh0"):
        load(path)
    state = to_dict(random_scene(3)) | {"quats": torch.zeros(2, 4)}
    torch.save({"splats": state}, path)
    with pytest.raises(FileFormatError, match=r"a\.ckpt: quats must have shape"):
        load(path)


@pytest.mark.parametrize("share", [0.0, 0.3, 0.97])
def test_a_checkpoint_that_is_cut_short_is_refused(tmp_path: Path, share: float) -> None:
    path = tmp_path / "a.ckpt"
    torch.save(splatfacto(random_scene(50)), path)
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    with pytest.raises(FileFormatError) as caught:
        load(path)
    assert str(caught.value) == (
        f"{path}: must be a whole zip as torch.save writes, found another format or a part; if "
        f"torch can load it, save it again."
    )


def test_a_damaged_zip_is_told_from_other_formats(tmp_path: Path) -> None:
    path = tmp_path / "a.pt"
    torch.save(to_dict(random_scene(5)), path)
    path.write_bytes(path.read_bytes().replace(b"PK\1\2", b"PK\7\2", 1))
    with pytest.raises(FileFormatError) as caught:
        load(path)
    assert str(caught.value) == (
        f"{path}: must be an intact checkpoint of tensors and plain numbers, found damage "
        f"(BadZipFile)."
    )


def test_a_plain_pickle_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.pt"
    path.write_bytes(pickle.dumps(Evil()))
    with pytest.raises(FileFormatError, match="found another"):
        load(path)


MEANS = random_scene(3).means
ODD: dict[str, Callable[[], Any]] = {
    "found int": lambda: 5,
    "found list": lambda: [MEANS],
    "found layout sparse_coo": MEANS.to_sparse,
    "found layout sparse_csr": MEANS.to_sparse_csr,
    "found a nested one": lambda: torch.nested.nested_tensor([MEANS, MEANS]),
    "found one without values (device meta)": lambda: MEANS.to("meta"),
    "found a single number": lambda: torch.tensor(1.0),
    "floats, found torch.int64": MEANS.long,
    "means must have shape": lambda: torch.zeros(3, 3, 3),
}
"""Means of a wrong kind, by the end of the error message about them."""


@pytest.mark.filterwarnings("ignore::UserWarning")
@pytest.mark.parametrize("found", ODD)
def test_means_that_are_no_tensor_of_rows_are_refused(tmp_path: Path, found: str) -> None:
    path, means = tmp_path / "a.pt", ODD[found]()
    state = to_dict(random_scene(3)) | {"means": means}
    torch.save({"splats": state}, path)
    with pytest.raises(FileFormatError) as caught:
        load(path)
    text = str(caught.value)
    assert found in text or "must be an intact checkpoint of tensors and plain numbers" in text
    if not isinstance(means, Tensor) or means.layout == torch.strided:
        with pytest.raises(InvalidSceneError) as alone:
            from_dict(state)
        assert found in str(alone.value)


def test_errors_do_not_repeat_the_advice_of_torch(tmp_path: Path) -> None:
    path = tmp_path / "a.pt"
    torch.save({"splats": to_dict(random_scene(2)), "more": Evil()}, path)
    with pytest.raises(FileFormatError) as caught:
        load(path)
    assert "must be an intact checkpoint of tensors and plain numbers, found" in str(caught.value)
    assert "weights_only" not in str(caught.value)


def test_errors_about_many_keys_are_short(tmp_path: Path) -> None:
    path = tmp_path / "a.pt"
    torch.save({f"{i}" * 100: 1 for i in range(50)}, path)
    with pytest.raises(FileFormatError) as caught:
        load(path)
    assert len(str(caught.value)) < 500 + len(str(path))


def test_random_damage_is_one_sentence(tmp_path: Path) -> None:
    """Bytes change in the pickle, in the zip directory or anywhere."""
    path, dice = tmp_path / "a.pt", random.Random(3)
    torch.save({"splats": to_dict(random_scene(2, degree=0)), "rate": 0.1}, path)
    content = path.read_bytes()
    for number in range(400):
        data, start = bytearray(content), number % 3 * len(content) // 3
        for _ in range(dice.choice((1, 2, 8))):
            data[dice.randrange(start, len(data))] = dice.choice((0, 1, 255, dice.randrange(256)))
        path.write_bytes(data)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                load(path)
        except FileFormatError as error:
            text = str(error)
            assert text.startswith(f"{path}: ")
            assert text.endswith(".")
            assert "\n" not in text
            assert len(text) < 500 + len(str(path))
