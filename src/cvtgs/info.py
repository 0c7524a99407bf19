"""SceneInfo: facts about a scene, without simplifying it."""

import torch
from jaxtyping import Float
from torch import Tensor

from cvtgs.analysis import EffectPlan, analyze
from cvtgs.analysis.effects import select_columns
from cvtgs.checks import checked
from cvtgs.config import SimplifyConfig
from cvtgs.config.base import Record
from cvtgs.devices import threads_for_chunks
from cvtgs.errors import InvalidSceneError
from cvtgs.math import parameters
from cvtgs.math.segments import running_sums
from cvtgs.scene import SceneLike, as_scene
from cvtgs.validity import any_row, invalid_rows

FAINT = 0.1  # opacities below this are counted as faint: the filter of CVT-GS would drop them
QUANTILES = (0.0, 0.05, 0.25, 0.5, 0.75, 0.95, 1.0)
HEAVIEST = (0.001, 0.01, 0.1, 0.5)


class SceneInfo(Record):
    """Facts about a scene; statistics of values are over its valid rows.

    Attributes:
        count: Number of Gaussians, N.
        sh_degree: Degree of the spherical harmonics.
        dtype: float32 or float64.
        bounds: Smallest and largest x, y, z of the centres, scene units.
        robust_center: Median of each coordinate.
        robust_radius: The 70 % quantile of the distance to ``robust_center``, like this over the
            Gaussians that renderers draw (an opacity of at least 1/255).
        opacity_quantiles: Opacities at 0, 5, 25, 50, 75, 95 and 100 %.
        mass: Sum of opacity times mean projected area, squared scene units.
        mass_shares: Share of the mass that the heaviest 0.1, 1, 10 and 50 % of Gaussians hold.
        faint_share: Share of Gaussians with opacity below 0.1.
        faint_mass_share: Share of the mass that these hold.
        invalid_rows: Number of rows with NaN, infinite or zero values, by attribute.
        invalid_count: Number of invalid rows.
        antialiased: Whether the scene is tagged as trained with anti-aliasing.
        comments: Comment lines of the file.
        extra_columns: Names of the columns beyond the standard ones.
        plan: The effects that the scene calls for.
    """

    count: int
    sh_degree: int
    dtype: str
    bounds: tuple[tuple[float, ...], tuple[float, ...]]
    robust_center: tuple[float, ...]
    robust_radius: float
    opacity_quantiles: tuple[float, ...]
    mass: float
    mass_shares: tuple[float, ...]
    faint_share: float
    faint_mass_share: float
    invalid_rows: dict[str, int]
    invalid_count: int
    antialiased: bool
    comments: tuple[str, ...]
    extra_columns: tuple[str, ...]
    plan: EffectPlan

    __hash__ = None  # type: ignore[assignment]  # compared by value, and has a dictionary


@torch.no_grad()
@threads_for_chunks()
@checked
def describe(scene: SceneLike, config: SimplifyConfig | None = None) -> SceneInfo:
    """Collect facts about a scene.

    Args:
        scene: Any scene, or a file or folder of one.
        config: Configuration to plan the effects for; None for the default one.

    Returns:
        The facts.

    Raises:
        InvalidSceneError: The scene has no valid row.
        InvalidArgumentError: The configuration is no SimplifyConfig.
        InputError, FileFormatError: A path cannot be read, as for :func:`cvtgs.load`.

    Example:
        >>> from cvtgs.synthetic import scene
        >>> describe(scene("object", 100, sh_degree=2, seed=0)).sh_degree
        2
    """
    scene = as_scene(scene)
    invalid = invalid_rows(scene)
    bad = any_row(scene, invalid)
    if len(scene) == int(bad.sum()):
        raise InvalidSceneError(f"none of the {len(scene):,} Gaussians is valid.")
    valid = scene.select(~bad) if invalid else scene
    config = config or SimplifyConfig()
    analysis = analyze(select_columns(valid, config.effects), config)
    frame, opacities = analysis.frame, analysis.opacities
    masses = analysis.areas * opacities
    faint = opacities < FAINT
    total = masses.sum()
    return SceneInfo(
        count=len(scene),
        sh_degree=scene.sh_degree,
        dtype=str(scene.dtype).removeprefix("torch."),
        bounds=(tuple(valid.means.amin(dim=0).tolist()), tuple(valid.means.amax(dim=0).tolist())),
        robust_center=tuple(frame.center.tolist()),
        robust_radius=frame.radius,
        opacity_quantiles=_quantiles(opacities),
        mass=float(total),
        mass_shares=_heaviest_shares(masses),
        faint_share=float(faint.double().mean()),
        faint_mass_share=float(parameters.divide(masses[faint].sum(), total)),
        invalid_rows={name: int(mask.sum()) for name, mask in invalid.items()},
        invalid_count=int(bad.sum()),
        antialiased=scene.antialiased,
        comments=scene.comments,
        extra_columns=tuple(scene.extras),
        plan=analysis.plan,
    )


def _quantiles(values: Float[Tensor, "n"]) -> tuple[float, ...]:
    ascending = torch.sort(values).values
    return tuple(float(ascending[round(q * (len(values) - 1))]) for q in QUANTILES)


def _heaviest_shares(masses: Float[Tensor, "n"]) -> tuple[float, ...]:
    running = running_sums(torch.sort(masses, descending=True).values)
    counts = (max(1, round(share * len(masses))) for share in HEAVIEST)
    return tuple(float(parameters.divide(running[count - 1], running[-1])) for count in counts)
