"""Read scenes from checkpoints of gsplat's trainer and of nerfstudio's Splatfacto."""

import codecs
import pickletools
import re
import warnings
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from itertools import islice
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from cvtgs.errors import CvtgsError, FileFormatError, InvalidSceneError, is_out_of_memory, warn
from cvtgs.io.dicts import check_tensors, from_dict
from cvtgs.io.files import check_stored, is_file, open_input
from cvtgs.math.spherical_harmonics import SH_C0
from cvtgs.scene import GaussianScene
from cvtgs.text import shown

_NAMES = ("means", "quats", "scales", "opacities", "sh0", "shN", "features_dc", "features_rest")
_ALLOWED = re.compile(
    r"collections\.(OrderedDict|defaultdict)|torch\._utils\._rebuild_(tensor(_v2)?|parameter)|"
    r"torch\.(\w+Storage|Size|device|u?int\d+|b?float\d+(_\w+)?|bool|nn\.parameter\.Parameter)|"
    r"torch\.storage\.\w+Storage|numpy(\._?core\.multiarray\.scalar|\.dtype)|_codecs\.encode|"
    r"(builtins|__builtin__)\.(dict|list|set|tuple|int|float|complex)"
)
"""Names that a checkpoint may refer to: those that tensors and numbers need."""

_BYTE_CODECS = re.compile(r"(?i)(hex|base.?64|quopri|quoted.?printable|uu|bz2|zlib|zip)(.?codec)?")
_PREFIXES = ("", "_model.gauss_params.", "_model.", "module._model.gauss_params.")


def read_checkpoint(path: Path, *, trust_sizes: bool = False) -> GaussianScene:
    """Read the scene of a checkpoint.

    Two kinds are supported: ``step-000029999.ckpt`` of nerfstudio, which holds the scene under
    ``pipeline`` as ``_model.gauss_params.means`` (``_model.means`` before 2024) and so on; and
    ``ckpt_29999_rank0.pt`` of gsplat's examples, which holds it under ``splats``. Nothing in the
    file is executed, and only the scene is loaded, not the state of the optimiser. At SH degree 0,
    Splatfacto trains colours through a sigmoid; these are converted to the usual ``sh0``. A tensor
    that repeats numbers instead of storing them is refused, unless sizes are trusted. gsplat's
    trainer writes a part of the scene for each of several GPUs; a warning names the other files.
    """
    second = path.with_name(path.name.replace("_rank0.pt", "_rank1.pt"))
    if second != path and is_file(second):
        warn(
            f"{path}: holds the Gaussians of one GPU; {second.name} and further files beside it "
            f"hold the others: add them with cvtgs convert IN OUT --merge FILE."
        )
    try:
        tensors, splatfacto = _scene_tensors(_unpickled(path), path)
        check_tensors(tensors)
        if not trust_sizes:
            check_stored(path, tensors)
        scene = from_dict({name: tensor.clone() for name, tensor in tensors.items()})
    except InvalidSceneError as error:
        raise FileFormatError(f"{path}: {error}") from error
    except CvtgsError:
        raise
    except Exception as error:  # torch's messages may advise letting the file execute any code
        if is_out_of_memory(error):
            raise
        raise FileFormatError(
            f"{path}: must be an intact checkpoint of tensors and plain numbers, found damage "
            f"({type(error).__name__})."
        ) from error
    if splatfacto and scene.sh_degree == 0:
        colors = torch.sigmoid(scene.sh0)
        return scene.with_tensors({"sh0": (colors - 0.5) / SH_C0}, {})
    return scene


def _scene_tensors(content: Any, path: Path) -> tuple[dict[str, Tensor], bool]:
    """Return the tensors, and whether they are from Splatfacto."""
    groups = content if isinstance(content, Mapping) else {}
    for group in ("splats", "pipeline"):
        state = groups.get(group)
        if not isinstance(state, Mapping):
            continue
        for prefix in _PREFIXES:
            tensors = {name: state[prefix + name] for name in _NAMES if prefix + name in state}
            if "means" in tensors:
                return tensors, "features_dc" in tensors
    found = ", ".join(shown(name) for name in islice(groups, 5)) or "neither"
    found += ", ..." if len(groups) > 5 else ""
    raise FileFormatError(
        f"{path}: a checkpoint must hold a scene under 'splats' (gsplat) or "
        f"'pipeline' (nerfstudio's Splatfacto), found {found}."
    )


def _unpickled(path: Path) -> Any:
    """Load a checkpoint by memory mapping, so that only tensors that are copied are read."""
    with open_input(path) as file:
        if not zipfile.is_zipfile(file):
            raise FileFormatError(
                f"{path}: must be a checkpoint in the zip format of torch.save, "
                f"found another format."
            )
    for name in _names_in(path):
        if not _ALLOWED.fullmatch(name):
            raise FileFormatError(
                f"{path}: must be an intact checkpoint of tensors and plain numbers, "
                f"found {shown(name)}."
            )
    with _numpy_numbers_ignored(), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # from torch, about content that it then refuses
        return torch.load(path, map_location="cpu", weights_only=True, mmap=True)


def _names_in(path: Path) -> Iterator[str]:
    """Yield the names in the pickles of a checkpoint, codecs from bytes to bytes, and zip faults.

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
    """Let torch's restricted unpickler ignore numpy scalars (learning rates of schedulers).

    It would refuse them. Stand-ins with the same names take their place.
    """
    names = [("numpy", "dtype")]
    names += [(f"numpy.{core}.multiarray", "scalar") for core in ("core", "_core")]  # numpy 1 and 2
    stand_ins: list[Any] = [codecs.encode]  # torch 2.6 and later allows it anyway
    stand_ins += [type(name, (_IgnoredType,), {"__module__": module}) for module, name in names]
    before = list(torch.serialization.get_safe_globals())
    torch.serialization.add_safe_globals(stand_ins)
    try:
        yield
    finally:
        torch.serialization.clear_safe_globals()
        torch.serialization.add_safe_globals(before)
