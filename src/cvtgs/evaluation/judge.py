"""One pair of images in, the value of every metric out."""

from dataclasses import dataclass, field
from typing import Literal

from jaxtyping import Float
from torch import Tensor

from cvtgs.errors import CvtgsError, InvalidArgumentError
from cvtgs.evaluation.lpips_distance import lpips
from cvtgs.evaluation.lpips_network import NETWORKS, LpipsNetwork
from cvtgs.evaluation.lpips_weights import LpipsWeights, load_lpips
from cvtgs.evaluation.metrics import psnr, ssim
from cvtgs.evaluation.scores import NOT_ASKED_FOR, SceneScores, Score

LpipsChoice = Literal["auto", "vgg", "alex", "off"]
"""``auto``: VGG where its weights are, else Alex, else none."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Judge:
    """The metrics of one evaluation; weights are read once.

    Attributes:
        weights: Those of LPIPS, None to leave it out.
        note: Why LPIPS is left out.
    """

    weights: LpipsWeights | None
    note: str = ""

    def compare(self, image: Float[Tensor, "h w 3"], truth: Float[Tensor, "h w 3"]) -> list[float]:
        """Give PSNR, SSIM and, with weights, LPIPS."""
        one, other = image[None], truth.to(image)[None]
        values = [float(psnr(one, other)), float(ssim(one, other))]
        if self.weights is not None:
            network = self.weights.network
            values.append(float(lpips(one, other, network=network, weights=self.weights)))
        return values


@dataclass(slots=True, kw_only=True)
class Tally:
    """Collects the values of one scene, view by view.

    Attributes:
        name: Name of the scene.
        count: Its Gaussians.
        rows: One list of values per view.
    """

    name: str
    count: int
    rows: list[list[float]] = field(default_factory=list)

    def scores(self) -> SceneScores:
        """Return what was collected."""
        columns = [Score.of(column) for column in zip(*self.rows, strict=True)]
        distance = columns[2] if len(columns) > 2 else None
        return SceneScores(
            name=self.name, count=self.count, psnr=columns[0], ssim=columns[1], lpips=distance
        )


def make_judge(choice: LpipsChoice, size: tuple[int, int]) -> Judge:
    """Read what the metrics need."""
    if choice == "off":
        return Judge(weights=None, note=NOT_ASKED_FOR)
    if choice in ("vgg", "alex"):
        return Judge(weights=load_lpips(choice))
    if choice != "auto":
        raise InvalidArgumentError(f"lpips must be auto, vgg, alex or off, found {choice!r}.")
    note = ""
    names: tuple[LpipsNetwork, ...] = ("vgg", "alex")
    for network in names:
        if min(size) < NETWORKS[network].least:
            note = f"images of {size[0]} x {size[1]} pixels are too small for it"
            continue
        try:
            return Judge(weights=load_lpips(network))
        except CvtgsError as error:
            note = str(error).rstrip(".")
    return Judge(weights=None, note=note)
