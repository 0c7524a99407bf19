"""Sources of LPIPS weights, and errors for invalid files."""

import math
import os
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
import torch

from cvtgs.errors import (
    FileFormatError,
    InputError,
    InputNotFoundError,
    InvalidArgumentError,
    MissingDependencyError,
)
from cvtgs.evaluation import Evaluation, LpipsWeights, load_lpips, lpips
from cvtgs.evaluation.lpips import LPIPS_VARIABLE
from cvtgs.evaluation.scorer import NOT_ASKED_FOR, chosen_metrics
from lpips_cases import random_images, random_state, random_weights


def save(state: Mapping[str, torch.Tensor], path: Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    torch.save(dict(state), path)
    return path


def test_weights_are_found_by_path_folder_and_environment(tmp_path, monkeypatch) -> None:
    state = random_state("alex")
    path = save({k: v.half() for k, v in state.items()}, tmp_path / "lpips_alex_fp16.pth")
    first, second = random_images(31, 31)
    rounded = {name: tensor.half().float() for name, tensor in state.items()}
    weights = LpipsWeights(network="alex", tensors=rounded, source="")
    wanted = lpips(first, second, network="alex", weights=weights)
    for given in (path, str(path), tmp_path):
        assert torch.equal(lpips(first, second, network="alex", weights=given), wanted)
        monkeypatch.setenv(LPIPS_VARIABLE, str(given))
        assert torch.equal(lpips(first, second, network="alex"), wanted)
    assert load_lpips("alex").source == str(path)
    monkeypatch.setenv(LPIPS_VARIABLE, "nowhere.pth")
    assert load_lpips("alex", path).network == "alex"


def test_names_of_the_lpips_package_are_accepted(tmp_path) -> None:
    """lpips.LPIPS(net="alex").state_dict() keeps torchvision's layer numbers within slices."""
    slices = {0: 1, 3: 2, 6: 3, 8: 4, 10: 5}
    state: dict[str, torch.Tensor] = {"scaling_layer.shift": torch.zeros(1, 3, 1, 1)}
    for name, tensor in random_state("alex").items():
        if name.startswith("lin"):
            head = name.removesuffix(".weight")
            state[f"{head}.model.1.weight"] = tensor
            state[f"lins.{head[3:]}.model.1.weight"] = tensor
        else:
            _, index, kind = name.split(".")
            state[f"net.slice{slices[int(index)]}.{index}.{kind}"] = tensor
    weights = load_lpips("alex", save(state, tmp_path / "full.pth"))
    assert set(weights.tensors) == set(random_state("alex"))
    for name, tensor in weights.tensors.items():
        assert torch.equal(tensor, random_state("alex")[name])


def fake_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[Path, Path]:
    """Fake the package lpips as pip installs it; its backbone is in torch's download cache."""
    site, hub = tmp_path / "site", tmp_path / "hub"
    (site / "lpips").mkdir(parents=True)
    (site / "lpips" / "__init__.py").write_text("raise RuntimeError('must not be imported')\n")
    monkeypatch.syspath_prepend(str(site))
    monkeypatch.setenv("TORCH_HOME", str(hub))
    monkeypatch.delenv(LPIPS_VARIABLE, raising=False)
    backbone = hub / "hub" / "checkpoints" / "alexnet-owt-7be5be79.pth"
    return backbone, site / "lpips" / "weights" / "v0.1" / "alex.pth"


def test_weights_are_found_in_the_lpips_package(tmp_path, monkeypatch) -> None:
    backbone, heads = fake_package(tmp_path, monkeypatch)
    state = random_state("alex")
    features = {k: v for k, v in state.items() if k.startswith("features")}
    save({**features, "classifier.1.weight": torch.zeros(3, 3)}, backbone)
    lins = {k: v for k, v in state.items() if k.startswith("lin")}
    save({k.replace(".weight", ".model.1.weight"): v for k, v in lins.items()}, heads)
    weights = load_lpips("alex")
    assert weights.source == f"{backbone} and {heads}"
    assert all(torch.equal(weights.tensors[name], state[name]) for name in state)


def test_a_missing_backbone_is_an_error_with_advice(tmp_path, monkeypatch) -> None:
    backbone, _ = fake_package(tmp_path, monkeypatch)
    with pytest.raises(MissingDependencyError) as error:
        load_lpips("alex")
    assert str(error.value) == (
        f"the weights must include {backbone}, found none; fetch it once with: "
        f"python -c \"import lpips; lpips.LPIPS(net='alex')\"."
    )


def test_missing_weights_are_an_error_with_advice(monkeypatch) -> None:
    monkeypatch.delenv(LPIPS_VARIABLE, raising=False)
    monkeypatch.setattr(sys.modules["cvtgs.evaluation.lpips"], "find_spec", lambda name: None)
    monkeypatch.setattr("torch.__version__", "2.13.0+cpu")
    first, second = random_images(31, 31)
    with pytest.raises(MissingDependencyError) as error:
        lpips(first, second)
    assert str(error.value) == (
        "the weights must be at the path CVTGS_LPIPS_WEIGHTS or in the package lpips, found "
        'neither; install it with python -m pip install "cvtgs[lpips]" torch==2.13.0, which keeps '
        "this torch."
    )


def test_invalid_arguments_are_refused() -> None:
    images = random_images(30, 40)
    with pytest.raises(InvalidArgumentError) as error:
        lpips(*images, network="alex", weights=random_weights("alex"))
    assert (
        str(error.value)
        == "there must be images of at least 31 x 31 pixels, found 1 image of 40 x 30."
    )
    with pytest.raises(InvalidArgumentError) as error:
        lpips(*images, weights=random_weights("alex"))
    assert str(error.value) == (
        "the weights must be those of network 'vgg', found those of 'alex' (random)."
    )
    with pytest.raises(InvalidArgumentError) as error:
        lpips(*images, network="squeeze")  # type: ignore[arg-type]
    assert str(error.value) == "network must be 'alex' or 'vgg', found 'squeeze'."


def test_invalid_files_are_refused(tmp_path) -> None:
    def text(error: type[Exception], path: Path, network: str = "alex") -> str:
        with pytest.raises(error) as caught:
            load_lpips(network, path)
        return str(caught.value).removeprefix(f"{path}: ")

    state = dict(random_state("alex"))
    good = save(state, tmp_path / "alex.pth")
    assert text(InputNotFoundError, tmp_path / "no.pth") == (
        "the file to read must exist, found none."
    )
    assert text(InputNotFoundError, tmp_path) == (
        "the folder must hold a file lpips_alex*.pth, found none."
    )
    assert text(FileFormatError, good, "vgg") == (
        "the LPIPS network 'vgg' must have features.0.weight of shape (64, 3, 3, 3), "
        "found (64, 3, 11, 11); are these its weights?"
    )
    damaged = "must be a state dict that torch.load(weights_only=True) reads, found none; "
    damaged += "the file may be damaged."
    for number, data in enumerate((b"", b"no pickle at all", good.read_bytes()[:5000])):
        path = tmp_path / f"{number}.pth"
        path.write_bytes(data)
        assert text(FileFormatError, path) == damaged
    torch.save([1, 2], tmp_path / "list.pth")
    assert text(FileFormatError, tmp_path / "list.pth") == (
        "must hold a state dict, found an object of type list."
    )
    save({k: v for k, v in state.items() if k != "lin2.weight"}, tmp_path / "less.pth")
    assert text(FileFormatError, tmp_path / "less.pth") == (
        "the LPIPS network 'alex' must have lin2.weight of shape (1, 384, 1, 1), found none; "
        "are these its weights?"
    )
    nan = torch.full_like(state["features.0.bias"], math.nan)
    save({**state, "features.0.bias": nan}, tmp_path / "nan.pth")
    assert text(FileFormatError, tmp_path / "nan.pth") == (
        "features.0.bias must hold finite floats, found others."
    )
    if hasattr(os, "geteuid") and os.geteuid() != 0:
        good.chmod(0)
        assert text(InputError, good) == "the file must be readable, found: permission denied."


def test_distances_with_published_weights_grow_with_distortion() -> None:
    folder = Path(os.environ.get("CVTGS_SHARED", "")) / "weights"
    if not list(folder.glob("lpips_alex*.pth")):
        pytest.skip("set CVTGS_SHARED to a folder with weights/lpips_alex*.pth")
    weights = load_lpips("alex", folder)
    y, x = torch.meshgrid(torch.arange(64.0), torch.arange(72.0), indexing="ij")
    image = torch.stack([0.5 + 0.4 * torch.sin(x / k + y / 3) for k in (2, 3, 5)], dim=-1)[None]
    g = torch.Generator().manual_seed(0)
    noise = torch.randn(image.shape, generator=g)

    def distance(other: torch.Tensor) -> float:
        return lpips(image, other, network="alex", weights=weights).item()

    def blurred(side: int) -> torch.Tensor:
        channels = image.permute(0, 3, 1, 2)
        pooled = torch.nn.functional.avg_pool2d(
            channels, side, stride=1, padding=side // 2, count_include_pad=False
        )
        return pooled.permute(0, 2, 3, 1)

    assert distance(image) == 0.0
    by_noise = [distance(image + size * noise) for size in (0.02, 0.1, 0.3)]
    by_blur = [distance(blurred(side)) for side in (3, 5, 9)]
    for values in (by_noise, by_blur):
        assert 0 < values[0] < values[1] < values[2] < 2


def test_without_weights_the_note_is_the_error_without_its_full_stop(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def none(network: str) -> None:
        raise InputError(f"there are no weights of {network}.")

    monkeypatch.setattr("cvtgs.evaluation.scorer.load_lpips", none)
    found = chosen_metrics("auto", (64, 64))
    assert (found.lpips, found.note) == (None, "there are no weights of alex")


def test_lpips_that_nobody_asked_for_needs_no_sentence() -> None:
    settings: dict[str, Any] = {
        "reference": "a",
        "reference_count": 5,
        "views": (),
        "width": 8,
        "height": 8,
    }
    for note, sentence in {
        NOT_ASKED_FOR: "",
        "": "",
        "there is no weight": "LPIPS was not measured: there is no weight.",
    }.items():
        found = Evaluation(backend="torch", scenes=(), lpips_note=note, **settings)
        assert found.lpips_sentence == sentence
