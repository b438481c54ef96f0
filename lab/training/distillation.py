"""Distillation: from an augmented crop, the student learns to predict the teacher's features of the clean one.

Loss: the mean over cells of 1 - cosine(head(student map), standardized teacher map), for
conv3 against the teacher's conv5_1 and conv4 against its conv5_5.
"""

from __future__ import annotations

import csv
import itertools
import json
import os
import time
from collections.abc import Iterator
from copy import deepcopy
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
import torch.nn.functional as F
import typer
from safetensors.torch import load_file, save_file
from torch import Tensor
from torch.utils.data import DataLoader

from lab.training.photographs import AugmentedCrops, split_photographs
from lab.training.student import Student
from lab.training.teacher import Teacher

SIDE = 227
"""Height and width of a crop in pixels."""
HELD_OUT_BATCHES = 6
HEADS_ALONE = 0.02
AVERAGING = 0.999  # decay of the running average of the weights, which is what is exported


class Standardization:
    """Subtracts the mean and divides by the spread of each channel of a teacher's map."""

    def __init__(self, mean: Tensor, spread: Tensor) -> None:
        self.mean, self.spread = mean, spread

    @classmethod
    def of(cls, maps: Tensor) -> Standardization:  # B x K x X x Y
        mean = maps.mean((0, 2, 3), keepdim=True)
        variance = maps.var((0, 2, 3), keepdim=True)
        # The floor keeps channels that almost never fire from being blown up into noise.
        return cls(mean, torch.sqrt(variance + 0.25 * variance.mean()))

    def __call__(self, maps: Tensor) -> Tensor:
        return (maps - self.mean) / self.spread


def cosine_loss(prediction: Tensor, target: Tensor) -> Tensor:
    """Mean over all cells of 1 - cosine over channels; both B x K x X x Y."""
    return 1 - F.cosine_similarity(prediction.float(), target.float(), dim=1).mean()


def learning_rate(step: int, steps: int, peak: float) -> float:
    """A linear rise over the first 2 % of the steps, then half a cosine down to 1 % of the peak."""
    rise = max(1, steps // 50)
    if step < rise:
        return peak * (step + 1) / rise
    return peak * (0.01 + 0.99 * 0.5 * (1 + float(np.cos(np.pi * (step - rise) / max(1, steps - rise)))))


def _batches(loader: DataLoader[Any], device: torch.device) -> Iterator[tuple[Tensor, Tensor]]:
    for clean, augmented in loader:
        yield tuple(
            pixels.to(device).permute(0, 3, 1, 2).float().contiguous(memory_format=torch.channels_last)
            for pixels in (clean, augmented)
        )


@torch.no_grad()
def _update_average(average: Student, student: Student, decay: float) -> None:
    for retained, new in zip(average.state_dict().values(), student.state_dict().values(), strict=True):
        if retained.dtype.is_floating_point:
            retained.lerp_(new, 1 - decay)
        else:
            retained.copy_(new)


def distill(
    photographs: Path,
    teacher_weights: Path,
    output: Path,
    *,
    crops: int,
    batch: int = 32,
    peak_rate: float = 2e-3,
    seed: int = 0,
    workers: int = 1,
    checkpoint_every: int = 500,
    stop_after: int | None = None,
    start: Path | None = None,
    side: int = SIDE,
    held_out_batches: int = HELD_OUT_BATCHES,
) -> Path:
    """Train for ``crops`` crops, resuming from ``output`` if a checkpoint lies there.

    Writes ``checkpoint.safetensors`` and ``progress.json`` (state), ``log.csv`` (one row per
    checkpoint: crops, rate, loss, held-out loss, seconds) and ``weights.safetensors`` (batch norm
    folded, averaged weights).

    Args:
        stop_after: end this sitting after that many steps (the schedule stays that of ``crops``).
        start: folded weights of an earlier run to go on from; the first HEADS_ALONE of the steps
            then move nothing but the heads.
        side: of the crops, in pixels; 3 more than a multiple of 16, so that the grids of both networks agree.
        held_out_batches: how many batches the held-out loss is the mean of.

    Returns:
        The path of the folded weights.
    """
    torch.manual_seed(seed)
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    output.mkdir(parents=True, exist_ok=True)
    split = split_photographs(photographs)
    layout = {"memory_format": torch.channels_last, "device": device}
    teacher = Teacher(teacher_weights).to(**layout)  # type: ignore[call-overload]
    student = Student().to(**layout).train()  # type: ignore[call-overload]
    average = deepcopy(student).eval()
    decayed = [p for p in student.parameters() if p.ndim > 1]
    others = [p for p in student.parameters() if p.ndim <= 1]
    optimizer = torch.optim.AdamW(
        [{"params": decayed, "weight_decay": 0.05}, {"params": others, "weight_decay": 0.0}], lr=peak_rate
    )
    steps, first = crops // batch, 0
    if (output / "progress.json").exists():
        first = _restore(output, student, average, optimizer)

    # Processors without AVX-512 compute in bfloat16 ten times slower than in float32.
    quick = device.type != "cpu" or torch.backends.cpu.get_cpu_capability().startswith("AVX512")

    def autocast() -> torch.autocast:
        return torch.autocast(device.type, torch.bfloat16, enabled=quick)

    def targets(clean: Tensor, standards: tuple[Standardization, ...] | None) -> tuple[Tensor, ...]:
        with torch.no_grad(), autocast():
            maps = teacher(clean)
        maps = tuple(m.float() for m in maps)
        return maps if standards is None else tuple(s(m) for s, m in zip(standards, maps, strict=True))

    def crops_of(paths: tuple[Path, ...], start: int, stop: int, seed: int) -> Iterator[tuple[Tensor, Tensor]]:
        dataset = AugmentedCrops(paths, photographs, side, seed, start, stop)
        return _batches(DataLoader(dataset, batch, num_workers=workers, drop_last=True), device)

    # The standardization is drawn from the seed alone, so a resumed run computes the same one.
    sample = [targets(clean, None) for clean, _ in itertools.islice(crops_of(split.train, 0, 8 * batch, seed + 1), 8)]
    standards = tuple(Standardization.of(torch.cat(maps)) for maps in zip(*sample, strict=True))

    if start is not None and first == 0:
        pixels = torch.cat([clean for clean, _ in itertools.islice(crops_of(split.train, 0, 8 * batch, seed + 3), 8)])
        student.load_folded_weights(load_file(start), pixels)
        average.load_state_dict(student.state_dict())
    backbone = list(student.stages.parameters())
    heads_alone = 0 if start is None else int(HEADS_ALONE * steps)

    def loss_of(network: Student, clean: Tensor, augmented: Tensor) -> Tensor:
        goal = targets(clean, standards)
        with autocast():
            made = network(augmented)
        return sum((cosine_loss(p, t) for p, t in zip(made, goal, strict=True)), torch.zeros((), device=device))

    @torch.no_grad()
    def held_out_loss() -> float:
        pairs = crops_of(split.held_out, 0, held_out_batches * batch, seed + 2)
        return float(np.mean([loss_of(average, *pair).item() for pair in pairs]))

    last = steps if stop_after is None else min(steps, first + stop_after)
    losses: list[float] = []
    started = time.monotonic()
    for step, pair in enumerate(crops_of(split.train, first * batch, last * batch, seed), start=first):
        for group in optimizer.param_groups:
            group["lr"] = learning_rate(step, steps, peak_rate)
        for parameter in backbone:
            parameter.requires_grad_(step >= heads_alone)
        loss = loss_of(student, *pair)
        optimizer.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]
        torch.nn.utils.clip_grad_norm_(student.parameters(), 5.0)
        optimizer.step()
        _update_average(average, student, min(AVERAGING, (step + 1) / (step + 10)))
        losses.append(loss.item())
        if (step + 1) % checkpoint_every == 0 or step + 1 == last:
            row = {
                "crops": (step + 1) * batch,
                "rate": f"{learning_rate(step, steps, peak_rate):.6f}",
                "loss": f"{np.mean(losses):.4f}",
                "held_out_loss": f"{held_out_loss():.4f}",
                "seconds": f"{time.monotonic() - started:.0f}",
            }
            losses.clear()
            _checkpoint(output, step + 1, student, average, optimizer, row)
            typer.echo(json.dumps(row))
    return output / "weights.safetensors"


def _checkpoint(
    output: Path, step: int, student: Student, average: Student, optimizer: torch.optim.Optimizer, row: dict[str, Any]
) -> None:
    """Write state, weights and a log row; each file whole or not at all."""
    state = {f"student.{k}": v for k, v in student.state_dict().items()}
    state |= {f"average.{k}": v for k, v in average.state_dict().items()}
    for index, moments in optimizer.state_dict()["state"].items():
        state |= {f"optimizer.{index}.{k}": v for k, v in moments.items()}
    _replace(output / "checkpoint.safetensors", {k: v.contiguous().clone() for k, v in state.items()})
    _replace(output / "weights.safetensors", average.folded_weights())
    log = output / "log.csv"
    new = not log.exists()
    with log.open("a", newline="") as file:
        writer = csv.DictWriter(file, list(row))
        if new:
            writer.writeheader()
        writer.writerow(row)
    (output / "progress.json.tmp").write_text(json.dumps({"step": step}))
    os.replace(output / "progress.json.tmp", output / "progress.json")


def _replace(path: Path, tensors: dict[str, Tensor]) -> None:
    save_file(tensors, path.with_suffix(".tmp"))
    os.replace(path.with_suffix(".tmp"), path)


def _restore(output: Path, student: Student, average: Student, optimizer: torch.optim.Optimizer) -> int:
    """Load what :func:`_checkpoint` wrote; returns the number of steps done."""
    tensors = load_file(output / "checkpoint.safetensors")

    def part(prefix: str) -> dict[str, Tensor]:
        return {k.removeprefix(prefix): v for k, v in tensors.items() if k.startswith(prefix)}

    student.load_state_dict(part("student."))
    average.load_state_dict(part("average."))
    moments: dict[int, dict[str, Tensor]] = {}
    for key, value in part("optimizer.").items():
        index, name = key.split(".")
        moments.setdefault(int(index), {})[name] = value
    optimizer.load_state_dict({"state": moments, "param_groups": optimizer.state_dict()["param_groups"]})
    return int(json.loads((output / "progress.json").read_text())["step"])


def main(
    photographs: Annotated[Path, typer.Option(help="Folder of training photographs, sources as subfolders.")] = Path(
        "../shared/datasets/train"
    ),
    teacher: Annotated[Path, typer.Option(help="MobileNetV1 weights as .npz.")] = Path(
        "../shared/teachers/mobilenet_v1_imagenet.npz"
    ),
    output: Annotated[Path, typer.Option(help="Folder for checkpoints, log and weights.")] = Path("runs/distillation"),
    crops: Annotated[int, typer.Option(min=64, help="Length of the whole schedule in crops.")] = 200_000,
    batch: Annotated[int, typer.Option(min=2)] = 32,
    peak_rate: Annotated[float, typer.Option(help="Highest learning rate.")] = 2e-3,
    start: Annotated[Path | None, typer.Option(help="Folded weights of an earlier run to go on from.")] = None,
    seed: int = 0,
    workers: Annotated[int, typer.Option(min=0)] = 1,
    stop_after: Annotated[int | None, typer.Option(help="End this sitting after that many steps.")] = None,
) -> None:
    """Distil the default backbone; run it again to resume."""
    torch.set_num_threads(max(1, (os.cpu_count() or 2)))
    weights = distill(
        photographs,
        teacher,
        output,
        crops=crops,
        batch=batch,
        peak_rate=peak_rate,
        seed=seed,
        workers=workers,
        stop_after=stop_after,
        start=start,
    )
    typer.echo(f"weights: {weights}")


if __name__ == "__main__":
    typer.run(main)
