"""Digests of the results of every way of simplifying: refactoring must not change a bit.

``python tests/digests.py`` compares with ``digests.json``; with ``--record`` it writes that file,
and with ``--print`` and names it prints digests and figures of these cases.
"""

import hashlib
import json
import platform
import sys
import tempfile
import warnings
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

import torch

import cvtgs
from cvtgs import synthetic
from cvtgs.boxes import Box
from cvtgs.config import SimplifyConfig
from cvtgs.outofcore import simplify_file
from cvtgs.tags import ANTIALIASED

FILE = Path(__file__).with_name("digests.json")
KINDS = {"object": 3, "room": 1, "landscape": 2, "haze": 3, "thin": 0, "courtyard": 2}
FAST = ("draft", "fast", "standard", "paper")
REFINED = {"refine": {"steps": 4, "size": 64, "heldout": 2, "batch": 4, "check_every": 2}}


def make(kind: str, count: int = 2500) -> cvtgs.GaussianScene:
    return synthetic.scene(kind, count, sh_degree=KINDS[kind], seed=5)


def simplified(kind: str, config: SimplifyConfig, rho: float, **options) -> Iterator:
    yield cvtgs.Simplifier(config=config, device="cpu").simplify(make(kind), rho, **options)


def preset(kind: str, name: str, rho: float) -> Iterator:
    yield from simplified(kind, SimplifyConfig.from_preset(name), rho)


def refined(kind: str, name: str) -> Iterator:
    values = REFINED | {"preset": name, "visibility": {"views": 4, "size": 64}}
    yield from simplified(kind, SimplifyConfig.from_mapping(values), 0.05)


def protected(kind: str) -> Iterator:
    mask = torch.arange(2500) % 50 == 3
    yield from simplified(kind, SimplifyConfig(), 0.1, keep=mask)


def levels(kind: str) -> Iterator:
    sizes = cvtgs.Simplifier(device="cpu").levels(make(kind), [0.2, 0.1, 0.02, 0.001])
    yield from (size.scene for size in sizes)


def large(rho: float) -> Iterator:
    scene = make("courtyard", 140_000)
    yield scene
    yield cvtgs.Simplifier(device="cpu").simplify(scene, rho)


def in_blocks(kind: str, blocks: int, *, boxes: tuple[Box, ...] = ()) -> Iterator:
    with tempfile.TemporaryDirectory() as folder:
        source, target = Path(folder) / "scene.ply", Path(folder) / "small.ply"
        cvtgs.save(make(kind, 6000), source)
        simplify_file(source, target, 0.05, blocks=blocks, boxes=boxes)
        yield cvtgs.load(target)


def damaged() -> Iterator:
    scene = make("room")
    means, logits = scene.means.clone(), scene.logit_opacities.clone()
    means[::300], logits[::400] = torch.nan, torch.inf
    tensors = {"means": means, "logit_opacities": logits}
    extras = {
        "label": torch.arange(2500, dtype=torch.int32),
        "score": torch.rand(2500, generator=torch.Generator().manual_seed(1)),
    }
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield cvtgs.Simplifier(device="cpu").simplify(scene.with_tensors(tensors, extras), 0.1)


def tagged() -> Iterator:
    scene = replace(make("object"), comments=(ANTIALIASED.text,))
    yield cvtgs.Simplifier(device="cpu").simplify(scene, 0.1)


def in_double() -> Iterator:
    scene = make("landscape")
    double = {name: values.double() for name, values in scene.tensors().items()}
    yield cvtgs.Simplifier(device="cpu").simplify(scene.with_tensors(double, {}), 0.05)


def darkened() -> Iterator[cvtgs.GaussianScene]:
    scene = cvtgs.synthetic.scene("object", 20_000, sh_degree=1, seed=0)
    dark = scene.with_tensors(sh0=scene.sh0 - 0.9)
    for preset in FAST:
        yield cvtgs.Simplifier(config=preset, device="cpu").simplify(dark, 0.05)


CASES = {
    **{f"scene {kind}": partial(lambda kind: iter([make(kind)]), kind) for kind in KINDS},
    **{
        f"{kind} {name} {rho}": partial(preset, kind, name, rho)
        for kind in KINDS
        for name in FAST
        for rho in (0.1, 0.01)
    },
    **{
        f"{kind} {name}": partial(refined, kind, name)
        for kind in ("object", "landscape")
        for name in ("matched", "high")
    },
    **{f"{kind} protected": partial(protected, kind) for kind in KINDS},
    **{f"{kind} levels": partial(levels, kind) for kind in KINDS},
    **{f"large {rho}": partial(large, rho) for rho in (0.4, 0.1, 0.003)},
    **{f"{kind} in 1 block": partial(in_blocks, kind, 1) for kind in ("object", "landscape")},
    **{f"{kind} in 4 blocks": partial(in_blocks, kind, 4) for kind in KINDS},
    "room in 5 blocks, boxes": partial(
        in_blocks, "room", 5, boxes=(Box(min=(0, -1, 0), max=(0.4, 1, 0.4)),)
    ),
    "damaged rows": damaged,
    "tagged mip": tagged,
    "float64": in_double,
    "colours below zero": darkened,
}


def digest(tensors: Iterator[torch.Tensor]) -> str:
    found = hashlib.sha256()
    for tensor in tensors:
        found.update(str((tensor.dtype, tuple(tensor.shape))).encode())
        found.update(tensor.contiguous().numpy().tobytes())
    return found.hexdigest()[:16]


def columns(scene: cvtgs.GaussianScene) -> list[torch.Tensor]:
    return [*scene.tensors().values(), *scene.extras.values()]


def measure(name: str) -> dict[str, object]:
    """Return the digest and rough figures of the result of a case."""
    scenes = list(CASES[name]())
    return {
        "digest": digest(tensor for scene in scenes for tensor in columns(scene)),
        "counts": [len(scene) for scene in scenes],
        "figures": [
            float(f"{float(tensor.double().nan_to_num(0, 0, 0).abs().sum()):.6g}")
            for scene in scenes
            for tensor in columns(scene)
        ],
    }


def canary() -> str:
    """Return a digest of the processor and of operations that libraries may round differently.

    Libraries choose code by processor, and no few operations find all differences.
    """
    generator = torch.Generator().manual_seed(0)
    x = torch.randn(64, 3, 3, generator=generator)
    y = torch.randn(5000, generator=generator)
    return digest(
        iter(
            [
                torch.linalg.eigh((x @ x.mT).double()).eigenvalues,
                torch.exp(y),
                torch.log(y.abs()),
                torch.sigmoid(y),
                torch.sin(y),
                y.cumsum(0),
                torch.nn.functional.linear(y.reshape(50, 100), y[:3200].reshape(32, 100)),
                (y.abs() ** 0.37),
                (y.abs().double() ** 1.6),
                torch.tensor(list(processor().encode())),
            ]
        )
    )


def rounds_like(recorded: dict) -> bool:
    """Return whether torch and the processor round like those of a recorded table."""
    version = torch.__version__.partition("+")[0]
    return version == recorded["torch"].partition("+")[0] and canary() == recorded["canary"]


def processor() -> str:
    """Return the kind of processor, in more detail than its name, where the system tells."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").split("\n\n")[0].splitlines()
    except OSError:
        return platform.processor()
    kinds = ("vendor_id", "cpu family", "model", "flags")
    return "\n".join(line for line in lines if line.split("\t")[0].rstrip() in kinds)


def main() -> None:
    torch.set_num_threads(1)
    if "--record" in sys.argv:
        recorded = {"canary": canary(), "torch": torch.__version__, "cases": {}}
        for name in CASES:
            recorded["cases"][name] = measure(name)
        FILE.write_text(json.dumps(recorded, indent=1) + "\n", encoding="utf-8")
        return
    if "--print" in sys.argv:
        print(json.dumps({name: measure(name) for name in sys.argv[2:]}))
        return
    recorded = json.loads(FILE.read_text(encoding="utf-8"))
    words = [word for word in sys.argv[1:] if not word.startswith("-")]
    names = [name for name in CASES if all(word in name for word in words)]
    print("same processor and libraries" if rounds_like(recorded) else "other machine")
    failed = [
        name for name in names if measure(name)["digest"] != recorded["cases"][name]["digest"]
    ]
    print(f"{len(names) - len(failed)} of {len(names)} are the same bits", *failed, sep="\n  ")
    sys.exit(bool(failed))


if __name__ == "__main__":
    main()
