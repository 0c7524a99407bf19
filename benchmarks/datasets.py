"""Find datasets of posed photographs, and models trained on them, below a folder.

A scene is a folder with its published name (``garden``) and cameras: ``sparse/0`` of COLMAP,
``transforms_test.json`` or ``transforms.json``. Its model is any other folder of that name, or a
folder within the scene's, with the files of a training code:

- INRIA: ``point_cloud/iteration_*/point_cloud.ply``
- nerfstudio: ``splat.ply`` or ``step-*.ckpt``, with ``dataparser_transforms.json`` beside or above
- gsplat: ``ply/point_cloud_*.ply`` or ``ckpts/ckpt_*_rank0.pt``

``benchmarks.worlds`` handles the transforms that each training applied to the camera coordinates.
"""

import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from jaxtyping import Float
from torch import Tensor

import cvtgs
from cvtgs.cameras import Cameras
from cvtgs.evaluation import fit_cameras, load_photographs
from cvtgs.evaluation.scorer import Color

WHITE, BLACK = (1.0, 1.0, 1.0), (0.0, 0.0, 0.0)
DEEPEST = 5
"""Depth to which folders below the given one are searched."""

DOWNSCALED = ("images_2", "images_4", "images_8", "images")
"""Folders of photographs to fall back to, in this order, if the published one is missing."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Dataset:
    """A published set of scenes.

    Attributes:
        name: Its name.
        scenes: The folder of the photographs of each scene, by the scene's name.
        background: Background colour of transparent pixels and of renderings.
        source: Where to download it.
    """

    name: str
    scenes: Mapping[str, str]
    background: Color = BLACK
    source: str


INRIA_DATA = "https://repo-sam.inria.fr/fungraph/3d-gaussian-splatting (tandt_db.zip)"
DATASETS = (
    Dataset(
        name="NeRF-Synthetic",
        scenes=dict.fromkeys(
            ("chair", "drums", "ficus", "hotdog", "lego", "materials", "mic", "ship"), "."
        ),
        background=WHITE,
        source="https://www.matthewtancik.com/nerf (nerf_synthetic.zip)",
    ),
    Dataset(
        name="Mip-NeRF 360",
        scenes=dict.fromkeys(("bicycle", "flowers", "garden", "stump", "treehill"), "images_4")
        | dict.fromkeys(("bonsai", "counter", "kitchen", "room"), "images_2"),
        source="https://jonbarron.info/mipnerf360",
    ),
    Dataset(
        name="Tanks and Temples",
        scenes=dict.fromkeys(("train", "truck"), "images"),
        source=INRIA_DATA,
    ),
    Dataset(
        name="Deep Blending",
        scenes=dict.fromkeys(("drjohnson", "playroom"), "images"),
        source=INRIA_DATA,
    ),
)
"""The datasets in the evaluation of CVT-GS, with the scenes and image sizes of 3DGS."""

LAYOUTS: Mapping[str, Sequence[re.Pattern[str]]] = {
    "INRIA": (re.compile(r"point_cloud/iteration_(\d+)/point_cloud\.ply"),),
    "gsplat": (
        re.compile(r"ply/point_cloud_(\d+)\.ply"),
        re.compile(r"ckpts/ckpt_(\d+)_rank0\.pt"),
    ),
    "nerfstudio": (re.compile(r"splat\.ply"), re.compile(r"(?:\w+/)?step-(\d+)\.ckpt")),
}
"""File name patterns of the models of each training code; the number is the step."""


class Model(NamedTuple):
    """A trained model: its file, and the code that wrote it."""

    path: Path
    layout: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Capture:
    """A scene of a dataset with its model.

    Attributes:
        dataset: The dataset.
        name: Name of the scene.
        folder: Folder of its cameras.
        model: Its trained model.
    """

    dataset: Dataset
    name: str
    folder: Path
    model: Model


class Found(NamedTuple):
    """The scenes below a folder, and a sentence on each missing or incomplete scene."""

    captures: tuple[Capture, ...]
    notes: tuple[str, ...]


class TestViews(NamedTuple):
    """The held-out cameras, their photographs, and the folder of the photographs."""

    cameras: Cameras
    photographs: Float[Tensor, "c h w 3"]
    folder: Path


def find_captures(root: Path) -> Found:
    """Find the scenes of the datasets below a folder, and the model of each."""
    if not root.is_dir():
        raise SystemExit(f"{root}: must be a folder of datasets, found none.")
    known = {name for dataset in DATASETS for name in dataset.scenes}
    folders: dict[str, list[Path]] = {name: [] for name in known}
    for folder in _folders(root):
        if folder.name.lower() in known:
            folders[folder.name.lower()].append(folder)
    captures, notes = [], []
    for dataset in DATASETS:
        there = {
            name: [path for path in folders[name] if _has_cameras(path)] for name in dataset.scenes
        }
        if not any(there.values()):
            notes.append(
                f"{dataset.name}: none of its scenes were found in {root}; get it from "
                f"{dataset.source}."
            )
            continue
        for name, places in there.items():
            model = _find_model([*places, *folders[name]]) if places else None
            if model is not None:
                captures.append(Capture(dataset=dataset, name=name, folder=places[0], model=model))
            elif places:
                notes.append(
                    f"{name}: {places[0]} has cameras, but no trained model of INRIA's code, "
                    f"nerfstudio or gsplat is in it or in another folder named {name}."
                )
            else:
                notes.append(f"{name}: this scene of {dataset.name} was not found in {root}.")
    return Found(tuple(captures), tuple(notes))


def read_test_views(capture: Capture) -> TestViews:
    """Read the held-out cameras of a scene and their photographs."""
    folder, dataset = capture.folder, capture.dataset
    images = _photograph_folder(folder, dataset.scenes[capture.name])
    cameras = cvtgs.load_cameras(sparse_folder(folder) or folder, split="test")
    cameras = fit_cameras(cameras, images)
    photographs = load_photographs(images, cameras, background=dataset.background)
    return TestViews(cameras, photographs, images)


def sparse_folder(folder: Path) -> Path | None:
    """Return the folder of a COLMAP model, which takes precedence over other cameras."""
    places = (folder / "sparse" / "0", folder / "sparse")
    return next((place for place in places if place.is_dir()), None)


def _folders(root: Path) -> Iterator[Path]:
    depth = len(root.parts)
    for name, inner, _ in os.walk(root, followlinks=True):
        folder = Path(name)
        yield folder
        if len(folder.parts) - depth >= DEEPEST:
            inner.clear()
        inner.sort()


def _has_cameras(folder: Path) -> bool:
    names = ("transforms_test.json", "transforms_train.json", "transforms.json", "sparse")
    return any((folder / name).exists() for name in names)


def _find_model(folders: Sequence[Path]) -> Model | None:
    """Return the model with the most steps, in the first folder and layout that has one."""
    for folder in dict.fromkeys(folders):
        files = sorted(
            path
            for part in _folders(folder)
            for path in part.iterdir()
            if path.suffix in (".ply", ".ckpt", ".pt") and path.is_file()
        )
        for layout, patterns in LAYOUTS.items():
            for pattern in patterns:
                matches = [(path, _match(pattern, path)) for path in files]
                steps = [
                    (int(match[1]) if match.re.groups else 0, path)
                    for path, match in matches
                    if match
                ]
                if steps:
                    return Model(max(steps)[1], layout)
    return None


def _match(pattern: re.Pattern[str], path: Path) -> re.Match[str] | None:
    """Match whole components at the end of a path."""
    parts = pattern.pattern.count("/") + 1
    for count in (parts, parts - 1):
        found = pattern.fullmatch("/".join(path.parts[-count:])) if count else None
        if found:
            return found
    return None


def _photograph_folder(folder: Path, published: str) -> Path:
    for name in (published, *DOWNSCALED):
        if (folder / name).is_dir():
            return folder / name
    return folder
