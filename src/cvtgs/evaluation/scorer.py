"""Score images of scenes, and average the scores."""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple, Self, get_args

import torch
from jaxtyping import Float
from torch import Tensor

from cvtgs.cameras import Cameras, join_cameras
from cvtgs.config.base import Record
from cvtgs.counts import finite_numbers
from cvtgs.errors import CvtgsError, InvalidArgumentError
from cvtgs.evaluation.lpips import LEAST_PIXELS, LpipsNetwork, LpipsWeights, load_lpips, lpips
from cvtgs.evaluation.metrics import alpha_bias, alpha_error, pair_psnr, ssim
from cvtgs.rendering import BackendName, render
from cvtgs.scene import GaussianScene
from cvtgs.text import shown

NOT_ASKED_FOR = "not asked for"  # note for LPIPS that was not requested, which needs no explanation

LpipsChoice = Literal["auto", "vgg", "alex", "off"]
"""``auto``: VGG if its weights are available, else Alex, else none."""

Color = tuple[float, float, float]

BLACK, WHITE = (0.0, 0.0, 0.0), (1.0, 1.0, 1.0)

MOST_PSNR = 60.0  # upper limit of PSNR where scores are compared, dB: closer images count as equal
PIXELS_TOGETHER = 1 << 21  # of images that are rendered at once to be scored


class Score(Record):
    """One metric.

    Attributes:
        mean: Mean over the views; against a full scene, over those that show something of it.
        views: The value of each view.
    """

    mean: float
    views: tuple[float, ...]

    @classmethod
    def of(cls, values: Sequence[float]) -> Self:
        """Make a score from the values of the views; InvalidArgumentError if there is none.

        Example:
            >>> Score.of([20.0, 30.0]).mean
            25.0
        """
        if len(values) == 0:
            raise InvalidArgumentError("a score needs the value of at least one view, found none.")
        return cls(mean=math.fsum(values) / len(values), views=tuple(values))


class SceneScores(Record):
    """Mean and per-view scores of the images of one scene.

    Attributes:
        name: Name of the scene.
        count: Number of its Gaussians.
        psnr: Peak signal-to-noise ratio, dB; infinite where images are equal.
        ssim: Structural similarity, at most 1.
        lpips: LPIPS distance, at least 0; None if it was not measured.
        alpha_error: Mean absolute difference of accumulated alpha, 0 to 1; None against
            photographs, which have none.
        alpha_bias: Mean of the accumulated alpha minus that of the full scene, -1 to 1; negative
            if more of the background shows through. None against photographs.
    """

    name: str
    count: int
    psnr: Score
    ssim: Score
    lpips: Score | None = None
    alpha_error: Score | None = None
    alpha_bias: Score | None = None

    def means(self) -> dict[str, Any]:
        """Return the mean over the views of every score by name; None if it was not measured."""
        scores = {name: value for name, value in self if name not in ("name", "count")}
        return {name: None if score is None else score.mean for name, score in scores.items()}


class Evaluation(Record):
    """Scores of simplified scenes, and the settings of the measurement.

    Attributes:
        reference: Name of the full scene.
        reference_count: Number of its Gaussians.
        views: Names of the views.
        blind: Numbers of the views that show nothing of the full scene.
        width: Width of the images, pixels.
        height: Height of the images, pixels.
        backend: Name of the backend that rendered.
        lpips_network: The network of LPIPS; None if it was not measured.
        lpips_note: Why LPIPS was not measured, else empty.
        scenes: Scores of each simplified scene against images of the full one.
        photographs: Scores of the full and of each simplified scene against photographs, if any.
    """

    reference: str
    reference_count: int
    views: tuple[str, ...]
    blind: tuple[int, ...] = ()
    width: int
    height: int
    backend: str
    lpips_network: LpipsNetwork | None = None
    lpips_note: str = ""
    scenes: tuple[SceneScores, ...]
    photographs: tuple[SceneScores, ...] = ()

    @property
    def view_count(self) -> int:
        """Number of views that count in means of scores against images of the full scene."""
        return len(self.views) - len(self.blind)

    @property
    def lpips_sentence(self) -> str:
        """A sentence that names the LPIPS network or why LPIPS is missing; empty if turned off."""
        if self.lpips_network:
            return f"LPIPS with the network {self.lpips_network}."
        if self.lpips_note and self.lpips_note != NOT_ASKED_FOR:
            return f"LPIPS was not measured: {self.lpips_note}."
        return ""


@dataclass(frozen=True, slots=True, kw_only=True)
class EvaluationSettings:
    """Settings for rendering and scoring images.

    Attributes:
        background: Background colour: red, green and blue in [0, 1].
        lpips: LPIPS network: ``vgg``, ``alex``, ``off``, or ``auto`` (none without weights).
        backend: The rendering backend.

    Raises:
        InvalidArgumentError: The background is no colour, or there is no such network or backend.

    Example:
        >>> EvaluationSettings(lpips="off").background
        (0.0, 0.0, 0.0)
    """

    background: Color = BLACK
    lpips: LpipsChoice = "auto"
    backend: BackendName = "auto"

    def __post_init__(self) -> None:
        color = finite_numbers(self.background, 3)
        if color is None or not 0 <= min(color) <= max(color) <= 1:
            raise InvalidArgumentError(
                f"background must be three numbers in [0, 1], found {shown(self.background)}."
            )
        object.__setattr__(self, "background", color)
        for name, choices in (("lpips", LpipsChoice), ("backend", BackendName)):
            if getattr(self, name) not in get_args(choices):
                raise InvalidArgumentError(
                    f"{name} must be one of {', '.join(get_args(choices))}, "
                    f"found {shown(getattr(self, name))}."
                )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ViewImages:
    """Images of a scene over black, and their accumulated alpha."""

    cameras: Cameras
    rgb: Float[Tensor, "c h w 3"]
    alpha: Float[Tensor, "c h w"]

    @classmethod
    def joined(cls, images: Sequence[Self]) -> Self:
        """Return images of one size together."""
        if len(images) == 1:
            return images[0]
        return cls(
            cameras=join_cameras([one.cameras for one in images]),
            rgb=torch.cat([one.rgb for one in images]),
            alpha=torch.cat([one.alpha for one in images]),
        )

    def over(
        self, background: Float[Tensor, "3"] | Float[Tensor, "c 3"]
    ) -> Float[Tensor, "c h w 3"]:
        """Composite the images over a background, in the dtype of the background."""
        rgb, alpha = self.rgb.to(background.dtype), self.alpha.to(background.dtype)
        return rgb + (1 - alpha)[..., None] * background.view(-1, 1, 1, 3)

    def every(self, stride: int, *, first: tuple[int, int]) -> Self:
        """Return every ``stride``-th pixel, starting at a first column and row."""
        column, row = first
        return replace(
            self,
            cameras=self.cameras.every(stride, first=first),
            rgb=self.rgb[:, row::stride, column::stride],
            alpha=self.alpha[:, row::stride, column::stride],
        )

    def select(self, row: int) -> Self:
        """Return one of the images."""
        rows = torch.full((1,), row, device=self.cameras.Ks.device)  # no copy to the device
        part = slice(row, row + 1)
        return replace(
            self, cameras=self.cameras.select(rows), rgb=self.rgb[part], alpha=self.alpha[part]
        )

    def half(self) -> Self:
        """Return the images in half precision."""
        return replace(self, rgb=self.rgb.half(), alpha=self.alpha.half())

    def to(self, device: torch.device | str) -> Self:
        """Return the images on a device."""
        cameras = self.cameras.to(device)
        return replace(self, cameras=cameras, rgb=self.rgb.to(device), alpha=self.alpha.to(device))


@torch.no_grad()
def render_views(
    scene: GaussianScene, cameras: Cameras, *, backend: BackendName = "auto"
) -> ViewImages:
    """Render views of a scene, without gradients."""
    found = render(scene, cameras, backend=backend)
    return ViewImages(cameras=cameras, rgb=found.rgb, alpha=found.alpha)


class ImageScores(NamedTuple):
    """The metrics of one pair of images; None, or NaN for alpha, if not computed."""

    psnr: float
    ssim: float | None
    lpips: float | None
    alpha_error: float = math.nan
    alpha_bias: float = math.nan


@dataclass(frozen=True, slots=True, kw_only=True)
class Metrics:
    """The metrics to compute; LPIPS weights are kept, so they are read once."""

    ssim: bool = True
    alpha: bool = True  # whether to compare accumulated alpha
    lpips: LpipsWeights | None = None
    note: str = NOT_ASKED_FOR  # why LPIPS is omitted
    most_psnr: float = math.inf  # upper limit of PSNR, dB

    def compare(
        self,
        image: Float[Tensor, "1 h w 3"],
        truth: Float[Tensor, "1 h w 3"],
        *,
        alphas: tuple[Float[Tensor, "1 h w"], Float[Tensor, "1 h w"]] | None = None,
    ) -> ImageScores:
        """Score an image against the true one; ``alphas`` are those of both, in this order."""
        truth, weights = truth.to(image), self.lpips
        return ImageScores(
            psnr=min(float(pair_psnr(image, truth)), self.most_psnr),
            ssim=float(ssim(image, truth)) if self.ssim else None,
            lpips=float(lpips(image, truth, network=weights.network, weights=weights))
            if weights
            else None,
            alpha_error=float(alpha_error(*alphas)) if alphas else math.nan,
            alpha_bias=float(alpha_bias(*alphas)) if alphas else math.nan,
        )


def chosen_metrics(choice: LpipsChoice, size: tuple[int, int]) -> Metrics:
    """Choose PSNR, SSIM and an LPIPS network for images of a width and height."""
    if choice == "off":
        return Metrics()
    if choice in ("vgg", "alex"):
        return Metrics(lpips=load_lpips(choice), note="")
    note = ""
    networks: tuple[LpipsNetwork, ...] = ("vgg", "alex")
    for network in networks:
        if min(size) < LEAST_PIXELS[network]:
            note = f"images of {size[0]} x {size[1]} pixels are too small for it"
            continue
        try:
            return Metrics(lpips=load_lpips(network), note="")
        except CvtgsError as error:
            note = str(error).rstrip(".")
    return Metrics(note=note)


def scene_scores(
    name: str, count: int, rows: Sequence[ImageScores], *, blind: Sequence[int] = ()
) -> SceneScores:
    """Average the scores of a scene, one row per view, without blind views unless all are."""
    has_alpha = not any(math.isnan(row.alpha_error) for row in rows)
    counted = [view for view in range(len(rows)) if view not in blind] or range(len(rows))

    def score(metric: str) -> Score:
        values = tuple(getattr(row, metric) for row in rows)
        return Score(mean=Score.of([values[view] for view in counted]).mean, views=values)

    return SceneScores(
        name=name,
        count=count,
        psnr=score("psnr"),
        ssim=score("ssim"),
        lpips=None if any(row.lpips is None for row in rows) else score("lpips"),
        alpha_error=score("alpha_error") if has_alpha else None,
        alpha_bias=score("alpha_bias") if has_alpha else None,
    )


Truth = tuple[Cameras, list[Tensor], Tensor]
"""A camera, its image over every background, and its accumulated alpha."""


class Scorer:
    """Scores scenes against images of a full scene that count, which are rendered once.

    Memory: ``(12 b + 4) c h w`` bytes for ``c`` views over ``b`` backgrounds in float32.
    """

    def __init__(
        self,
        full: GaussianScene,
        cameras: Iterable[Cameras],
        *,
        metrics: Metrics,
        images: Iterable[ViewImages] = (),
        backgrounds: Sequence[Color] = (BLACK,),
        counts: Callable[[ViewImages], bool] = lambda image: True,
        progress: Callable[[int], object] = lambda done: None,
    ) -> None:
        self._metrics = metrics
        self._backgrounds = [full.means.new_tensor(color) for color in backgrounds]
        self._truths: list[Truth] = []
        done = 0
        for done, camera in enumerate(cameras, start=1):
            progress(done - 1)
            truth = render_views(full, camera)
            if counts(truth):
                self._keep(truth)
        for image in images:
            self._keep(image)
        progress(done)

    def __len__(self) -> int:
        return len(self._truths)

    def score(self, scene: GaussianScene) -> list[ImageScores]:
        """Score a scene, view by view and over every background."""
        scores = []
        for truths in self._small_groups():
            images = render_views(scene, join_cameras([camera for camera, _, _ in truths]))
            for row, (_, colors, alpha) in enumerate(truths):
                image = images.select(row)
                alphas = (image.alpha, alpha.to(image.alpha)) if self._metrics.alpha else None
                scores += [
                    self._metrics.compare(color, truth, alphas=alphas)
                    for color, truth in zip(self._over_all(image), colors, strict=True)
                ]
        return scores

    def _small_groups(self) -> list[list[Truth]]:
        """Return views in groups of one size and few pixels, which are rendered together."""
        groups: list[list[Truth]] = []
        for truth in self._truths:
            size = truth[2].shape
            fits = groups and groups[-1][0][2].shape == size
            if fits and (len(groups[-1]) + 1) * size.numel() <= PIXELS_TOGETHER:
                groups[-1].append(truth)
            else:
                groups.append([truth])
        return groups

    def _keep(self, truth: ViewImages) -> None:
        self._truths.append((truth.cameras, self._over_all(truth), truth.alpha))

    def _over_all(self, image: ViewImages) -> list[Float[Tensor, "1 h w 3"]]:
        return [image.over(background).clamp(0, 1) for background in self._backgrounds]
