"""Measure the cost and savings of each effect, on scenes that need it and scenes that do not.

``python -m benchmarks.effects -o docs/effects.md`` updates the tables of that page. Every effect is
planned, forced on and forced off, each in fresh processes; the fastest run counts.
"""

import argparse
import json
import resource
import tempfile
import warnings
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import torch

import cvtgs
from benchmarks.measuring import around_tables, fastest, machine, renew_tables, run_python
from benchmarks.quality import score_views
from cvtgs import GaussianScene, Simplifier, SimplifyConfig
from cvtgs.analysis.effects import (
    BAND_LOSS,
    band_losses,
    duplicate_share,
    far_share,
    haze_share,
    mean_clamped,
)
from cvtgs.clock import peak_memory_bytes
from cvtgs.math.frames import robust_frame
from cvtgs.math.spherical_harmonics import SH_C0
from cvtgs.scene import FLAT_LOG_SCALE
from cvtgs.synthetic import scene as make
from cvtgs.tags import ANTIALIASED
from cvtgs.views import automatic_views

LOOK = {"visibility": {"views": 8}}
FAINT = {"filter": {"min_opacity": 0.1}}  # generated haze has opacities above the default


class Case(NamedTuple):
    """One effect: a scene that needs it, one that does not, and other settings."""

    calls: Callable[[int], GaussianScene]
    does_not: Callable[[int], GaussianScene]
    on: str = "on"
    off: str = "off"
    settings: Mapping[str, Any] = {}


def generated(kind: str, degree: int = 0) -> Callable[[int], GaussianScene]:
    return lambda count: make(kind, count, sh_degree=degree, seed=0)


def without_bands(count: int) -> GaussianScene:
    scene = make("courtyard", count, sh_degree=3, seed=0)
    return scene.with_tensors({"shN": torch.zeros_like(scene.shN)}, {})


def tagged(count: int) -> GaussianScene:
    return replace(make("thin", count, sh_degree=0), comments=(ANTIALIASED.text,))


def without_faint(count: int) -> GaussianScene:
    scene = make("room", count, sh_degree=0, seed=0)
    return scene.select(scene.opacities >= FAINT["filter"]["min_opacity"])


def surfels(count: int) -> GaussianScene:
    """Return a scene of Gaussians with two scales, which is saved without a third scale."""
    scene = make("object", count, sh_degree=0)
    log_scales = scene.log_scales.clone()
    log_scales[torch.arange(count), log_scales.argmin(dim=1)] = FLAT_LOG_SCALE
    order = torch.sort(log_scales, dim=1, descending=True)
    quats = cvtgs.math.parameters.matrices_to_quats(_right_handed(scene.quats, order.indices))
    names = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1"]
    names += [f"rot_{i}" for i in range(4)]
    layout = tuple((name, "float") for name in names)
    return replace(scene, log_scales=order.values, quats=quats, layout=layout)


def _right_handed(quats: torch.Tensor, order: torch.Tensor) -> torch.Tensor:
    """Reorder axes; the third is negated where the new order is left-handed."""
    matrices = cvtgs.math.parameters.quats_to_matrices(cvtgs.math.parameters.normalize_quats(quats))
    axes = matrices.gather(2, order[:, None, :].expand(-1, 3, -1))
    axes[:, :, 2] *= torch.linalg.det(axes)[:, None]
    return axes


def repeated(count: int) -> GaussianScene:
    return make("courtyard", count // 4, sh_degree=0).select(torch.arange(count // 4).repeat(4))


def darkened(count: int) -> GaussianScene:
    scene = make("courtyard", count, sh_degree=1)
    return scene.with_tensors(sh0=scene.sh0 - 0.4 / SH_C0)


def with_columns(count: int) -> GaussianScene:
    columns = {f"column_{i}": torch.rand(count) for i in range(8)}
    return make("courtyard", count, sh_degree=0).with_tensors({}, columns)


CASES: Mapping[str, Case] = {
    "sh": Case(generated("courtyard", 3), without_bands),
    "mip": Case(tagged, generated("thin"), settings=LOOK),
    "unbounded": Case(generated("landscape"), generated("object")),
    "haze": Case(generated("haze"), without_faint, settings=FAINT),
    "flat": Case(surfels, generated("object"), on="auto"),
    "duplicates": Case(repeated, generated("courtyard")),
    "clamping": Case(darkened, generated("courtyard", 1)),
    "extras": Case(with_columns, generated("courtyard"), on="auto"),
    "visibility": Case(generated("room"), generated("room"), on="auto", settings=LOOK),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-o", "--output", type=Path, help="page whose tables are updated")
    parser.add_argument("--effect", nargs="+", default=list(CASES), choices=list(CASES))
    parser.add_argument("--count", type=int, default=100_000)
    parser.add_argument("--rho", type=float, default=0.05)
    parser.add_argument("--runs", type=int, default=3, help="runs in each process")
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--child", nargs=4, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.child:
        name, path, choice, settings = options.child
        print(json.dumps(run_child(name, path, choice, settings, options)))
        return
    if options.output is not None:
        around_tables(options.output, script="benchmarks.effects")
    text = "\n".join([effect_table(options), figure_table(options.count)])
    if options.output is None:
        print(text)
    else:
        renew_tables(options.output, text, script="benchmarks.effects")


def effect_table(options: argparse.Namespace) -> str:
    lines = [
        f"{machine()}, torch {torch.__version__}; {options.count:,} Gaussians to {options.rho:g}; "
        "user seconds with reading, the least of "
        f"{options.processes} processes with {options.runs} runs each; "
        "dB against the full scene in four automatic views.\n",
        "| effect | scene calls for it | planned | s: planned, on, off | MB: planned, on, off "
        "| dB: planned, on, off | largest change by forcing on |",
        "|---|---|---|---|---|---|---|",
    ]
    with tempfile.TemporaryDirectory() as folder:
        for name in options.effect:
            case = CASES[name]
            for calls, scene in ((True, case.calls), (False, case.does_not)):
                path = Path(folder) / f"{name}_{calls}.ply"
                cvtgs.save(scene(options.count), path)
                settings = case.settings if calls or name != "visibility" else {}
                lines.append(row(name, path, options, settings=settings))
                print(lines[-1], flush=True)
    return "\n".join(lines) + "\n"


def row(name: str, path: Path, options: argparse.Namespace, *, settings: Mapping[str, Any]) -> str:
    choices = ("auto", CASES[name].on, CASES[name].off)
    found: dict[str, dict[str, Any]] = {}
    for _ in range(options.processes):  # interleaved, so that a busy minute affects all choices
        for choice in dict.fromkeys(choices):
            words = ["--child", name, str(path), choice, json.dumps(dict(settings))]
            words += ["--rho", str(options.rho), "--runs", str(options.runs)]
            new = json.loads(run_python("-m", "benchmarks.effects", *words).output)
            old = found.setdefault(choice, new)
            old["seconds"] = min(old["seconds"], new["seconds"])
            old["peak"] = min(old["peak"], new["peak"])
    full = cvtgs.load(path)
    small = {choice: cvtgs.load(path.with_suffix(f".{choice}.ply")) for choice in found}
    scores = score_views(full, small, automatic_views(full, 4, width=400, height=300))
    change = max(
        float((tensor - small[choices[1]].tensors()[key]).abs().amax()) if tensor.numel() else 0.0
        for key, tensor in small["auto"].tensors().items()
    )
    return " | ".join(
        [
            f"| {name}",
            "yes" if "True" in path.stem else "no",
            "on" if found["auto"]["active"] else "off",
            " ".join(f"{found[choice]['seconds']:.2f}" for choice in choices),
            " ".join(f"{found[choice]['peak'] / 1e6:.0f}" for choice in choices),
            " ".join(f"{scores[choice].psnr:.2f}" for choice in choices),
            f"{change:.1g} |",
        ]
    )


def run_child(
    name: str, path: str, choice: str, settings: str, options: argparse.Namespace
) -> dict[str, Any]:
    """Read and simplify repeatedly in this process, and write the last result."""
    values = {**json.loads(settings), "effects": {name: choice}}
    config = SimplifyConfig.from_mapping(values)
    choices = config.effects
    degree = choices.sh if isinstance(choices.sh, int) else None
    simplifier, seconds = Simplifier(config=config, device="cpu"), []
    for _ in range(options.runs):
        start = resource.getrusage(resource.RUSAGE_SELF).ru_utime
        scene = cvtgs.load(path, sh_degree=degree, extras=choices.extras != "off")
        small, report = simplifier.run(scene, options.rho)
        seconds.append(resource.getrusage(resource.RUSAGE_SELF).ru_utime - start)
    peak = peak_memory_bytes()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about a third scale that the file cannot hold
        cvtgs.save(small, Path(path).with_suffix(f".{choice}.ply"), overwrite=True)
    active = getattr(report.plan, name).active
    return {"seconds": min(seconds), "peak": peak, "active": active}


def figure_table(count: int) -> str:
    """Return a table of the cost of each decision, against a simplification of the same scene."""
    scene = without_bands(count)
    frame, masses, opacities = robust_frame(scene.means), scene.masses, scene.opacities
    parts: Mapping[str, Callable[[], object]] = {
        "sh": lambda: band_losses(scene, enough=BAND_LOSS),
        "unbounded": lambda: far_share(frame.distances(scene.means), masses),
        "haze": lambda: haze_share(opacities, masses, SimplifyConfig()),
        "duplicates": lambda: duplicate_share(scene.means, scene.sh0),
        "clamping": lambda: mean_clamped(scene, masses),
    }
    simplifier = Simplifier(device="cpu")
    whole = fastest(lambda: simplifier.simplify(scene, 0.05), runs=3)
    lines = ["| deciding on | ms | share of a run |", "|---|---|---|"]
    for name, part in parts.items():
        seconds = fastest(part, runs=9)
        lines.append(f"| {name} | {1e3 * seconds:.1f} | {seconds / whole:.2%} |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
