"""The typed tree of a training: network, sampling, losses, schedule. Needs no torch."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field

from synthetless.config import settings_tables
from synthetless.learning.targets import LabelSet
from synthetless.scenes.settings import Bounds, Settings


class NetworkSettings(Settings):
    """The detector."""

    weights: str = "imagenet"
    """Of the backbone: imagenet (they come with a package), none, or a file of weights of an EfficientNet-Lite0."""
    frozen_stages: Annotated[int, Bounds(0, 7)] = 2
    """The stem and so many stages of the backbone are not trained."""
    channels: Annotated[int, Bounds(8, 1024)] = 96
    """Channels of the feature map of stride 8."""
    anchor_sizes_px: tuple[int, ...] = (24, 48, 96, 192)
    """Sides of the square anchors."""
    anchor_ratios: tuple[float, ...] = (0.5, 1.0, 2.0)
    """Heights over widths of the anchors."""
    roi_cells: Annotated[int, Bounds(1, 32)] = 7
    """Cells along each side of a box's features."""
    hidden: Annotated[int, Bounds(8, 4096)] = 512
    """Features of a box before the heads' last layers."""


class SamplingSettings(Settings):
    """Which boxes are learned from, and which are looked at."""

    proposals: Annotated[int, Bounds(1, 5000)] = 150
    """Boxes that the proposal network hands on, at most."""
    rois_per_image: Annotated[int, Bounds(4, 2000)] = 48
    """Boxes of an image that the heads learn from; at most a third shows an object."""
    anchors_per_image: Annotated[int, Bounds(4, 5000)] = 256
    """Anchors of an image that the proposal network learns from; at most half of them positive."""
    score_threshold: Annotated[float, Bounds(0, 1)] = 0.05
    """Detections below it are dropped."""
    nms_threshold: Annotated[float, Bounds(0, 1)] = 0.5
    """Detections of a class that overlap by more are one."""
    detections: Annotated[int, Bounds(1, 1000)] = 50
    """Detections of an image, at most."""


class DataSettings(Settings):
    """What is learned from."""

    objects: tuple[int, ...] = ()
    """Object ids; all of the dataset's models if empty."""
    min_visib_fract: Annotated[float, Bounds(0, 1)] = 0.1
    """Instances of which less is visible are neither learned nor counted as background."""
    brightness: Annotated[float, Bounds(0, 1)] = 0.3
    """Pixels are multiplied by 1 plus or minus up to this."""
    noise: Annotated[float, Bounds(0, 100)] = 8.0
    """Largest standard deviation of the added noise, of 255."""
    sensor: Literal["none", "ranges", "primesense"] = "none"
    """Take every image anew with such a camera, from its linear light; the dataset needs the output exr."""
    workers: Annotated[int, Bounds(0, 256)] = 0
    """Processes that read images, at most as many as cores; 0: the training's own."""


class ScheduleSettings(Settings):
    """How long and how fast."""

    steps: Annotated[int, Bounds(1, 10_000_000)] = 4000
    """Batches."""
    images_per_step: Annotated[int, Bounds(1, 1024)] = 2
    """Images of a batch (of each process)."""
    peak_rate: Annotated[float, Bounds(1e-7, 1)] = 5e-4
    """AdamW's largest learning rate."""
    weight_decay: Annotated[float, Bounds(0, 1)] = 1e-4
    """AdamW's weight decay."""
    log_every: Annotated[int, Bounds(1, 1_000_000)] = 50
    """Steps between two lines of the log."""
    save_every: Annotated[int, Bounds(1, 1_000_000)] = 500
    """Steps between two checkpoints."""
    precision: Literal["float32", "bfloat16"] = "float32"
    """Of the forward pass; bfloat16 is faster on GPUs that have it."""


def _word(value: Any) -> Any:
    """YAML reads the word true as a truth value."""
    return "true" if value is True else value


class Training(Settings):
    """Everything that decides a training besides its data."""

    labels: Annotated[LabelSet, BeforeValidator(_word)] = "atlas"
    """What is learned: true, map, pitteri2019, pitteri2019-top or atlas."""
    seed: Annotated[int, Bounds(0, 2**63 - 1)] = 0
    """Initial weights and the order of the images follow from it."""
    network: NetworkSettings = Field(default_factory=NetworkSettings)
    """The detector."""
    sampling: SamplingSettings = Field(default_factory=SamplingSettings)
    """Boxes."""
    data: DataSettings = Field(default_factory=DataSettings)
    """Images and instances."""
    schedule: ScheduleSettings = Field(default_factory=ScheduleSettings)
    """Steps."""


def training_page() -> str:
    """The reference page of all settings, as Markdown."""
    head = [
        "# Settings of a training",
        "",
        "A training is a YAML file of the settings below; a setting that it leaves out has its default. On the command",
        "line, `--set schedule.steps=1000` overrides one. `run.json` records the training as it was used.",
        "[learning.md](learning.md) says what it is about.",
        "",
        "This page is written by `make docs`.",
    ]
    return "\n".join([*head, *settings_tables(Training)]) + "\n"
