"""The public entry: a simplified scene in, one that looks more like the full scene out."""

from typing import NamedTuple

import torch

from cvtgs.cameras import Cameras
from cvtgs.config import RefineConfig
from cvtgs.devices import chosen_device
from cvtgs.errors import InvalidSceneError
from cvtgs.progress import ProgressEvent, ProgressListener, silent
from cvtgs.refinement.budget import Budget, check_budget
from cvtgs.refinement.freedom import freedom
from cvtgs.refinement.images import ImageBuffer, take_image
from cvtgs.refinement.looking import Outlook, given_outlook, own_outlook
from cvtgs.refinement.optimize import Descent, descend
from cvtgs.refinement.variables import changed_count
from cvtgs.rendering.backends import choose_backend
from cvtgs.report import RefineReport, SimplifyReport, StageClock
from cvtgs.scene import GaussianScene
from cvtgs.validity import valid_rows

STAGE = "refine"

DEFAULT_STEPS = 500
"""Steps if neither a time nor a number of steps is asked for."""


class Refined(NamedTuple):
    """A refined scene, and how it came about.

    Attributes:
        scene: The scene.
        report: What was gained, and what it cost.
    """

    scene: GaussianScene
    report: RefineReport


def refine(  # noqa: PLR0913 (all but the scenes are options by name)
    small: GaussianScene,
    full: GaussianScene,
    *,
    seconds: float | None = None,
    steps: int | None = None,
    cameras: Cameras | None = None,
    config: RefineConfig | None = None,
    seed: int = 0,
    device: str | torch.device = "auto",
    frozen: int = 0,
    listener: ProgressListener = silent,
) -> Refined:
    """Fine-tune a simplified scene until images of it look more like those of the full one.

    One image of the full scene per step, over a random background; Adam moves the Gaussians
    that the image shows. Views that are held out decide: the best scene by their PSNR is
    returned, which is the one that came in if none is better. Number of Gaussians, SH degree,
    comments, layout and extra columns stay. Gaussians that no image shows stay bit for bit, as do
    those that stand for themselves alone.

    The same scenes, steps, configuration and seed give the same bits on a CPU; with ``seconds``
    the clock decides how many steps there are. The time includes everything, also the compilation
    of numba's code, some ten seconds, when it is used for the first time on a machine.

    Memory: ten times the small scene, what rendering the full scene takes, and the images that
    are looked at again, at most ``8 * size ** 2 * images`` bytes: those of given cameras.

    Args:
        small: The simplified scene; it is not changed.
        full: The scene that it was made from.
        seconds: Wall-clock seconds to refine for, at most.
        steps: Steps, at most; without either, those of the configuration, else 500.
        cameras: From where to look, at least 2; every eighth is held out. None looks at the scene
            from new automatic views and from anywhere around.
        config: Everything else; None for the defaults.
        seed: Which views, in which order.
        device: Where to compute: ``auto`` stays where the small scene is, but takes CUDA for
            scenes on the CPU if there is one. The result is where the small scene was.
        frozen: So many of the first Gaussians stay as they are, bit for bit.
        listener: Told about every step, with the gain so far as its note.

    Returns:
        The scene and the report.

    Raises:
        InvalidArgumentError: Seconds or steps are not positive, or there is only one camera.
        InvalidSceneError: A scene has no valid row.
        DeviceError: There is no such device.

    Example:
        >>> from cvtgs.synthetic import scene as make
        >>> scene = make("object", 1000, sh_degree=0, seed=0)
        >>> result = refine(scene, scene, steps=2, config=RefineConfig(size=32, heldout=2))
        >>> result.report.stopped, result.report.gain
        ('perfect', 0.0)
    """
    config = config or RefineConfig()
    if seconds is None and steps is None:
        seconds, steps = config.seconds or None, config.steps or None
    check_budget(seconds, steps=steps)
    place = chosen_device(device, small.device)
    ours, theirs = _prepared(small, full, place)
    limit = DEFAULT_STEPS if seconds is None and steps is None else steps
    budget, clock = Budget(seconds, steps=limit), StageClock(listener, place)

    def tell(gain: float) -> None:
        note = f"{gain:+.2f} dB"
        listener(ProgressEvent(stage=STAGE, done=budget.done, total=budget.total, note=note))

    with clock.stage(STAGE, budget.total):
        outlook = _outlook(theirs, cameras, config=config, seed=seed)
        heldout = tuple(take_image(theirs, camera) for camera in outlook.heldout)
        album = ImageBuffer(theirs, outlook, config=config, seed=seed)
        free = freedom(ours, theirs)
        free[:frozen] = 0.0
        descent = descend(
            ours, album, heldout, budget=budget, config=config, freedom=free, tell=tell
        )
    report = RefineReport(
        steps=budget.steps,
        images=album.taken,
        heldout=len(heldout),
        **_gain(descent),
        changed_count=changed_count(ours, descent.scene),
        stopped=descent.stopped,
        backend=choose_backend("auto", place)[0],
        device=str(place),
        cost=clock.costs[0],
    )
    return Refined(small if descent.scene is ours else descent.scene.to(small.device), report)


def join_reports(report: SimplifyReport, refined: Refined) -> SimplifyReport:
    """Return in the report of a simplification what was refined afterwards.

    Args:
        report: What the simplification did.
        refined: What came of it.

    Returns:
        The report with the stage ``refine``, the gain, and the mass of the refined scene.
    """
    return report.model_copy(
        update={
            "stages": (*report.stages, refined.report.cost),
            "refinement": refined.report,
            "mass_out": float(refined.scene.masses.sum()),
        }
    )


def _prepared(
    small: GaussianScene, full: GaussianScene, device: torch.device
) -> tuple[GaussianScene, GaussianScene]:
    """Bring both scenes to one device and dtype, and leave out what of the full one is invalid."""
    for name, scene in (("simplified", small), ("full", full)):
        if not bool(valid_rows(scene).any()):
            raise InvalidSceneError(
                f"a refinement needs valid Gaussians in both scenes; none of the {len(scene)} of "
                f"the {name} scene is valid."
            )
    valid = valid_rows(full)
    whole = full if bool(valid.all()) else full.select(valid)
    tensors = {name: tensor.to(device, small.dtype) for name, tensor in whole.tensors().items()}
    return small.to(device), whole.with_tensors(tensors, {})


def _outlook(
    full: GaussianScene, cameras: Cameras | None, *, config: RefineConfig, seed: int
) -> Outlook:
    if cameras is None:
        return own_outlook(full, config=config, seed=seed)
    return given_outlook(cameras, config=config, seed=seed)


def _gain(descent: Descent) -> dict[str, float]:
    before, after = descent.before, descent.after
    return {"psnr_before": before, "psnr_after": after, "gain": after - before}
