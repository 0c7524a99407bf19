"""The views and images of a refinement: training views and held-out views."""

import random
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import count

import torch
from jaxtyping import Float
from torch import Tensor

from cvtgs.cameras import Cameras
from cvtgs.config import RefineConfig
from cvtgs.evaluation.blind_views import seeing_rows
from cvtgs.evaluation.scorer import ViewImages, render_views
from cvtgs.losses import SSIM_WINDOW
from cvtgs.rendering import ObservedViews
from cvtgs.rendering.render import showing_rows
from cvtgs.scene import GaussianScene
from cvtgs.views import find_view_positions, mixed_views

# Added to the seed, so that held-out and training views differ, also from those of evaluations.
HELDOUT_SEED, TRAINING_SEED = 101, 211


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RefineViews:
    """The views of a refinement; held-out ones decide which scene is kept."""

    heldout: tuple[Cameras, ...]  # single cameras of one size
    training: Iterator[Cameras]  # single cameras
    endless: bool  # whether ``training`` never ends
    heldout_images: tuple[ViewImages, ...] = ()  # further held-out views, already rendered
    images: tuple[ViewImages, ...] = ()  # rendered before the first step; steps see all pixels


def generated_views(full: GaussianScene, *, config: RefineConfig, seed: int) -> RefineViews:
    """Find views of a scene: a quarter automatic ones, the others from valid random positions."""
    positions = find_view_positions(full)
    side = max(config.size, SSIM_WINDOW * config.stride)

    def batch(number: int, seed: int) -> list[Cameras]:
        views = mixed_views(positions, number, size=side, seed=seed)
        return views.in_two_sizes(config.fine_factor).in_both_modes().singles()

    def training() -> Iterator[Cameras]:
        for number in count():
            views = batch(config.batch, seed + TRAINING_SEED + number)
            random.Random(seed + number).shuffle(views)
            yield from views

    heldout = _thinned(batch(config.heldout, seed + HELDOUT_SEED), config.stride)
    return RefineViews(heldout=heldout, training=training(), endless=True)


def split_views(
    cameras: Cameras, *, config: RefineConfig, seed: int, full: GaussianScene | None = None
) -> RefineViews:
    """Split cameras, at least 2; held-out ones are evenly spread among those that see ``full``."""
    seeing = range(len(cameras)) if full is None else seeing_rows(full, cameras)
    side = min(config.size, max(cameras.width, cameras.height))
    sized = cameras.fitted(side, least=SSIM_WINDOW * config.stride)
    views = sized.in_two_sizes(config.fine_factor).singles()
    held = _heldout_rows(seeing, config)
    others = [view for row, view in enumerate(views) if row not in held]
    random.Random(seed).shuffle(others)
    heldout = _thinned([views[row] for row in held], config.stride)
    return RefineViews(heldout=heldout, training=iter(others), endless=False)


def shared_views(
    observed: ObservedViews,
    full: GaussianScene,
    cameras: Cameras | None,
    *,
    config: RefineConfig,
    seed: int,
) -> RefineViews:
    """Split existing images like :func:`split_views`; further training views are new ones."""
    rgb, alpha = observed.rgb.to(full.device), observed.alpha.to(full.device)
    whole = ViewImages(cameras=observed.cameras, rgb=rgb, alpha=alpha)
    images = [whole.select(row) for row in range(len(observed.cameras))]
    showing = showing_rows(alpha)
    held = _heldout_rows(showing if len(showing) > 1 else range(len(alpha)), config)
    further = _further(observed.cameras, full, cameras, config=config, seed=seed)
    return RefineViews(
        heldout=(),
        training=(view.to(observed.cameras.viewmats.device) for view in further),
        endless=cameras is None,
        heldout_images=tuple(images[row] for row in held),
        images=tuple(image.half() for row, image in enumerate(images) if row not in held),
    )


def _further(
    used: Cameras, full: GaussianScene, cameras: Cameras | None, *, config: RefineConfig, seed: int
) -> Iterator[Cameras]:
    """Yield further training views; they are searched lazily."""
    if cameras is None:
        yield from generated_views(full, config=config, seed=seed).training
        return
    taken = {tuple(viewmat.flatten().tolist()) for viewmat in used.viewmats}
    for view in split_views(cameras, config=config, seed=seed).training:
        if tuple(view.viewmats[0].flatten().tolist()) not in taken:
            yield view


def _heldout_rows(rows: Sequence[int], config: RefineConfig) -> tuple[int, ...]:
    """Return some row numbers of views, spread evenly, which are held out."""
    count = len(rows)
    number = config.heldout_of(count)
    return tuple(rows[(2 * k + 1) * count // (2 * number)] for k in range(number))


def _thinned(views: Sequence[Cameras], stride: int) -> tuple[Cameras, ...]:
    """Return every ``stride``-th pixel of each view, with a different first pixel per view."""
    return tuple(
        view.every(stride, first=(row % stride, row // stride % stride))
        for row, view in enumerate(views)
    )


class ImageBuffer:
    """Training images: the first are new, later ones are new at intervals and reused in between.

    Memory: 8 bytes per pixel of ``config.images`` images, and as much for those of a step.
    """

    def __init__(
        self,
        full: GaussianScene,
        views: RefineViews,
        *,
        config: RefineConfig,
        seed: int,
        thinning: int = 1,
    ) -> None:
        always_new = views.endless and config.steps_per_image == 1
        self._full = full
        self._cameras = views.training
        self._config, self._thinning = config, thinning
        self._capacity = max(1 if always_new else config.images, len(views.images))
        self._first = max(config.first_images, len(views.images))
        self._rng = random.Random(seed)
        self._kept = [(image, 1) for image in views.images]  # with what is left of the stride
        self._drawn = len(self._kept)
        self.rendered: int = 0

    def draw_step(self) -> list[ViewImages]:
        """Return the training images of a step, those of one size together."""
        groups: dict[tuple[int, ...], list[ViewImages]] = {}
        for _ in range(self._config.images_per_step):
            image = self.draw()
            groups.setdefault(image.rgb.shape, []).append(image)
        return [ViewImages.joined(group) for group in groups.values()]

    def draw(self) -> ViewImages:
        """Return a training image, in half precision."""
        self._drawn += 1
        later = self._drawn - self._first
        is_due = later <= 0 or later % self._config.steps_per_image == 0
        camera = next(self._cameras, None) if is_due else None
        if camera is None:
            used = self._kept.pop(self._rng.randrange((len(self._kept) + 1) // 2))
            self._kept.append(used)
        else:
            if len(self._kept) == self._capacity:
                self._kept.pop(self._rng.randrange(len(self._kept)))
            self._kept.append((render_views(self._full, camera).half(), self._config.stride))
            self.rendered += 1
        image, stride = self._kept[-1]
        most = min(image.rgb.shape[1:3]) // SSIM_WINDOW
        stride = max(stride, min(stride * self._thinning, most))
        if stride == 1:
            return image
        first = (self._rng.randrange(stride), self._rng.randrange(stride))
        return image.every(stride, first=first)

    def draw_backgrounds(self, count: int) -> Float[Tensor, "c 3"]:
        """Return a random color for each of some images."""
        rows = [[self._rng.random() for _ in range(3)] for _ in range(count)]
        colors = torch.tensor(rows, dtype=self._full.dtype, device="cpu")
        return colors.to(self._full.device, non_blocking=True)
