"""Scenes for training: where they come from, and their images and cases, cached in mapped files."""

import hashlib
import json
import random
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, fields, replace
from functools import cache, partial
from pathlib import Path
from typing import Any, TypeVar

import torch
from torch import Tensor

import cvtgs
from cvtgs import synthetic
from cvtgs.cameras import Cameras
from cvtgs.cells import Descriptors, Partition
from cvtgs.config import SimplifyConfig
from cvtgs.errors import ConfigError, warn
from cvtgs.evaluation.scorer import ViewImages
from cvtgs.io import load
from cvtgs.io.files import is_folder
from cvtgs.io.formats import READABLE_SUFFIXES
from cvtgs.io.tensors import add_prefix, map_tensors, save_tensors, under_prefix
from cvtgs.math import parameters
from cvtgs.mergenet import LearnedScene
from cvtgs.scene import GaussianScene
from cvtgs.tags import ANTIALIASED
from cvtgs.text import first_of
from cvtgs.train.cases import Case, MergedScene, make_case, render_targets
from cvtgs.train.config import DataConfig, TrainConfig
from cvtgs.validity import valid_part

VALIDATION_SEED = 1_000_000  # first seed of generated validation scenes
TAGGED = 0.5  # share of perturbed copies that are tagged ``SplatRenderMode: mip``; few files are

Content = TypeVar("Content", ViewImages, Case)

CACHE_VERSION = 9  # part of every cache key; increment it when the meaning of the content changes


@dataclass(frozen=True, slots=True, kw_only=True)
class Source:
    """A named scene that is made lazily.

    Attributes:
        name: Unique name.
        identity: Text that changes when the scene does; part of the key of its cache.
        is_validation: Whether it is for validation only.
        origin: The file or generated scene that it is or is derived from.
        make: Function that makes the scene.
        cameras: File of cameras for validation; None finds views.
    """

    name: str
    identity: str
    is_validation: bool
    origin: LearnedScene
    make: Callable[[], GaussianScene]
    cameras: Path | None = None


def find_sources(config: DataConfig, *, seed: int) -> list[Source]:
    """List the scenes of a training without making them: files by name, then generated ones."""
    files = [path for folder in config.folders for path in _files_in(folder)]
    names = [path.stem for path in files]
    given = (Path(name) for name in config.validation)
    stems = {path.stem if path.suffix.lower() == ".ply" else path.name for path in given}
    held_out = stems or set(names[1::5])
    missing = sorted(held_out - set(names))
    if missing:
        raise ConfigError(f"data.validation: no file named {missing[0]}.ply in data.folders.")
    sources = [*_from_files(files, held_out, config, seed), *_generated(config, seed)]
    for name, times in Counter(source.name for source in sources).most_common(1):
        if times > 1:
            named = ", ".join(str(path) for path in files if path.stem == name)
            raise ConfigError(
                f"data.folders: {times} scenes would be named {name}, of {named}; use a file once, "
                f"and rename others."
            )
    origins = [source.origin for source in sources if source.origin.sha256]
    learned = {one.sha256: one.name for one in origins if not one.is_validation}
    for one in origins:
        if one.is_validation and one.sha256 in learned:
            warn(
                f"{one.name}.ply is for validation, but {learned[one.sha256]}.ply of the same "
                f"content is for training."
            )
    kinds = (False, "training", "generated"), (True, "validation", "generated_validation")
    for is_validation, text, setting in kinds:
        if not any(source.is_validation == is_validation for source in sources):
            raise ConfigError(
                f"data: at least one {text} scene is needed, found none; add files, or set "
                f"data.{setting}."
            )
    return sources


def _files_in(folder: Path) -> list[Path]:
    if not is_folder(folder):
        raise ConfigError(f"data.folders (--scenes): {folder} is not a folder.")
    # Hidden are, for example, the blocks of an interrupted run.
    names = [path.relative_to(folder) for path in folder.rglob("*")]
    visible = [name for name in names if not any(part.startswith(".") for part in name.parts)]
    found = sorted(folder / name for name in visible)
    files = [path for path in found if path.suffix.lower() == ".ply"]
    if not files:
        raise ConfigError(f"data.folders (--scenes): {folder} holds no PLY file.")
    kinds = [suffix for suffix in READABLE_SUFFIXES if not suffix.endswith(".ply")]
    if others := [path.name for path in found if path.suffix.lower() in kinds]:
        warn(f"{folder}: training reads PLY files only, not {first_of(others)}.")
    return files


def _from_files(
    files: list[Path], held_out: set[str], config: DataConfig, seed: int
) -> Iterator[Source]:
    for path in files:
        count, name = len(load(path)), path.stem
        sha256, is_validation = _digest(path), name in held_out
        beside = path.with_suffix(".transforms.json")
        cameras = beside if is_validation and beside.is_file() else None
        whole = Source(
            name=name,
            identity=sha256,
            is_validation=is_validation,
            origin=LearnedScene(
                name=name,
                count=count,
                sha256=sha256,
                is_validation=is_validation,
                cameras_sha256="" if cameras is None else _digest(cameras),
            ),
            make=partial(_load_valid, path),
            cameras=cameras,
        )
        if is_validation:
            yield whole
            continue
        originals = [whole] if count <= config.largest_scene else []
        yield from originals
        for number in range(config.blocks if count > config.block_count else 0):
            key = f"block {config.block_count} {seed + number}"
            cut = partial(cut_block, count=config.block_count)
            block = _derived(whole, f"{name}-block{number}", key, cut, seed + number)
            originals.append(block)
            yield block
        if not originals:
            warn(
                f"{path}: not used for training, since {count:,} Gaussians are above "
                f"data.largest_scene, {config.largest_scene:,}, and no blocks are cut from it."
            )
        for original in originals:
            for number in range(config.copies):
                name = f"{original.name}-copy{number}"
                key = f"copy {seed} {number}"
                yield _derived(original, name, key, perturb, f"{seed}/{name}")


def _digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _load_valid(path: Path) -> GaussianScene:
    """Read the valid rows of a scene, in the precision of networks that are trained."""
    scene = valid_part(load(path))
    return scene.with_tensors({name: x.float() for name, x in scene.tensors().items()})


def _derived(
    source: Source,
    name: str,
    key: str,
    change: Callable[[GaussianScene, random.Random], GaussianScene],
    seed: int | str,
) -> Source:
    return replace(
        source,
        name=name,
        identity=f"{source.identity} {key}",
        make=lambda: change(source.make(), random.Random(seed)),
    )


def _generated(config: DataConfig, seed: int) -> Iterator[Source]:
    counts = config.generated_counts
    for is_validation, number, first in (
        (False, config.generated, 1000 * seed),
        (True, config.generated_validation, VALIDATION_SEED + 1000 * seed),
    ):
        for turn in range(number):
            for place, kind in enumerate(synthetic.KINDS):
                count, degree = counts[(turn + place) % len(counts)], (turn + place) % 3
                name = f"generated-{kind}-{first + turn}"
                yield Source(
                    name=name,
                    identity=f"{name} {count} {degree}",
                    is_validation=is_validation,
                    origin=LearnedScene(name=name, count=count, is_validation=is_validation),
                    make=partial(synthetic.scene, kind, count, sh_degree=degree, seed=first + turn),
                )


def cut_block(scene: GaussianScene, rng: random.Random, *, count: int) -> GaussianScene:
    """Cut a compact piece out of a scene: a random Gaussian and its nearest neighbours."""
    if len(scene) <= count:
        return scene
    middle = scene.means[rng.randrange(len(scene))]
    distances = torch.linalg.vector_norm(scene.means - middle, dim=1)
    return scene.select(distances.topk(count, largest=False).indices.sort().values)


def perturb(scene: GaussianScene, rng: random.Random) -> GaussianScene:
    """Thin, stretch, recolour and perhaps tag a scene; descriptors are invariant to motions."""
    generator = torch.Generator().manual_seed(rng.getrandbits(62))
    share = rng.uniform(0.4, 1.0)
    draws = torch.rand(len(scene), generator=generator, dtype=torch.float32)
    kept = scene.select(draws < share)
    kept = kept if len(kept) else scene
    stretch = torch.tensor([rng.uniform(0.6, 1.5) for _ in range(3)], dtype=scene.dtype)
    wider = share ** (-1 / 3)
    quats = parameters.normalize_quats(kept.quats.double())
    shapes = parameters.build_covariances(kept.scales.double() * wider, quats)
    scales, turned = parameters.decompose_covariances(shapes * stretch[:, None] * stretch)
    noise = torch.randn(3, 3, generator=generator, dtype=torch.float32)
    mix = (torch.eye(3) * rng.uniform(0.5, 1.4) + 0.3 * noise).to(scene.dtype)
    changed = kept.with_tensors(
        {
            "means": kept.means * stretch,
            "log_scales": parameters.positive_log(scales).to(scene.dtype),
            "quats": turned.to(scene.dtype),
            "logit_opacities": kept.logit_opacities + rng.triangular(-2.0, 4.0, 0.0),
            "sh0": kept.sh0 @ mix,
            "shN": kept.shN @ mix,
        },
        {},
    )
    return replace(changed, comments=(ANTIALIASED.text,) if rng.random() < TAGGED else ())


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TrainingScene:
    """The data of one scene."""

    name: str
    views: tuple[ViewImages, ...]  # one entry per size of images
    cases: tuple[Case, ...]  # the scene at several ratios


def prepare_scene(source: Source, config: TrainConfig, folder: Path) -> TrainingScene:
    """Return the data of a scene, memory-mapped, from the cache if possible.

    Images and cases are in separate files, so that trainings for other presets share images.
    """
    simplify = SimplifyConfig.from_preset(config.preset)
    ratios = config.data.validation_ratios if source.is_validation else config.data.ratios
    sizes = (config.views.validation_size,) if source.is_validation else config.views.sizes
    if config.kind == "published" and not source.is_validation:
        sizes = ()  # it trains on images of single cells
    count = config.views.validation_count if source.is_validation else config.views.count
    scene, file = cache(source.make), source.cameras
    seen_from = config.seed if file is None else _digest(file)
    views = _cached(
        folder / f"{source.name}-views-{_key(source, sizes, count, seen_from)}.safetensors",
        lambda: _packed_views(
            render_targets(scene(), count, size=size, seed=config.seed + number, file=file)
            for number, size in enumerate(sizes)
        ),
        _unpacked_views,
    )
    cases = _cached(
        folder / f"{source.name}-cases-{_key(source, ratios, simplify.model_dump())}.safetensors",
        lambda: _packed_cases(make_case(source.name, scene(), ratio, simplify) for ratio in ratios),
        partial(_unpacked_cases, source.name),
    )
    return TrainingScene(name=source.name, views=views, cases=cases)


def _key(source: Source, *parts: Any) -> str:
    text = json.dumps([cvtgs.__version__, CACHE_VERSION, source.identity, *parts], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _cached(
    path: Path,
    make: Callable[[], dict[str, Tensor]],
    unpack: Callable[[Mapping[str, Tensor]], tuple[Content, ...]],
) -> tuple[Content, ...]:
    """Read a cache file; write it first if it is missing or damaged."""
    if path.is_file():
        with suppress(ValueError, KeyError, TypeError):
            return unpack(map_tensors(path)[0])
        path.unlink()  # now that nothing maps it: Windows would refuse
    save_tensors(path, make(), {})
    return unpack(map_tensors(path)[0])


def _packed_views(all_views: Iterable[ViewImages]) -> dict[str, Tensor]:
    tensors: dict[str, Tensor] = {}
    for number, views in enumerate(all_views):
        own = {name: getattr(views.cameras, name) for name in ("viewmats", "Ks")}
        own["ignores_tag"] = torch.tensor(views.cameras.ignores_tag, dtype=torch.bool)
        tensors |= add_prefix(f"{number}/", own | {"rgb": views.rgb, "alpha": views.alpha})
    return tensors


def _unpacked_views(tensors: Mapping[str, Tensor]) -> tuple[ViewImages, ...]:
    found = []
    for entry in _entries(tensors):
        rgb = entry["rgb"]
        cameras = Cameras(
            viewmats=entry["viewmats"],
            Ks=entry["Ks"],
            width=rgb.shape[2],
            height=rgb.shape[1],
            ignores_tag=tuple(entry["ignores_tag"].tolist()),
        )
        found.append(ViewImages(cameras=cameras, rgb=rgb, alpha=entry["alpha"]))
    return tuple(found)


def _packed_cases(cases: Iterable[Case | None]) -> dict[str, Tensor]:
    tensors: dict[str, Tensor] = {}
    for number, case in enumerate(case for case in cases if case is not None):
        reference, prefix = case.reference, f"{number}/"
        if number == 0:
            tensors |= add_prefix("scene/", reference.scene.tensors())
            tensors["visibility"] = reference.visibility.to(torch.float32)
            tensors["radius"] = torch.tensor(reference.radius, dtype=torch.float64)
            if reference.scene.antialiased:
                tensors["antialiased"] = torch.ones(1)
        tensors |= add_prefix(prefix + "merged/", reference.merged.tensors())
        seen = {field.name: getattr(case.descriptors, field.name) for field in fields(Descriptors)}
        tensors |= add_prefix(prefix + "seen/", seen)
        tensors |= {
            prefix + "ratio": torch.tensor(case.ratio, dtype=torch.float64),
            prefix + "order": reference.partition.order,
            prefix + "offsets": reference.partition.offsets,
            prefix + "neighbors": reference.neighbors,
        }
    return tensors


def _unpacked_cases(name: str, tensors: Mapping[str, Tensor]) -> tuple[Case, ...]:
    entries = _entries(tensors)
    if not entries:
        return ()
    # Merged Gaussians must be rendered in the same way as their scene.
    comments = (ANTIALIASED.text,) if "antialiased" in tensors else ()
    scene = GaussianScene(**under_prefix("scene/", tensors), comments=comments)
    found = []
    for entry in entries:
        partition = Partition(order=entry["order"], offsets=entry["offsets"])
        reference = MergedScene(
            scene=scene,
            merged=GaussianScene(**under_prefix("merged/", entry), comments=comments),
            partition=partition,
            neighbors=entry["neighbors"],
            visibility=tensors["visibility"],
            radius=float(tensors["radius"]),
        )
        case = Case(
            scene_name=name,
            ratio=float(entry["ratio"]),
            reference=reference,
            cells=partition.several(),
            descriptors=Descriptors(**under_prefix("seen/", entry)),
        )
        found.append(case)
    return tuple(found)


def _entries(tensors: Mapping[str, Tensor]) -> list[dict[str, Tensor]]:
    """Return the tensors of the numbered entries."""
    count = len({name.split("/")[0] for name in tensors if name.split("/")[0].isdecimal()})
    return [under_prefix(f"{number}/", tensors) for number in range(count)]
