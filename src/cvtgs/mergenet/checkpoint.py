"""Checkpoints: a MergeNet and a description of its training, in one safetensors file."""

import os
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import resources
from pathlib import Path

import pydantic
import torch
from torch import Tensor

from cvtgs.config import PRESETS, SimplifyConfig
from cvtgs.config.base import Record, explain
from cvtgs.errors import (
    CheckpointError,
    ConfigError,
    FileFormatError,
    InvalidArgumentError,
    check_path,
    reason_of,
    warn,
)
from cvtgs.io.tensors import pack_tensors, tensors_digest, unpack_tensors
from cvtgs.mergenet.model import Architecture, MergeNet, without_weights
from cvtgs.mergenet.published import Net, PublishedArchitecture, PublishedMergeNet
from cvtgs.text import printable_name, short_repr, shortened, shown

SHIPPED = ("standard", "paper")
"""Names of the checkpoints that come with the package."""

FORMAT = "cvtgs-mergenet"
FORMAT_VERSION = 2  # files of version 1 have no known range, so their networks correct every cell
KNOWN = "known."  # prefix of the names of the tensors of the known range
LARGEST_FILE = 1 << 26  # files above 64 MiB are not read; a MergeNet has less than 1 MiB
OTHER = "the checkpoint has a different architecture"  # start of messages


class LearnedScene(Record):
    """A scene that was used in training or validation.

    Attributes:
        name: Name of its file, without the suffix, or of the generated scene.
        count: Number of Gaussians.
        sha256: Hash of the file, hexadecimal; empty for a generated scene, which is determined by
            name, count and version of cvtgs.
        is_validation: Whether it was used for validation only.
        cameras_sha256: Hash of the file of its cameras, hexadecimal; empty if views were found.
    """

    name: str
    count: int
    sha256: str = ""
    is_validation: bool = False
    cameras_sha256: str = ""


class CheckpointInfo(Record):
    """Description of a checkpoint.

    Attributes:
        architecture: Kind and shape of the network.
        preset: The preset that the network corrects.
        training: Free-text description of the training data and method.
        seed: Seed of the training.
        steps: Number of training steps.
        version: Version of cvtgs that trained it.
        config: The configuration of the training as JSON, without paths; empty if unknown.
        start: Digest of the checkpoint from which training started; empty for none.
        scenes: Scenes of training and validation.
    """

    architecture: Architecture | PublishedArchitecture
    preset: str
    training: str = ""
    seed: int = 0
    steps: int = 0
    version: str = ""
    config: str = ""
    start: str = ""
    scenes: tuple[LearnedScene, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Checkpoint:
    """A network that is ready to use.

    Attributes:
        net: The network on the CPU, float32, without gradients.
        info: The description in the file.
        name: Name of the shipped checkpoint, or path of the file.
        digest: SHA-256 of the weights and of the description as the file words it, hexadecimal.
    """

    net: Net
    info: CheckpointInfo
    name: str
    digest: str

    __repr__ = short_repr


def load_checkpoint(source: str | os.PathLike[str]) -> Checkpoint:
    """Load a MergeNet.

    Args:
        source: ``standard`` or ``paper``, which come with the package, or the path of a file.

    Returns:
        The checkpoint.

    Raises:
        CheckpointError: There is no such file, or it is not a checkpoint, is damaged, or has a
            later format or another architecture.
        InvalidArgumentError: ``source`` is no path.

    Example:
        >>> load_checkpoint("standard").info.preset
        'standard'
    """
    check_path(source)
    name = os.fspath(source)
    path = Path(name)
    if name in SHIPPED:
        path = Path(str(resources.files("cvtgs.mergenet") / "data" / f"{name}.safetensors"))
    try:
        tensors, metadata = _unpack(_read(path, name))
        info = _parse_info(metadata)
        digest, stored = tensors_digest(tensors, metadata["info"]), metadata.get("sha256")
        if stored != digest:
            raise CheckpointError(
                f"the checkpoint is damaged: its content must have the hash "
                f"{str(stored)[:12]}..., found {digest[:12]}..."
            )
        net = _build_net(info, tensors)
    except CheckpointError as error:
        raise CheckpointError(f"{name}: {error}") from error.__cause__
    return Checkpoint(net=net, info=info, name=printable_name(name), digest=digest)


def encode_checkpoint(net: Net, info: CheckpointInfo) -> bytes:
    """Return the bytes of a checkpoint file.

    The same network and description give the same bytes.

    Args:
        net: The network.
        info: Its description.

    Returns:
        The bytes of a safetensors file, to be written with :func:`cvtgs.io.atomic_output`.

    Example:
        >>> info = CheckpointInfo(architecture=Architecture(), preset="standard")
        >>> len(encode_checkpoint(MergeNet(info.architecture), info)) < 200_000
        True
    """
    tensors = {name: values.float() for name, values in net.state_dict().items()}
    described = info.model_dump_json()
    metadata = {
        "format": FORMAT,
        "format_version": str(FORMAT_VERSION),
        "sha256": tensors_digest(tensors, described),
        "info": described,
    }
    return pack_tensors(tensors, metadata)


def _read(path: Path, name: str) -> bytes:
    try:
        if path.is_file() and path.stat().st_size <= LARGEST_FILE:
            return path.read_bytes()
        size = path.stat().st_size
    except (FileNotFoundError, ValueError):
        hint = f" For the preset, write preset={name!r} (--preset {name})." * (name in PRESETS)
        raise CheckpointError(
            f"no such checkpoint; it must be {' or '.join(SHIPPED)}, or a file.{hint}"
        ) from None
    except OSError as error:
        raise CheckpointError(f"the checkpoint cannot be read: {reason_of(error)}.") from error
    found = f"{size:,} bytes" if path.is_file() else "a folder or a device"
    raise CheckpointError(
        f"a checkpoint must be a file of at most {LARGEST_FILE >> 20} MiB, found {found}."
    )


def _unpack(content: bytes) -> tuple[dict[str, Tensor], dict[str, str]]:
    try:
        tensors, metadata = unpack_tensors(content)
    except FileFormatError as error:
        text = "the checkpoint is not a safetensors file, or it is damaged."
        raise CheckpointError(text) from error
    if metadata.get("format") != FORMAT:
        found = shown(metadata.get("format"))
        raise CheckpointError(
            f"the file holds no MergeNet; its format must be {FORMAT!r}, found {found}."
        )
    return tensors, metadata


def _parse_info(metadata: Mapping[str, str]) -> CheckpointInfo:
    version = metadata.get("format_version")
    if version not in {str(number) for number in range(1, FORMAT_VERSION + 1)}:
        raise CheckpointError(
            f"the checkpoint has format version {version}, but this cvtgs reads only versions up "
            f"to {FORMAT_VERSION}; update cvtgs."
        )
    try:
        info = CheckpointInfo.model_validate_json(metadata.get("info", ""))
    except pydantic.ValidationError as error:
        found = shortened(explain(error), 200)
        raise CheckpointError(
            f"the checkpoint's description is missing or invalid: {found}"
        ) from error
    if info.preset not in SHIPPED:
        raise CheckpointError(
            f"the preset of the checkpoint must be one of {', '.join(SHIPPED)}, "
            f"found {shown(info.preset)}."
        )
    ours, theirs = type(info.architecture)(), info.architecture
    for feature in ("member_features", "pair_features", "cell_features"):
        wanted, number = getattr(ours, feature, 0), getattr(theirs, feature, 0)
        if wanted != number:
            raise CheckpointError(f"{OTHER}: {feature} must be {wanted}, found {number}.")
    return info


def build_network(architecture: Architecture | PublishedArchitecture) -> Net:
    """Build an untrained network in float32 on the CPU."""
    if isinstance(architecture, PublishedArchitecture):
        return PublishedMergeNet(architecture)
    return MergeNet(architecture)


def _build_net(info: CheckpointInfo, tensors: dict[str, Tensor]) -> Net:
    with without_weights():
        net = build_network(info.architecture)
    if isinstance(net, MergeNet) and not any(key.startswith(KNOWN) for key in tensors):
        own = net.state_dict()
        tensors = tensors | {key: own[key] for key in own if key.startswith(KNOWN)}
    wanted = {key: (values.shape, values.dtype) for key, values in net.state_dict().items()}
    found = {key: (values.shape, values.dtype) for key, values in tensors.items()}
    odd = sorted(key for key in wanted | found if wanted.get(key) != found.get(key))
    if odd:
        verb = "does" if len(odd) == 1 else "do"
        raise CheckpointError(f"{OTHER}: {', '.join(odd[:3])} {verb} not fit.")
    if not all(bool(torch.isfinite(values).all()) for values in tensors.values()):
        raise CheckpointError("the checkpoint holds weights that are not finite.")
    net.load_state_dict(tensors)
    return net.eval().requires_grad_(False)


def checkpoint_for(
    ckpt: str | os.PathLike[str] | None, config: SimplifyConfig | None
) -> Checkpoint | None:
    """Return the checkpoint for a name or file and a configuration, or None for no network."""
    if ckpt is None or ckpt == "none":
        return None
    if not isinstance(ckpt, str | os.PathLike):
        hint = "; for a configuration, give config" if isinstance(ckpt, SimplifyConfig) else ""
        raise InvalidArgumentError(
            f"ckpt must be the name of a checkpoint, a file or None, found "
            f"{type(ckpt).__name__}{hint}."
        )
    if config is not None and not config.merge.network:
        if ckpt == "auto":
            return None
        raise ConfigError(
            f"without a network (merge.network is false, as in draft and fast), the checkpoint "
            f"must be auto or none; found {os.fspath(ckpt)!r}."
        )
    if ckpt == "auto":
        preset = "standard" if config is None else config.preset
        return load_checkpoint(preset if preset in SHIPPED else "standard")
    found = load_checkpoint(ckpt)
    if config is not None and (found.info.preset == "paper") != (config.preset == "paper"):
        warn(
            f"{found.name} was trained on cells of the preset {found.info.preset}, not of "
            f"{config.preset}; the result may be worse than without a network."
        )
    return found
