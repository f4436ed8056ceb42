"""A dataset on disk: what it consists of, how it is read, filled, labelled and described."""

from synthetless.dataset.reader import Dataset, Image, Instance, Label, Scene, Visibility

__all__ = ["Dataset", "Image", "Instance", "Label", "Scene", "Visibility"]
