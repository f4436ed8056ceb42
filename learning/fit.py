"""The one training loop: a batch and a learning rate follow from the step, so that a resumed run ends the same."""

from __future__ import annotations

import io
import json
import math
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import torch
from torch import Tensor, nn

from synthetless.errors import UserError
from synthetless.io.files import atomic_write, read_bytes

CHECKPOINT_FILE, LOG_FILE = "checkpoint.pt", "log.jsonl"
_WARM_UP = 0.3
_START = 0.04
"""Share of the peak learning rate at the first step."""


@dataclass(frozen=True)
class Schedule:
    """How long and how fast to learn.

    Attributes:
        steps: batches.
        peak_rate: AdamW's largest learning rate, after 30 % of the steps; it starts at 4 % of it and ends at 0.
        weight_decay: AdamW's.
        clip: largest norm of the gradient.
        log_every: steps between two lines of the log.
        save_every: steps between two checkpoints.
    """

    steps: int
    peak_rate: float = 2e-3
    weight_decay: float = 1e-4
    clip: float = 10.0
    log_every: int = 50
    save_every: int = 500

    def rate(self, step: int) -> float:
        """Learning rate of a step, counted from 0: one cycle, both halves cosines."""
        warm = max(1, round(_WARM_UP * self.steps))
        if step < warm:
            share = (1 - math.cos(math.pi * step / warm)) / 2
            return self.peak_rate * (_START + (1 - _START) * share)
        return self.peak_rate * (1 + math.cos(math.pi * (step - warm) / max(1, self.steps - warm))) / 2


class Losses(Protocol):
    """Computes a step's losses, by name; their sum is minimised."""

    def __call__(self, step: int) -> Mapping[str, Tensor]: ...


NO_LOSSES = ("step", "seconds", "seconds_left", "rate")
Record = dict[str, Any]
"""A line of the log: step, seconds since the start and left, rate, every loss as the mean since the last line, and what
was measured."""


def fit(
    model: nn.Module,
    losses: Losses,
    schedule: Schedule,
    run: Path | None = None,
    measure: Callable[[], Mapping[str, float]] | None = None,
    precision: torch.dtype | None = None,
    device: torch.device | None = None,
    writes: bool = True,
) -> Iterator[Record]:
    """Train, and yield a record at every interval and at the end.

    Args:
        model: its parameters that want a gradient are trained.
        losses: of a step.
        schedule: see there.
        run: folder of the checkpoints and the log; a checkpoint in it is continued. None keeps nothing.
        measure: what else to put into a record, on validation data say; the model is in evaluation mode meanwhile.
        precision: of the forward pass where it differs from float32.
        device: where the model is, for ``precision``.
        writes: whether this process writes into ``run``; of several, one does, and all continue its checkpoint.

    Raises:
        UserError: a checkpoint is damaged or of another model, or a loss is not finite.
    """
    parameters = [p for p in model.parameters() if p.requires_grad]
    optimizer = torch.optim.AdamW(parameters, lr=schedule.peak_rate, weight_decay=schedule.weight_decay)
    step = _resume(run, model, optimizer) if run is not None else 0
    kept = run if writes else None
    if kept is not None:
        _forget_after(kept / LOG_FILE, step)
    sums: dict[str, float] = {}
    first = since = step
    started = time.monotonic()
    while step < schedule.steps:
        model.train()
        for group in optimizer.param_groups:
            group["lr"] = schedule.rate(step)
        with torch.autocast((device or torch.device("cpu")).type, precision, enabled=precision is not None):
            parts = losses(step)
        total = torch.stack(list(parts.values())).sum()
        if not torch.isfinite(total):
            raise UserError(f"step {step}: the loss is {total.item()}; take a lower learning rate")
        optimizer.zero_grad(set_to_none=True)
        total.backward()  # type: ignore[no-untyped-call]
        nn.utils.clip_grad_norm_(parameters, schedule.clip)
        optimizer.step()
        step += 1
        for name, part in parts.items():
            sums[name] = sums.get(name, 0.0) + part.item()
        if step % schedule.log_every == 0 or step == schedule.steps:
            seconds = time.monotonic() - started
            record: Record = {"step": step, "seconds": round(seconds, 2), "rate": schedule.rate(step - 1)}
            record["seconds_left"] = round(seconds / (step - first) * (schedule.steps - step), 1)
            record |= {name: value / (step - since) for name, value in sums.items()}
            if measure is not None:
                model.eval()
                with torch.no_grad():
                    record |= measure()
            sums, since = {}, step
            if kept is not None:
                _append(kept / LOG_FILE, record)
            yield record
        if run is not None and (step % schedule.save_every == 0 or step == schedule.steps):
            save(
                run / CHECKPOINT_FILE, {"model": model.state_dict(), "optimizer": optimizer.state_dict(), "step": step}
            )


def save(path: Path, content: Mapping[str, Any]) -> None:
    """Write tensors and plain values, whole or not at all."""
    written = io.BytesIO()
    torch.save(dict(content), written)
    atomic_write(path, written.getvalue(), durable=True)


def load(path: Path) -> dict[str, Any]:
    """Read what ``save`` wrote, on the CPU; nothing in the file is executed.

    Raises:
        UserError: the file is missing or damaged.
    """
    data = read_bytes(path)
    try:
        content = torch.load(io.BytesIO(data), map_location="cpu", weights_only=True)
    except Exception as error:  # torch raises whatever its readers stumble over
        raise UserError(f"{path}: is no checkpoint, or is damaged ({str(error).splitlines()[0][:100]})") from None
    if not isinstance(content, dict):
        raise UserError(f"{path}: is no checkpoint: it holds a {type(content).__name__}")
    return content


def load_weights(model: nn.Module, weights: Mapping[str, Tensor], path: Path) -> None:
    """Give a model the weights that ``path`` holds.

    Raises:
        UserError: they are of another model.
    """
    try:
        model.load_state_dict(dict(weights))
    except RuntimeError as error:
        reason = " ".join(str(error).split())[:160]
        raise UserError(f"{path}: the weights are of another network ({reason})") from None


def read_log(run: Path) -> list[Record]:
    """The records of a run; a last line that was cut off is left out."""
    path = run / LOG_FILE
    if not path.exists():
        return []
    records = []
    for line in path.read_text(encoding="utf-8").splitlines():
        try:
            records.append(json.loads(line))
        except ValueError:
            break
    return records


def _resume(run: Path, model: nn.Module, optimizer: torch.optim.Optimizer) -> int:
    path = run / CHECKPOINT_FILE
    if not path.exists():
        return 0
    kept = load(path)
    if not {"model", "optimizer", "step"} <= kept.keys():
        raise UserError(f"{path}: is no checkpoint of a training run")
    load_weights(model, kept["model"], path)
    optimizer.load_state_dict(kept["optimizer"])
    return int(kept["step"])


def _append(path: Path, record: Record) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a", encoding="utf-8") as file:
        file.write(json.dumps(record) + "\n")


def _forget_after(path: Path, step: int) -> None:
    """Leave out the lines after the checkpoint that is continued: they will be written again."""
    if path.exists():
        kept = [record for record in read_log(path.parent) if record["step"] <= step]
        atomic_write(path, "".join(json.dumps(record) + "\n" for record in kept).encode())
