"""Where Gaussians lie in the space of the tessellation, and in which order."""

from torch import Tensor

from cvtgs import cvt
from cvtgs.config import SimplifyConfig
from cvtgs.math.frames import morton_order
from cvtgs.scene import GaussianScene
from cvtgs.stages.outlook import Outlook


def place_rows(
    scene: GaussianScene, rows: Tensor, outlook: Outlook, target: int, config: SimplifyConfig
) -> tuple[Tensor, Tensor]:
    """Place Gaussians in the space of the tessellation."""
    rows = rows_along_curve(scene, rows, outlook)
    return rows, places_of(scene, rows, outlook, target, config)


def rows_along_curve(scene: GaussianScene, rows: Tensor, outlook: Outlook) -> Tensor:
    """Order Gaussians along a Morton curve."""
    # A curve through contracted space stays fine where the bulk is, whatever flies away.
    curve = cvt.embed(scene.means[rows], frame=outlook.frame, contraction=1.0)
    return rows[morton_order(curve, ties=outlook.seen_areas[rows] * scene.opacities[rows])]


def places_of(
    scene: GaussianScene, rows: Tensor, outlook: Outlook, target: int, config: SimplifyConfig
) -> Tensor:
    """Place Gaussians in the space of the tessellation, in the order that is given."""
    return cvt.embed(
        scene.means[rows],
        scene.sh0[rows],
        frame=outlook.frame,
        contraction=outlook.plan.unbounded.strength,
        color=config.cvt.color * (target / COLOR_CELLS) ** config.cvt.color_power,
    )


COLOR_CELLS = 10_000
"""The number of cells that ``cvt.color`` is meant for."""
