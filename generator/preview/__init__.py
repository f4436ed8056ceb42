"""A folder of pages to look at a dataset with: a gallery, every label drawn into its image, and the statistics.

It opens from the disk in any browser and needs neither a server nor a network. What is drawn is data, as outlines and
lines in pixels of the image, so that every overlay can be switched on and off.
"""

from synthetless.preview.write import write_preview

__all__ = ["write_preview"]
