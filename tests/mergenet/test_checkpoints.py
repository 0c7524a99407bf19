"""Checkpoints: exact round trips, and one clear sentence for every invalid file."""

import hashlib
import json
import pickle
import random
from pathlib import Path

import pytest
import torch
from safetensors.torch import save

from cvtgs.errors import CheckpointError
from cvtgs.io.tensors import tensors_digest
from cvtgs.mergenet import (
    SHIPPED,
    Architecture,
    CheckpointInfo,
    MergeNet,
    encode_checkpoint,
    load_checkpoint,
)
from cvtgs.mergenet.checkpoint import LARGEST_FILE
from cvtgs.mergenet.model import SUMMARY_FEATURES
from mergenet_cases import fields_of, lively_net, some_case

SMALL = Architecture(width=2, cell_width=3)
INFO = CheckpointInfo(
    architecture=SMALL, preset="paper", training="two scenes, grün", seed=7, steps=12, version="0.1"
)


@pytest.fixture
def path(tmp_path) -> Path:
    return tmp_path / "net.safetensors"


def content_of(said: CheckpointInfo = INFO, /, **changes: str | None) -> bytes:
    """Return a checkpoint with other texts in its header; None leaves one out."""
    original = encode_checkpoint(lively_net(torch.float32, architecture=said.architecture), said)
    length = int.from_bytes(original[:8], "little")
    header = json.loads(original[8 : 8 + length])
    texts = header["__metadata__"] | changes
    header["__metadata__"] = {key: text for key, text in texts.items() if text is not None}
    text = json.dumps(header).encode()
    return len(text).to_bytes(8, "little") + text + original[8 + length :]


def refusal(path: Path, content: bytes | None = None) -> str:
    """Return the error for a file without the file name, with which it must start."""
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(CheckpointError) as caught:
        load_checkpoint(path)
    start, end, text = f"{path}: ", ".", str(caught.value)
    assert text.startswith(start)
    assert text.endswith(end)
    assert "\n" not in text
    return text.removeprefix(start)


@pytest.mark.parametrize("architecture", [SMALL, Architecture()])
def test_saving_and_loading_gives_the_same_network(path, architecture):
    net = lively_net(torch.float32, architecture=architecture)
    info = INFO.model_copy(update={"architecture": architecture})
    path.write_bytes(encode_checkpoint(net, info))
    loaded = load_checkpoint(path)
    assert loaded.info == info
    assert loaded.name == str(path)
    assert loaded.net.architecture == architecture
    ours, theirs = net.state_dict(), loaded.net.state_dict()
    assert list(ours) == list(theirs)
    assert all(torch.equal(ours[name], theirs[name]) for name in ours)
    seen = some_case(dtype=torch.float32).describe()
    first, second = fields_of(net(seen)), fields_of(loaded.net(seen))
    assert all(torch.equal(first[name], second[name]) for name in first)


def test_a_loaded_network_is_ready_for_inference(path):
    path.write_bytes(content_of())
    net = load_checkpoint(str(path)).net
    assert not net.training
    assert not any(values.requires_grad for values in net.parameters())
    assert {values.dtype for values in net.parameters()} == {torch.float32}
    assert {values.device.type for values in net.parameters()} == {"cpu"}


@pytest.mark.parametrize("name", SHIPPED)
def test_loading_changes_no_state_of_the_process_even_for_a_moment(path, name, monkeypatch):
    """Other threads would see other random numbers, or another default dtype."""
    shipped = load_checkpoint(name)
    path.write_bytes(encode_checkpoint(shipped.net, shipped.info))
    before, dtype = torch.get_rng_state(), torch.get_default_dtype()
    torch.set_default_dtype(torch.float64)
    try:
        with monkeypatch.context() as patched:
            for place in ("set_default_dtype", "random.set_rng_state", "nn.init.kaiming_uniform_"):
                patched.setattr(f"torch.{place}", pytest.fail)
            net = load_checkpoint(path).net
    finally:
        torch.set_default_dtype(dtype)
    assert {values.dtype for values in net.state_dict().values()} == {torch.float32}
    assert torch.equal(torch.get_rng_state(), before)


def test_the_same_network_gives_the_same_bytes(path):
    net = lively_net(torch.float32, architecture=SMALL)
    contents = {encode_checkpoint(net, INFO) for _ in range(20)}
    assert len(contents) == 1
    path.write_bytes(contents.pop())
    loaded = load_checkpoint(path)
    assert encode_checkpoint(loaded.net, loaded.info) == path.read_bytes()
    assert encode_checkpoint(net.double(), INFO) == path.read_bytes()


def test_other_weights_or_descriptions_give_other_digests(path):
    digests = set()
    for seed, steps in ((0, 12), (1, 12), (0, 13)):
        net = lively_net(torch.float32, seed=seed, architecture=SMALL)
        path.write_bytes(encode_checkpoint(net, INFO.model_copy(update={"steps": steps})))
        digests.add(load_checkpoint(path).digest)
    assert len(digests) == 3
    assert {len(digest) for digest in digests} == {64}


def test_a_digest_by_hand(path):
    path.write_bytes(content_of())
    found = load_checkpoint(path)
    wanted = hashlib.sha256(f"{found.info.model_dump_json()}\n".encode())
    for name, values in sorted(found.net.state_dict().items()):
        wanted.update(f"{name} torch.float32 {tuple(values.shape)}\n".encode())
        wanted.update(values.numpy().tobytes())
    assert found.digest == wanted.hexdigest()


@pytest.mark.parametrize("name", SHIPPED)
def test_shipped_checkpoints_are_small_and_described(name, path):
    found = load_checkpoint(name)
    folder = Path(load_checkpoint.__code__.co_filename).parent / "data"
    content = (folder / f"{name}.safetensors").read_bytes()
    assert len(content) <= 3 * 2**20
    assert found.name == found.info.preset == name
    assert found.info.training
    # Files of the first format are saved in the current one, with a known range.
    path.write_bytes(encode_checkpoint(found.net, found.info))
    again = load_checkpoint(path)
    assert again.info == found.info
    ours, theirs = found.net.state_dict(), again.net.state_dict()
    assert all(torch.equal(ours[key], theirs[key]) for key in ours)


@pytest.mark.long
def test_every_flipped_bit_is_detected(path):
    """A random bit of every byte is flipped: in header, texts and weights."""
    net, dice = lively_net(torch.float32, architecture=SMALL), random.Random(0)
    content = encode_checkpoint(net, INFO)
    for place in range(len(content)):
        damaged = bytearray(content)
        damaged[place] ^= 1 << dice.randrange(8)
        assert len(refusal(path, bytes(damaged))) < 300


def test_every_truncation_is_detected(path):
    content = content_of()
    for length in {0, 1, 7, 8, 9, 100, *range(0, len(content), 97), len(content) - 1}:
        assert refusal(path, content[:length]) == (
            "the checkpoint is not a safetensors file, or it is damaged."
        )


def test_an_appended_byte_is_detected(path):
    refusal(path, content_of() + b"\0")


OTHER = {
    "nothing": b"",
    "text": b"not a checkpoint at all",
    "a pickle": pickle.dumps({"weights": [1.0, 2.0]}),
    "a header of null": b"\4\0\0\0\0\0\0\0null",
    "a header of a list": b"\2\0\0\0\0\0\0\0[]",
    "a giant header": b"\xff" * 8 + b"{}",
    "nested": (200_000).to_bytes(8, "little") + b"[" * 200_000,
}


@pytest.mark.parametrize("content", OTHER.values(), ids=OTHER)
def test_files_of_another_kind_are_refused(path, content):
    assert refusal(path, content) == "the checkpoint is not a safetensors file, or it is damaged."


def test_a_file_of_torch_is_not_unpickled(path):
    torch.save({"weights": torch.zeros(2)}, path)
    assert refusal(path) == "the checkpoint is not a safetensors file, or it is damaged."


@pytest.mark.parametrize("metadata", [None, {}, {"format": "pt"}])
def test_safetensors_of_another_format_are_refused(path, metadata):
    found = None if not metadata else "pt"
    assert refusal(path, save({"a": torch.zeros(2)}, metadata)) == (
        f"the file holds no MergeNet; its format must be 'cvtgs-mergenet', found {found!r}."
    )


def test_null_metadata_is_refused(path):
    text = b'{"__metadata__":null}'
    refusal(path, len(text).to_bytes(8, "little") + text)


@pytest.mark.parametrize("version", ["3", "10", "0", "-1", "1.5", "new", "9" * 5000, None])
def test_an_unknown_format_version_is_refused(path, version):
    assert refusal(path, content_of(format_version=version)) == (
        f"the checkpoint has format version {version}, but this cvtgs reads only versions up to 2; "
        f"update cvtgs."
    )


@pytest.mark.parametrize(
    ("info", "found"),
    [
        (None, "the value: invalid json: "),
        ("", "the value: invalid json: "),
        ("{}", "architecture: field required, found {}; "),
        ("[]", "the value: holds settings, found []."),
        ('{"preset": "standard", "depth": 3}', "architecture: field required, found {"),
    ],
)
def test_a_missing_or_invalid_description_is_refused(path, info, found):
    text = refusal(path, content_of(info=info))
    assert text.startswith(f"the checkpoint's description is missing or invalid: {found}")


def test_an_unknown_preset_is_refused(path):
    assert refusal(path, content_of(INFO.model_copy(update={"preset": "fast"}))) == (
        "the preset of the checkpoint must be one of standard, paper, found 'fast'."
    )


@pytest.mark.parametrize("feature", ["member_features", "pair_features", "cell_features"])
def test_other_numbers_of_features_are_refused(path, feature):
    ours = getattr(Architecture(), feature)
    other = SMALL.model_copy(update={feature: ours + 1})
    info = INFO.model_copy(update={"architecture": other})
    assert refusal(path, content_of(info)) == (
        f"the checkpoint has a different architecture: {feature} must be {ours}, found {ours + 1}."
    )


def test_weights_of_another_shape_are_refused(path):
    wider = lively_net(torch.float32, architecture=Architecture(width=3, cell_width=3))
    assert refusal(path, encode_checkpoint(wider, INFO)) == (
        "the checkpoint has a different architecture: cell_layers.0.weight, "
        "member_gates.cell.weight, member_gates.gates.weight do not fit."
    )


class Other(torch.nn.Module):
    """Some other network, with a number among its weights."""

    def __init__(self) -> None:
        super().__init__()
        self.scale = torch.nn.Parameter(torch.tensor(1.0))


def test_weights_of_another_network_are_refused(path):
    text = refusal(path, encode_checkpoint(Other(), INFO))
    assert text.startswith("the checkpoint has a different architecture: ")
    assert text.endswith(" do not fit.")


@pytest.mark.parametrize("value", [float("nan"), float("inf"), float("-inf")])
def test_weights_that_are_not_finite_are_refused(path, value):
    net = lively_net(torch.float32, architecture=SMALL)
    with torch.no_grad():
        net.decoder.bias[2] = value
    assert refusal(path, encode_checkpoint(net, INFO)) == (
        "the checkpoint holds weights that are not finite."
    )


def test_a_missing_file_is_refused(path):
    for missing in (path, path / "deeper"):
        assert refusal(missing) == "no such checkpoint; it must be standard or paper, or a file."


def test_an_impossible_file_name_is_refused():
    with pytest.raises(CheckpointError, match="no such checkpoint"):
        load_checkpoint("net\0.safetensors")


def test_a_folder_and_a_path_through_a_file_are_refused(path):
    text = "a checkpoint must be a file of at most 64 MiB, found a folder or a device."
    assert refusal(path.parent) == text
    path.write_bytes(b"")
    assert refusal(path / "deeper") == "the checkpoint cannot be read: not a directory."


def test_a_huge_file_is_not_read(path):
    with path.open("wb") as file:
        file.truncate(LARGEST_FILE + 1)
    assert refusal(path) == "a checkpoint must be a file of at most 64 MiB, found 67,108,865 bytes."


def test_an_untrained_network_is_a_valid_checkpoint(path):
    path.write_bytes(encode_checkpoint(MergeNet(SMALL), INFO))
    assert load_checkpoint(path).info == INFO


def test_a_file_of_the_first_version_corrects_every_cell(path):
    """It has no known range; its other tensors are unchanged."""
    net = lively_net(torch.float32, architecture=SMALL)
    weights = {name: v for name, v in net.state_dict().items() if not name.startswith("known.")}
    told = INFO.model_dump_json(exclude={"config", "start", "scenes"})
    path.write_bytes(packed(weights, told, version="1"))
    loaded = load_checkpoint(path)
    assert loaded.info == INFO
    seen = some_case(dtype=torch.float32).describe()
    first, second = fields_of(net(seen)), fields_of(loaded.net(seen))
    assert all(torch.equal(first[name], second[name]) for name in first)
    assert loaded.net.known(torch.full((1, SUMMARY_FEATURES), 1e9)).tolist() == [1.0]


def test_an_incomplete_known_range_is_refused(path):
    net = lively_net(torch.float32, architecture=SMALL)
    weights = {name: v for name, v in net.state_dict().items() if name != "known.low"}
    assert refusal(path, packed(weights, INFO.model_dump_json(), version="2")) == (
        "the checkpoint has a different architecture: known.low does not fit."
    )


def packed(weights: dict[str, torch.Tensor], told: str, *, version: str) -> bytes:
    """Return a checkpoint file of these tensors and this description."""
    metadata = {
        "format": "cvtgs-mergenet",
        "format_version": version,
        "info": told,
        "sha256": tensors_digest(weights, told),
    }
    return save(weights, metadata)
