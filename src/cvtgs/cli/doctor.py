"""``cvtgs doctor`` and ``cvtgs --version``: versions, devices, backends and a small timed run."""

import argparse
import platform
from importlib import metadata
from typing import TYPE_CHECKING, Any, NoReturn, cast

import cvtgs
from cvtgs.cli.display import say
from cvtgs.cli.options import AddParser, add_options
from cvtgs.errors import CvtgsError, DeviceError
from cvtgs.progress import silent

if TYPE_CHECKING:
    import torch

    from cvtgs.rendering import BackendName

BACKENDS = ("torch", "numpy", "scipy", "numba", "gsplat")  # packages; the last two are optional
RENDERERS = ("torch", "numba", "gsplat")
SEARCHES = {"scipy": "a k-d tree on the host", "tiles": "dense distances on the device"}

WITHOUT_OPENMP = (
    "numba finds no OpenMP, so it renders one image at a time. With the system's package "
    "(libgomp1 on Debian and Ubuntu), presets that render are faster."
)

COUNT, RHO, SIDE = 20_000, 0.1, 256  # the small run: Gaussians, ratio, side of the image (pixels)


class ShowVersions(argparse.Action):
    """Print the versions and exit, without loading any of the packages."""

    def __call__(self, parser: argparse.ArgumentParser, *_: Any, **__: Any) -> NoReturn:
        """Print the versions and exit."""
        say("\n".join(version_lines()))
        parser.exit()


def version_lines() -> list[str]:
    """Return one line each for cvtgs, Python and every package in ``BACKENDS``."""
    lines = [f"cvtgs {cvtgs.__version__}", f"Python {platform.python_version()}"]
    return lines + [f"{name} {version_of(name)}" for name in BACKENDS]


def version_of(package: str) -> str:
    """Return the version of a package."""
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return "not installed"


def add_doctor(add_parser: AddParser) -> None:
    """Add the command and its options."""
    parser = add_parser(
        "doctor",
        help="check what works on this machine",
        description="Show which devices and backends work on this machine, and time a small run "
        "on a generated scene. The exit status is 0 if this run works, else 1.",
    )
    parser.set_defaults(run=doctor)
    add_options(parser, "--device", device="device to check: auto (default: all), cpu or cuda")


def doctor(options: argparse.Namespace) -> None:
    """Run ``cvtgs doctor``."""
    import torch

    from cvtgs.cvt.nearest import search_name
    from cvtgs.devices import chosen_device, device_name

    say("\n".join(version_lines()))
    default = chosen_device(options.device)
    gpus = torch.cuda.device_count() if torch.cuda.is_available() else 0
    devices = [torch.device("cpu"), *(torch.device("cuda", number) for number in range(gpus))]
    for one in devices if options.device == "auto" else [default]:
        say(f"\n{one}: {device_name(one)}")
        taken = cvtgs.rendering.choose_backend("auto", one)[0]
        for name in RENDERERS:
            use = " (used: the fastest that works here)" if name == taken else ""
            say(f"  images by {name:<7} {_renderer_state(name, one)}{use}")
        search = search_name(one)
        say(f"  nearest sites by {search} ({SEARCHES[search]})")
    if options.device == "auto" and not gpus:
        reason = f"torch {torch.__version__} is built for CPUs only"
        if built_for := torch.version.cuda or torch.version.hip:
            reason = (
                f"torch {torch.__version__} finds no GPU, or no driver for {built_for} or later"
            )
        say(f"\ncuda: not available: {reason}")
    say(f"\nA small run on {default}: {COUNT:,} generated Gaussians to {RHO:.0%}, one image")
    try:
        for line in _small_run(default):
            say(f"  {line}")
    except Exception as error:  # drivers and broken installations raise anything
        reason = str(error).partition("\n")[0] or type(error).__name__
        raise DeviceError(
            f"the default path does not work on {default}: {reason}; try cvtgs doctor --device cpu."
        ) from error
    say("The default path works.")
    if cvtgs.rendering.choose_backend("auto", default)[0] == "numba":
        from cvtgs.rendering.compiled import takes_several_loops

        if not takes_several_loops():
            say(WITHOUT_OPENMP)


def _renderer_state(name: str, device: "torch.device") -> str:
    """Return whether a renderer works on a device, and if not, why."""
    if name == "gsplat" and device.type != "cuda":
        return "no: needs CUDA"
    try:
        cvtgs.rendering.choose_backend(cast("BackendName", name), device)
    except CvtgsError as error:
        return f"no: {error}"
    return "yes"


def _small_run(device: "torch.device") -> list[str]:
    """Generate, simplify and render a scene; return a line with the time of each step."""
    import torch

    from cvtgs.clock import StageClock

    clock = StageClock(silent, device)
    with clock.stage("generate"):
        scene = cvtgs.synthetic.demo_scene(COUNT, sh_degree=1)
    with clock.stage("simplify"):
        small, report = cvtgs.Simplifier(device=device).run(scene, RHO)
    with clock.stage("views"):
        cameras = cvtgs.views.automatic_views(small, 1, width=SIDE, height=SIDE)
    with clock.stage("render"), torch.no_grad():
        image = cvtgs.render(small.to(device), cameras)
        color = float(image.rgb.mean())
    if len(small) != report.target_count or not 0.0 < color < 1.0:
        raise DeviceError(
            f"the result has {len(small):,} Gaussians and a mean colour of {color:.3g}"
        )
    compiles = image.backend == "numba"
    notes = (
        "",
        f"   search by {report.backend}, checkpoint {report.checkpoint}",
        "   numba compiles for about ten seconds at its first use" if compiles else "",
        f"   {SIDE} x {SIDE} pixels by {image.backend}",
    )
    costs = zip(clock.costs, notes, strict=True)
    return [f"{cost.stage:<9} {cost.seconds:6.2f} s{note}" for cost, note in costs]
