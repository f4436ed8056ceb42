"""Options that several commands have."""

from __future__ import annotations

from typing import Annotated

import typer

Split = Annotated[str | None, typer.Option(metavar="NAME", help="Folder of images, where there are several.")]
Workers = Annotated[int | None, typer.Option(min=1, metavar="N", help="Processes; default: one per core.")]
