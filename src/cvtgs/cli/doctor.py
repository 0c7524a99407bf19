"""``cvtgs doctor``: which devices and backends work here, and how long a small run takes."""

import argparse
import time
from itertools import pairwise
from typing import TYPE_CHECKING, cast

from cvtgs.cli.versions import version_lines
from cvtgs.errors import CvtgsError, DeviceError

if TYPE_CHECKING:
    import torch

    from cvtgs.rendering import BackendName

COUNT, RHO = 20_000, 0.1
SIDE = 256
RENDERERS = ("torch", "numba", "gsplat")


def add_parser(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Describe the command."""
    parser = commands.add_parser(
        "doctor",
        help="say what works on this machine",
        description="Say which devices and backends work here, and time a small run on a "
        "generated scene. Ends with 0 if the default path works, else with 1.",
    )
    parser.add_argument(
        "--device", default="auto", metavar="DEVICE", help="check this one: auto, cpu or cuda"
    )
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> None:
    """Run the command."""
    from cvtgs.devices import chosen_device, device_name, resolve_device  # noqa: PLC0415

    print("\n".join(version_lines()))
    device = resolve_device(options.device)
    for one in _devices() if device is None else [device]:
        print(f"\n{one}: {device_name(one)}")
        for name in RENDERERS:
            print(f"  images by {name:<7} {_renderer(name, one)}")
        print(f"  nearest site by  {_search(one)}")
    default = chosen_device(options.device)
    print(f"\nA small run on {default}: {COUNT:,} generated Gaussians to {RHO:.0%}, one image")
    try:
        for line in _small_run(default):
            print(f"  {line}")
    except Exception as error:  # whatever a driver or a broken installation raises
        reason = str(error).partition("\n")[0] or type(error).__name__
        raise DeviceError(
            f"the default path does not work on {default}: {reason}; try cvtgs doctor --device cpu."
        ) from error
    print("The default path works.")


def _devices() -> "list[torch.device]":
    """Return the CPU, and the CUDA devices that torch sees."""
    import torch  # noqa: PLC0415

    count = torch.cuda.device_count() if torch.cuda.is_available() else 0
    return [torch.device("cpu"), *(torch.device("cuda", number) for number in range(count))]


def _renderer(name: str, device: "torch.device") -> str:
    """Report whether a renderer works on a device, and if not, why."""
    from cvtgs.rendering import choose_backend  # noqa: PLC0415

    try:
        choose_backend(cast("BackendName", name), device)
    except CvtgsError as error:
        return f"no: {error}"
    return "yes"


def _search(device: "torch.device") -> str:
    """Name what searches the nearest site on a device."""
    from cvtgs.cvt import nearest_backend  # noqa: PLC0415

    return nearest_backend("auto", device)[0]


def _small_run(device: "torch.device") -> list[str]:
    """Generate, simplify and render; say how long each took and what did it."""
    import torch  # noqa: PLC0415

    from cvtgs.rendering import render  # noqa: PLC0415
    from cvtgs.simplify import Simplifier  # noqa: PLC0415
    from cvtgs.synthetic import demo_scene  # noqa: PLC0415
    from cvtgs.views import automatic_views  # noqa: PLC0415

    times = [time.perf_counter()]
    scene = demo_scene(COUNT, sh_degree=1)
    times.append(time.perf_counter())
    small, report = Simplifier(device=device).run(scene, RHO)
    times.append(time.perf_counter())
    cameras = automatic_views(small, 1, width=SIDE, height=SIDE)
    times.append(time.perf_counter())
    with torch.no_grad():
        image = render(small.to(device), cameras)
    lit = float(image.rgb.mean())
    times.append(time.perf_counter())
    if len(small) != report.target_count or not 0.0 < lit < 1.0:
        raise DeviceError(f"{len(small):,} Gaussians and a mean colour of {lit:.3g} came out")
    made, simplified, found, shown = (after - before for before, after in pairwise(times))
    compiles = image.backend == "numba"
    note = "   the first images with numba compile for some ten seconds" if compiles else ""
    return [
        f"generate  {made:6.2f} s",
        f"simplify  {simplified:6.2f} s   search by {report.backend}, "
        f"checkpoint {report.checkpoint}",
        f"views     {found:6.2f} s{note}",
        f"render    {shown:6.2f} s   {SIDE} x {SIDE} pixels by {image.backend}",
    ]
