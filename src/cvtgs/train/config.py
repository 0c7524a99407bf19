"""TrainConfig: the settings of a training, read from a TOML file."""

from pathlib import Path
from typing import Annotated, Literal, Self

import pydantic

from cvtgs.config import Section, explain, read_toml
from cvtgs.errors import ConfigError
from cvtgs.mergenet import SHIPPED
from cvtgs.mergenet.model import CellWidth, Width

Ratio = Annotated[float, pydantic.Field(gt=0.0, lt=1.0)]
Count = Annotated[int, pydantic.Field(ge=1)]
Side = Annotated[int, pydantic.Field(ge=11)]  # at least an SSIM window, pixels
Some = pydantic.Field(min_length=1)


class DataConfig(Section):
    """Training scenes, and validation scenes that decide when to stop.

    Attributes:
        folders: Folders of PLY files, of which hidden ones do not count; relative paths start at
            the folder of the configuration file.
        validation: Names of files, with or without ``.ply``, for validation only; if none is named,
            every fifth file, starting with the second. They are rendered with the cameras of
            ``NAME.transforms.json`` if it is in the same folder.
        generated: Number of generated training scenes of each kind.
        generated_validation: Number of generated validation scenes of each kind.
        generated_counts: Numbers of Gaussians of generated scenes, used cyclically.
        blocks: Number of compact pieces cut from each file that is larger than a piece.
        block_count: Number of Gaussians in a piece.
        copies: Number of perturbed copies of each scene or piece: thinned, stretched, with
            different contrast and opacity, half of them tagged ``SplatRenderMode: mip``.
        ratios: Ratios for training.
        validation_ratios: Ratios for validation.
        largest_scene: Files with more Gaussians are used only in pieces, to bound the time of a
            step.
    """

    folders: tuple[Path, ...] = ()
    validation: tuple[str, ...] = ()
    generated: int = pydantic.Field(default=4, ge=0)
    generated_validation: int = pydantic.Field(default=1, ge=0)
    generated_counts: Annotated[tuple[Count, ...], Some] = (20_000, 40_000, 60_000, 80_000)
    blocks: int = pydantic.Field(default=4, ge=0)
    block_count: Count = 60_000
    copies: int = pydantic.Field(default=0, ge=0)
    ratios: Annotated[tuple[Ratio, ...], Some] = (0.15, 0.06, 0.02, 0.008, 0.003, 0.001)
    validation_ratios: Annotated[tuple[Ratio, ...], Some] = (0.1, 0.01, 0.001)
    largest_scene: Count = 130_000


class ViewsConfig(Section):
    """Training images: a quarter from automatic cameras, the others from random positions.

    Attributes:
        count: Number of images of each scene at each size.
        sizes: Sides of the square images, pixels; all sides are at least 11, the SSIM window.
        per_step: Number of images that one step renders.
        crop: Side of the random crop that is compared in each image, pixels.
        validation_count: Number of images of each validation scene.
        validation_size: Side of the validation images, pixels.
    """

    count: Count = 16
    sizes: Annotated[tuple[Side, ...], Some] = (256, 448)
    per_step: Count = 2
    crop: Side = 256
    validation_count: Count = 8
    validation_size: Side = 400


class LossConfig(Section):
    """Weights of the loss, a sum of logarithms and the cost of the residuals.

    ``mse_weight log(mse) + image_weight log(loss of CVT-GS) + ssim_weight log(1 - SSIM)
    + residual_weight * size of the residuals``.
    With logarithms, every scene, ratio and view has the same weight, as in a mean of PSNR. One of
    the first three weights must be above 0, but for a ``published`` training, which ignores them.

    Attributes:
        mse_weight: Weight of the logarithm of the mean squared error.
        image_weight: Weight of the logarithm of the loss of CVT-GS, ``0.8 L1 + 0.2 (1 - SSIM) +
            0.2 gradient``.
        ssim_weight: Weight of the logarithm of the structural dissimilarity, ``1 - SSIM``.
        residual_weight: Weight of the size of the residuals.
    """

    mse_weight: float = pydantic.Field(default=0.5, ge=0.0)
    image_weight: float = pydantic.Field(default=0.5, ge=0.0)
    ssim_weight: float = pydantic.Field(default=0.0, ge=0.0)
    residual_weight: float = pydantic.Field(default=0.0, ge=0.0)


class TrainConfig(Section):
    """The settings of a training. The class is frozen, and unknown keys are errors.

    Attributes:
        kind: ``scene``: whole simplified scenes are rendered; ``local``: single cells;
            ``published``: the network and the training of CVT-GS on crops of single cells.
        preset: The preset whose merged Gaussians the network learns to correct.
        start: Checkpoint to start from, of the same kind, widths and largest growth.
        seed: Seed of all random numbers.
        steps: Number of training steps.
        cases_per_step: Number of scenes, each at one ratio, whose gradients are averaged in a step.
            On a CPU, processes on all cores share them.
        learning_rate: Largest learning rate of Adam; it falls to zero along a cosine.
        restart_step: Step at which the learning rate rises again, to fall a second time until the
            last step; 0 for one fall only. With its number of steps here, and more steps, a
            finished training can be resumed.
        restart_rate: Largest learning rate after the restart.
        width: Units of the layers for members and neighbours, at most 1024.
        cell_width: Units of the layers for cells, at most 4096.
        largest_growth: Largest change of a log scale; the published network has no limit.
        validate_every: Steps between validations.
        patience: Number of validations without a new best after which training stops.
        keep: Which validation gives the saved network: the ``best`` so far, or the ``last``.
        averaged_steps: The saved network is a running mean of the weights over about this many
            steps, and over at most a ninth of all steps so far.
        cells: Largest number of cells in one step of a ``local`` or ``published`` training.
        members: Largest total number of members in one step of a ``published`` training.
        tile: Side of the crop that shows a cell in a ``published`` training, pixels.
        note: Sentence about the training data, stored in the checkpoint.
        data: Scenes.
        views: Images.
        loss: Loss.

    Example:
        >>> TrainConfig(steps=10).data.ratios[0]
        0.15
    """

    kind: Literal["scene", "local", "published"] = "scene"
    preset: Literal["standard", "paper"] = "standard"
    start: Path | None = None
    seed: int = pydantic.Field(default=0, ge=0, lt=1 << 63)
    steps: Count = 6000
    cases_per_step: Count = 1
    learning_rate: float = pydantic.Field(default=5e-3, gt=0.0, le=1.0)
    restart_step: int = pydantic.Field(default=0, ge=0)
    restart_rate: float = pydantic.Field(default=1e-3, gt=0.0, le=1.0)
    width: Width = 48
    cell_width: CellWidth = 96
    largest_growth: float = pydantic.Field(default=0.6, gt=0.0, le=3.0)
    validate_every: Count = 500
    patience: Count = 1000
    keep: Literal["best", "last"] = "best"
    averaged_steps: Count = 500
    cells: Count = 49
    members: Count = 4096
    tile: int = pydantic.Field(default=24, ge=11, le=256)
    note: str = ""
    data: DataConfig = DataConfig()
    views: ViewsConfig = ViewsConfig()
    loss: LossConfig = LossConfig()

    @pydantic.model_validator(mode="after")
    def _check(self) -> Self:
        loss = self.loss
        weights = (loss.mse_weight, loss.image_weight, loss.ssim_weight)
        if self.kind != "published" and not any(weights):
            raise ConfigError(
                "loss: one of mse_weight, image_weight and ssim_weight must be above 0, found 0 "
                "for all."
            )
        if self.restart_step >= self.steps:
            raise ConfigError(
                f"restart_step must be below the {self.steps} steps, found {self.restart_step}."
            )
        return self

    @classmethod
    def from_toml(cls, path: str | Path) -> Self:
        """Read a configuration file.

        Args:
            path: A TOML file with the keys of this class; missing keys keep their defaults.

        Returns:
            The configuration; relative paths are resolved against the folder of the file.

        Raises:
            ConfigError: The file cannot be read, is not TOML, or has an invalid key or value.
        """
        path = Path(path)
        try:
            config = cls.model_validate(read_toml(path))
        except pydantic.ValidationError as error:
            raise ConfigError(f"{path}: {explain(error)}") from None
        folders = tuple(path.parent / folder for folder in config.data.folders)
        start = config.start
        if start is not None and str(start) not in SHIPPED:
            start = path.parent / start
        data = config.data.model_copy(update={"folders": folders})
        return config.model_copy(update={"data": data, "start": start})
