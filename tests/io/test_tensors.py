"""Named tensors in files: round trips, equal bytes, damage."""

import json
import os

import pytest
import torch

from cvtgs.errors import FileFormatError, InputNotFoundError, OutputError
from cvtgs.io.tensors import map_tensors, pack_tensors, save_tensors, unpack_tensors

TENSORS = {
    "b": torch.arange(6, dtype=torch.int32).reshape(2, 3),
    "a/half": torch.tensor([1.5, float("inf"), float("nan")], dtype=torch.float16),
    "a/double": torch.tensor(0.1, dtype=torch.float64),
    "none": torch.zeros(0, 3),
    "flags": torch.tensor([True, False]),
}
METADATA = {"who": "ich, ü ∞", "what": '{"x": "quoted"}', "empty": ""}


def content_of(tensors: dict[str, torch.Tensor]) -> dict[str, tuple]:
    return {
        name: (values.dtype, tuple(values.shape), values.numpy().tobytes())
        for name, values in tensors.items()
    }


def test_the_bytes_of_a_file_are_as_expected():
    """Eight bytes of length, the header padded to eight, then the numbers."""
    content = pack_tensors({"x": torch.tensor([1, 2], dtype=torch.uint8)}, {"k": "v"})
    length = int.from_bytes(content[:8], "little")
    assert length % 8 == 0
    assert json.loads(content[8 : 8 + length]) == {
        "__metadata__": {"k": "v"},
        "x": {"dtype": "U8", "shape": [2], "data_offsets": [0, 2]},
    }
    assert content[8 + length :] == b"\x01\x02"


@pytest.mark.parametrize("metadata", [METADATA, {}])
@pytest.mark.parametrize("tensors", [TENSORS, {}])
def test_round_trip_through_bytes_and_files(tmp_path, tensors, metadata):
    path = tmp_path / "some.safetensors"
    save_tensors(path, tensors, metadata)
    for found, texts in (unpack_tensors(path.read_bytes()), map_tensors(path)):
        assert content_of(found) == content_of(tensors)
        assert texts == metadata
    assert path.read_bytes() == pack_tensors(tensors, metadata)


def test_the_order_of_tensors_and_metadata_does_not_matter():
    first = pack_tensors(TENSORS, METADATA)
    turned = dict(reversed(list(TENSORS.items()))), dict(reversed(list(METADATA.items())))
    assert all(pack_tensors(*turned) == first for _ in range(5))


def test_views_of_tensors_and_tensors_with_gradients_are_stored_by_value():
    whole = torch.arange(12.0).reshape(3, 4).requires_grad_()
    found, _ = unpack_tensors(pack_tensors({"t": whole.T, "part": whole[1]}, {}))
    assert found["t"].tolist() == whole.T.tolist()
    assert found["part"].tolist() == [4.0, 5.0, 6.0, 7.0]
    assert not found["t"].requires_grad


def test_an_existing_file_is_replaced(tmp_path):
    path = tmp_path / "some.safetensors"
    for number in (1.0, 2.0):
        save_tensors(path, {"x": torch.tensor([number])}, {})
    assert map_tensors(str(path))[0]["x"].tolist() == [2.0]
    assert [entry.name for entry in tmp_path.iterdir()] == [path.name]


@pytest.mark.skipif(os.name == "nt", reason="Windows does not replace mapped files")
def test_mapped_tensors_outlive_their_file(tmp_path):
    path = tmp_path / "some.safetensors"
    save_tensors(path, {"x": torch.arange(1000)}, {})
    mapped, _ = map_tensors(path)
    save_tensors(path, {"x": torch.zeros(1000)}, {})
    assert mapped["x"].tolist() == list(range(1000))


DAMAGE = {
    "empty": lambda content: b"",
    "cut short": lambda content: content[:-1],
    "header cut": lambda content: content[:20],
    "longer": lambda content: content + b"\0",
    "length too large": lambda content: (10**9).to_bytes(8, "little") + content[8:],
    "header no JSON": lambda content: content[:8] + b"!" + content[9:],
    "a pickle": lambda content: b"\x80\x04\x95" + content,
    "offsets": lambda content: content.replace(b'"data_offsets":[', b'"data_offsets":[9'),
    "dtype": lambda content: content.replace(b'"F16"', b'"F99"'),
}


@pytest.mark.parametrize("damage", DAMAGE.values(), ids=DAMAGE)
def test_damaged_bytes_are_refused(tmp_path, damage):
    content = damage(pack_tensors(TENSORS, METADATA))
    with pytest.raises(
        FileFormatError, match=r"^must be the bytes of a safetensors file, found others\.$"
    ):
        unpack_tensors(content)
    path = tmp_path / "some.safetensors"
    path.write_bytes(content)
    with pytest.raises(FileFormatError) as caught:
        map_tensors(path)
    assert str(caught.value) == f"{path}: must be an intact safetensors file, found damage."


def test_a_missing_file_is_refused(tmp_path):
    for path in (tmp_path / "none.safetensors", tmp_path):
        with pytest.raises(InputNotFoundError) as caught:
            map_tensors(path)
        assert str(caught.value) == f"{path}: the file to read must exist, found none."


def test_a_file_that_cannot_be_written_is_an_output_error(tmp_path):
    with pytest.raises(OutputError, match="existing directory"):
        save_tensors(tmp_path / "nowhere" / "some.safetensors", TENSORS, {})
