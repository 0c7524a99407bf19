"""Scenes in the dictionaries of gsplat and nerfstudio, and in checkpoints that hold one."""

import codecs
import pickletools
import re
import threading
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, nullcontext
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from cvtgs.errors import CvtgsError, FileFormatError, InvalidSceneError, is_out_of_memory, warn
from cvtgs.io.files import is_file, open_input
from cvtgs.math import parameters
from cvtgs.math.spherical_harmonics import SH_C0
from cvtgs.scene import GaussianScene, check_scene
from cvtgs.text import shown

_TENSORS = {
    "means": "means",
    "quats": "quats",
    "scales": "log_scales",
    "opacities": "logit_opacities",
    "sh0": "sh0",
    "features_dc": "sh0",
    "shN": "shN",
    "features_rest": "shN",
}
_NEEDED = ("means", "quats", "scales", "opacities", "sh0")
_KNOWN = (
    "means, quats, scales, opacities, sh0 (or features_dc) and, above SH degree 0, "
    "shN (or features_rest)"
)

_FEWEST_JUDGED = 100  # values of fewer Gaussians are never reported as unlikely
# Scales look activated if all are above 0 and their median is below this. As logarithms, they
# would be of Gaussians of nearly one size above one unit; standard deviations are often like that.
_SMALL_SCALE = 0.5

# Names that a checkpoint may refer to: those that tensors and numbers need. ``torch.FloatStorage``
# and the like only name a type, but the classes in ``torch.storage`` can be called: such a tensor
# would show what the process had in its memory before.
_ALLOWED = re.compile(
    r"collections\.(OrderedDict|defaultdict)|torch\._utils\._rebuild_(tensor(_v2)?|parameter)|"
    r"torch\.(\w+Storage|Size|device|u?int\d+|b?float\d+(_\w+)?|bool|nn\.parameter\.Parameter)|"
    r"numpy(\._?core\.multiarray\.scalar|\.dtype)|_codecs\.encode|"
    r"(builtins|__builtin__)\.(dict|list|set|tuple|int|float|complex)"
)
_NUMPY_NAMES = {
    "numpy.dtype",
    "numpy.core.multiarray.scalar",  # numpy 1
    "numpy._core.multiarray.scalar",
    "_codecs.encode",
}
_STAND_INS = threading.Lock()  # held while stand-ins for these are among torch's safe names
_BYTE_CODECS = re.compile(r"(?i)(hex|base.?64|quopri|quoted.?printable|uu|bz2|zlib|zip)(.?codec)?")
_PREFIXES = ("", "_model.gauss_params.", "_model.", "module._model.gauss_params.")


def from_dict(
    mapping: Mapping[str, Tensor | NDArray[Any]] | torch.nn.ParameterDict,
    *,
    activated: bool = False,
) -> GaussianScene:
    """Convert the dictionary of a gsplat or nerfstudio (Splatfacto) model to a scene.

    Tensors are detached, and share memory with the mapping unless their values or dtype change;
    numpy arrays are copied. Half precision becomes float32; if dtypes differ, the widest is used.

    Args:
        mapping: ``means (n, 3)``, ``quats (n, 4)`` w first, ``scales (n, 3)``, ``opacities (n,)``
            or ``(n, 1)``, ``sh0 (n, 1, 3)`` or ``features_dc (n, 3)``, and ``shN (n, k, 3)`` or
            ``features_rest (n, k, 3)``, which may be missing. A dictionary, or the
            ``torch.nn.ParameterDict`` that gsplat trains. A common prefix such as
            ``_model.gauss_params.`` is accepted; names without it are then ignored.
        activated: Whether scales (at least 0) and opacities (0 to 1) are activated. By default
            they are logarithms and logits, as both models store them; a warning is issued if such
            values look activated.

    Returns:
        The scene, on the device of the tensors.

    Raises:
        InvalidSceneError: It is no dictionary, a name is missing, unknown or duplicate, or a value
            is invalid.

    Example:
        >>> scene = from_dict({
        ...     "means": torch.zeros(2, 3), "quats": torch.ones(2, 4), "scales": torch.ones(2, 3),
        ...     "opacities": torch.tensor([0.5, 0.5]), "sh0": torch.zeros(2, 1, 3),
        ... }, activated=True)
        >>> scene.log_scales[0].tolist(), scene.logit_opacities.tolist()
        ([0.0, 0.0, 0.0], [0.0, 0.0])
    """
    if not hasattr(mapping, "keys"):
        raise InvalidSceneError(f"a scene is made from a dictionary, found {shown(mapping)}.")
    mapping = dict(mapping)
    tensors = {name: _as_tensor(key, mapping[key]) for name, key in _keys(mapping).items()}
    double = any(tensor.dtype == torch.float64 for tensor in tensors.values())
    dtype = torch.float64 if double else torch.float32
    tensors = {name: tensor.to(dtype) for name, tensor in tensors.items()}
    if tensors["sh0"].ndim == 2:
        tensors["sh0"] = tensors["sh0"][:, None, :]
    if tensors["logit_opacities"].ndim == 2 and tensors["logit_opacities"].shape[1] == 1:
        tensors["logit_opacities"] = tensors["logit_opacities"][:, 0]
    if "shN" not in tensors:
        tensors["shN"] = tensors["means"].new_zeros(len(tensors["means"]), 0, 3)
    if activated:
        scales, opacities = tensors["log_scales"], tensors["logit_opacities"]
        _check_values("scales", scales < 0, required="at least 0")
        _check_values("opacities", (opacities < 0) | (opacities > 1), required="from 0 to 1")
        tensors["log_scales"] = parameters.positive_log(scales)
        tensors["logit_opacities"] = parameters.logit_from_opacity(opacities)
    scene = GaussianScene(**tensors, extras={}, comments=(), layout=())
    if not activated and (unlikely := _activated_values(scene)):
        warn(
            f"{' and '.join(unlikely)}: they are read as stored values (logarithms of scales, "
            f"logits of opacities) but look activated; if they are, pass activated=True."
        )
    return scene


def _activated_values(scene: GaussianScene) -> list[str]:
    """Describe the scales and opacities of a scene that look activated instead of stored."""
    opacities, scales = (
        values[values.isfinite()] for values in (scene.logit_opacities, scene.log_scales)
    )
    if min(len(opacities), len(scales)) < _FEWEST_JUDGED:
        return []
    found = []
    least, most = (float(value) for value in opacities.aminmax())
    if 0 <= least < most <= 1:
        found.append(f"opacities from {least:.3g} to {most:.3g}")
    least, most = (float(value) for value in scales.aminmax())
    if least > 0 and float(scales.median()) < _SMALL_SCALE:
        found.append(f"scales from {least:.3g} to {most:.3g}")
    return found


def to_dict(scene: GaussianScene) -> dict[str, Tensor]:
    """Return a scene as the dictionary that gsplat trains.

    Args:
        scene: The scene.

    Returns:
        ``means (n, 3)``, ``quats (n, 4)`` w first, ``scales (n, 3)`` as logarithms, ``opacities
        (n,)`` as logits, ``sh0 (n, 1, 3)``, ``shN (n, k, 3)``; they share memory with the scene.
        Extra columns, comments and layout are left out.

    Raises:
        InvalidArgumentError: It is no scene.

    Example:
        >>> scene = from_dict({
        ...     "means": torch.zeros(2, 3), "quats": torch.ones(2, 4), "scales": torch.ones(2, 3),
        ...     "opacities": torch.zeros(2), "sh0": torch.zeros(2, 1, 3),
        ... })
        >>> list(to_dict(scene))
        ['means', 'quats', 'scales', 'opacities', 'sh0', 'shN']
    """
    check_scene(scene)
    return {name: getattr(scene, _TENSORS[name]) for name in (*_NEEDED, "shN")}


def _keys(mapping: Mapping[str, Any]) -> dict[str, str]:
    """Return the key of each tensor; their common prefix is the text before ``means``."""
    ends = [key for key in mapping if str(key) == "means" or str(key).endswith(".means")]
    if len(ends) > 1:
        raise InvalidSceneError(f"means must occur once, found {' and '.join(map(repr, ends))}.")
    prefix = ends[0].removesuffix("means") if ends else ""
    keys: dict[str, str] = {}
    for key in mapping:
        is_text = isinstance(key, str)
        if is_text and not key.startswith(prefix):
            continue
        name = _TENSORS.get(key.removeprefix(prefix)) if is_text else None
        if name is None:
            is_inner = isinstance(mapping.get("splats"), Mapping)  # as gsplat saves it
            hint = "; pass the dictionary at 'splats'" if is_inner else ""
            raise InvalidSceneError(f"the names must be {_KNOWN}, found {shown(key)}{hint}.")
        if name in keys:
            raise InvalidSceneError(
                f"a dictionary must hold {name} once, found {shown(keys[name])} and {shown(key)}."
            )
        keys[name] = key
    missing = [name for name in _NEEDED if _TENSORS[name] not in keys]
    if missing:
        raise InvalidSceneError(f"a dictionary must hold {_KNOWN}, found no {', '.join(missing)}.")
    return keys


def _check_tensors(mapping: Mapping[Any, Any]) -> None:
    """Check that values are dense tensors of rows in memory, before any is copied."""
    for name, value in mapping.items():
        if not isinstance(value, Tensor):
            kind = type(value).__name__
        elif value.is_nested:
            kind = "a nested one"
        elif value.layout != torch.strided:
            kind = f"layout {str(value.layout).removeprefix('torch.')}"
        elif value.is_meta:
            kind = "one without values (device meta)"
        elif value.ndim == 0:
            kind = "a single number"
        else:
            continue
        raise InvalidSceneError(f"{name} must be a dense tensor of rows, found {kind}.")


def _as_tensor(key: str, value: Tensor | NDArray[Any]) -> Tensor:
    if isinstance(value, np.ndarray):
        native = value.dtype.newbyteorder("=")
        is_known = native.kind == "f" and native.itemsize <= 8  # not numpy's longdouble
        value = torch.from_numpy(value.astype(native)) if is_known else value
    if not isinstance(value, Tensor) or not value.is_floating_point():
        raise InvalidSceneError(
            f"{key} must be a torch.Tensor or numpy array of floats, "
            f"found {getattr(value, 'dtype', type(value).__name__)}."
        )
    _check_tensors({key: value})
    return value.detach()


def _check_values(name: str, wrong: Tensor, *, required: str) -> None:
    rows = wrong.any(dim=1) if wrong.ndim > 1 else wrong
    count = int(rows.sum())
    if count:
        raise InvalidSceneError(
            f"activated {name} must be {required}, found {count:,} rows that are not, "
            f"the first is row {int(rows.nonzero()[0])}; pass activated=False for stored values."
        )


def read_checkpoint(path: Path, *, trust_sizes: bool = False) -> GaussianScene:
    """Read the scene of a checkpoint of nerfstudio's Splatfacto or gsplat's trainer.

    Nothing in the file is executed, and only the scene is loaded, not the state of the optimiser.
    """
    second = path.with_name(path.name.replace("_rank0.pt", "_rank1.pt"))
    if second != path and is_file(second):
        warn(
            f"{path}: holds the Gaussians of one GPU; {second.name} and further files beside it "
            f"hold the others: add them with cvtgs convert IN OUT --merge FILE."
        )
    try:
        tensors, splatfacto = _scene_tensors(_unpickled(path), path)
        _check_tensors(tensors)
        if not trust_sizes:
            _check_stored(path, tensors)
        scene = from_dict({name: tensor.clone() for name, tensor in tensors.items()})
    except InvalidSceneError as error:
        raise FileFormatError(f"{path}: {error}") from error
    except CvtgsError:
        raise
    except Exception as error:  # torch's messages may advise letting the file execute any code
        if is_out_of_memory(error):
            raise
        kind = type(error).__name__
        raise FileFormatError(
            f"{path}: must be an intact checkpoint of tensors and plain numbers, found damage "
            f"({kind})."
        ) from error
    if splatfacto and scene.sh_degree == 0:
        colors = torch.sigmoid(scene.sh0)  # through which it trains them at this degree
        return scene.with_tensors({"sh0": (colors - 0.5) / SH_C0}, {})
    return scene


def _check_stored(path: Path, tensors: Mapping[str, Tensor]) -> None:
    """Refuse tensors that repeat numbers instead of storing each of them."""
    for name, tensor in tensors.items():
        wanted, stored = tensor.numel() * tensor.element_size(), tensor.untyped_storage().nbytes()
        if wanted > stored:
            raise FileFormatError(
                f"{path}: {shown(name)} must store each of its {wanted:,} bytes, found {stored:,}; "
                f"if you trust the file, pass trust_sizes=True (--trust-sizes)."
            )


def _scene_tensors(content: Any, path: Path) -> tuple[dict[str, Tensor], bool]:
    """Return the tensors, and whether they are from Splatfacto."""
    groups = content if isinstance(content, Mapping) else {}
    group = next((name for name in ("splats", "pipeline") if name in groups), "")
    state = groups[group] if group else groups  # the dictionary of tensors may be all there is
    state = state if isinstance(state, Mapping) else {}
    for prefix in _PREFIXES:
        tensors = {name: state[prefix + name] for name in _TENSORS if prefix + name in state}
        if "means" in tensors:
            return tensors, "features_dc" in tensors
    found = ", ".join(shown(name) for name in islice(state, 5)) or "nothing of it"
    found += ", ..." if len(state) > 5 else ""
    raise FileFormatError(
        f"{path}: a checkpoint must hold a scene (means, quats and so on) under 'splats' (gsplat) "
        f"or 'pipeline' (nerfstudio's Splatfacto), found {found}"
        f"{f' under {group!r}' if group else ''}."
    )


def _unpickled(path: Path) -> Any:
    """Load a checkpoint by memory mapping, so that only tensors that are copied are read."""
    with open_input(path) as file:
        if not zipfile.is_zipfile(file):
            raise FileFormatError(
                f"{path}: must be a whole zip as torch.save writes, found another format or a "
                f"part; if torch can load it, save it again."
            )
    names = set[str]()
    for name in _names_in(path):
        if not _ALLOWED.fullmatch(name):
            raise FileFormatError(
                f"{path}: must be an intact checkpoint of tensors and plain numbers, "
                f"found {shown(name)}; save the dictionary of tensors without other objects."
            )
        names.add(name)
    with _numpy_numbers_ignored() if names & _NUMPY_NAMES else nullcontext():
        return torch.load(path, map_location="cpu", weights_only=True, mmap=True)


def _names_in(path: Path) -> Iterator[str]:
    """Yield the names in the pickles of a checkpoint, and what ``torch.save`` never writes.

    ``weights_only`` blocks code, but allows ``bytearray`` and other names that take any memory.
    """
    with zipfile.ZipFile(path) as archive:
        entries = archive.infolist()
        for entry in entries:
            if entry.compress_type != zipfile.ZIP_STORED:  # torch.save never compresses
                yield f"a compressed {entry.filename}"
            elif entry.compress_size != entry.file_size:
                yield f"two different lengths of {entry.filename}"
        for entry in entries:
            if entry.filename.endswith(".pkl"):
                for operation, value, _ in pickletools.genops(archive.read(entry)):
                    if operation.name in ("GLOBAL", "INST"):
                        yield str(value).replace(" ", ".")
                    elif operation.name == "PROTO" and value != 2:  # torch would warn
                        yield f"protocol {value}"
                    elif isinstance(value, str) and _BYTE_CODECS.fullmatch(value):
                        yield value


class _IgnoredType:
    """A stand-in for numpy scalars and their types, which builds nothing."""

    def __init__(self, *_: Any) -> None:
        pass

    def __setstate__(self, state: Any) -> None:
        pass


@contextmanager
def _numpy_numbers_ignored() -> Iterator[None]:
    """Let torch's unpickler ignore numpy scalars (learning rates), which it would refuse.

    Names that it allows are of the whole process; those that the program adds meanwhile stay.
    """
    stand_ins: list[Any] = [codecs.encode]  # torch 2.6 and later allows it anyway
    for path in sorted(_NUMPY_NAMES - {"_codecs.encode"}):
        module, _, name = path.rpartition(".")
        stand_ins.append(type(name, (_IgnoredType,), {"__module__": module}))
    with _STAND_INS:
        own = [item for item in stand_ins if item not in torch.serialization.get_safe_globals()]
        torch.serialization.add_safe_globals(own)
        try:
            yield
        finally:
            others = [item for item in torch.serialization.get_safe_globals() if item not in own]
            torch.serialization.clear_safe_globals()
            torch.serialization.add_safe_globals(others)
